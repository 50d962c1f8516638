"""Everything is imported below `amers`; the short names of the folders would load modules twice."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("app", "services", "migrations")
SOURCES = (*FOLDERS, "amers", "tests", "benchmarks", "examples", "mutants", "scripts", "qgis_plugin")
IMPORT = re.compile(rf"^\s*(?:from|import) ({'|'.join(FOLDERS)})\b(?!-)", re.MULTILINE)


def short_imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) and not node.level else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        yield from (name for name in names if name.split(".")[0] in FOLDERS)


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_folder_is_the_package_of_its_name(folder: str):
    link = ROOT / "amers" / folder
    assert link.is_symlink()
    assert link.resolve() == ROOT / folder


@pytest.mark.parametrize("folder", SOURCES)
def test_no_module_is_imported_by_a_short_name(folder: str):
    paths = [path for path in (ROOT / folder).rglob("*.py") if "node_modules" not in path.parts]
    short = {
        str(path.relative_to(ROOT)): names
        for path in paths
        if (names := list(short_imports(ast.parse(path.read_text()))))
    }
    assert paths
    assert short == {}


@pytest.mark.parametrize(
    "path", sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")]), ids=lambda p: p.name
)
def test_no_document_imports_by_a_short_name(path: Path):
    assert IMPORT.findall(path.read_text()) == []


def test_the_rule_finds_short_names():
    module = "import app.main\nfrom services import errors\nfrom .app import x\nimport amers.app"
    assert sorted(short_imports(ast.parse(module))) == ["app.main", "services"]
    assert IMPORT.findall("    from services.errors import InputError") == ["services"]


def test_the_module_is_the_command():
    printed = [
        subprocess.run([*command, "--version"], check=True, capture_output=True, text=True).stdout
        for command in ([sys.executable, "-m", "amers"], [Path(sys.executable).with_name("amers")])
    ]
    assert printed[0] == printed[1]
