"""Write docs/modules.md: every module with the first line of its docstring; `--check` compares."""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "modules.md"
HEAD = """# Modules

Every module of `amers`, `services` and `app`, with the first line of its docstring.
`scripts/make_module_list.py` writes this page; [architecture](architecture.md) explains how the packages
depend on each other.
"""


def first_line(path: Path) -> str:
    """The first line of the docstring of a module; "" without one."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]


def module_list(root: Path = ROOT) -> str:
    """Markdown of the page."""
    parts = [HEAD]
    packages = [root / "amers"]
    for top in ("services", "app"):
        packages += sorted(path.parent for path in (root / top).rglob("__init__.py"))
    for package in packages:
        modules = sorted(path for path in package.glob("*.py") if path.name != "__init__.py")
        rows = "".join(f"| `{path.name}` | {first_line(path)} |\n" for path in modules)
        table = f"\n| module | content |\n|---|---|\n{rows}" if rows else ""
        name = package.relative_to(root).as_posix()
        parts.append(f"\n## {name}\n\n{first_line(package / '__init__.py')}\n{table}")
    return "".join(parts)


def main(arguments: list[str]) -> int:
    """Write or compare the page; 1 if they differ."""
    text = module_list()
    if arguments != ["--check"]:
        PAGE.write_text(text, encoding="utf-8")
    elif PAGE.read_text(encoding="utf-8") != text:
        print(f"{PAGE.name} is not that of the modules: run scripts/make_module_list.py")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
