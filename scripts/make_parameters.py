"""Write app/cli/parameters.json: what the help of every command shows; `--check` compares."""

import json
import sys
from importlib import import_module

from amers.app.cli import commands
from amers.app.cli.on_demand import Command, Tree
from amers.app.cli.options import with_options
from amers.app.cli.recorded import RECORD, record_of


def functions(tree: Tree = commands.COMMANDS) -> list[str]:
    """The functions of all commands of a tree, sorted."""
    found: set[str] = set()
    for entry in tree.values():
        found |= {entry.function} if isinstance(entry, Command) else set(functions(entry.commands))
    return sorted(found)


def parameters() -> str:
    """Text of the file, one line for each parameter."""
    entries = []
    for function in functions():
        module, _, name = function.partition(":")
        entry = record_of(with_options(getattr(import_module(f"amers.app.cli.{module}"), name)))
        rows = [
            f"   {json.dumps(name)}: {json.dumps(one, ensure_ascii=False)}"
            for name, one in entry["parameters"].items()
        ]
        text = ",\n".join(rows)
        entries.append(
            f' "{function}": {{\n  "help": {json.dumps(entry["help"], ensure_ascii=False)},\n'
            f'  "parameters": {{\n{text}\n  }}\n }}'
        )
    return "{\n" + ",\n".join(entries) + "\n}\n"


def main(arguments: list[str]) -> int:
    """Write or compare the file; 1 if they differ."""
    text = parameters()
    if arguments != ["--check"]:
        RECORD.write_text(text, encoding="utf-8")
        return 0
    if RECORD.read_text(encoding="utf-8") == text:
        return 0
    print(f"{RECORD.name}: other parameters found than commands have; run scripts/make_parameters.py")
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
