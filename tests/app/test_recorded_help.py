"""The help of every command is printed from a file, and is what its function has."""

import json
import subprocess
import sys
from importlib import import_module
from typing import Any

import pytest
import typer
from typer.core import TyperCommand
from typer.main import get_command

from amers.app.cli import commands
from amers.app.cli.on_demand import Command, Tree
from amers.app.cli.options import with_options
from amers.app.cli.recorded import recorded
from scripts.make_parameters import RECORD, parameters

HEAVY = ("cv2", "numba", "rasterio", "scipy", "shapely", "sqlalchemy")
PROGRAM = """
import io, json, sys
from contextlib import redirect_stdout
from amers.app.cli.main import app

printed = []
for words in json.loads(sys.argv[1]):
    text = io.StringIO()
    with redirect_stdout(text):
        app([*words, "--help"], prog_name="amers", standalone_mode=False)
    printed.append(text.getvalue())
print(json.dumps([printed, sorted(sys.modules)]))
"""


def leaves(tree: Tree = commands.COMMANDS, *words: str) -> list[tuple[list[str], Command]]:
    """All commands of a tree with their words."""
    found: list[tuple[list[str], Command]] = []
    for name, entry in tree.items():
        one = isinstance(entry, Command)
        found += [([*words, name], entry)] if one else leaves(entry.commands, *words, name)
    return found


def help_of(function: Any) -> str:
    one = typer.Typer(add_completion=False)
    one.command()(function)
    command: TyperCommand = get_command(one)
    context = command.make_context("amers", [], resilient_parsing=True)
    return command.get_help(context)


def test_no_help_imports_what_takes_long() -> None:
    words = [words for words, _ in leaves()]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(words)], capture_output=True, text=True, check=True
    )
    printed, modules = json.loads(done.stdout)
    for one, text in zip(words, printed, strict=True):
        assert f"amers {' '.join(one)}" in text
        assert "--help" in text
    assert [name for name in modules if name.partition(".")[0] in HEAVY] == []


@pytest.mark.long
def test_the_file_has_the_parameters_of_all_commands() -> None:
    assert RECORD.read_text(encoding="utf-8") == parameters(), "run scripts/make_parameters.py"


@pytest.mark.long
@pytest.mark.parametrize("entry", [entry for _, entry in leaves()], ids=lambda entry: entry.function)
def test_help_from_the_file_is_that_of_the_function(
    entry: Command, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    module, _, name = entry.function.partition(":")
    function = with_options(getattr(import_module(f"amers.app.cli.{module}"), name))
    shown = []
    for one in (recorded(entry.function), function):
        shown.append(help_of(one) + capsys.readouterr().out)
    assert shown[0] == shown[1]
