"""Every reader and every statement that its files may make: used, assumed, named or refused."""

import ast
import importlib
import pkgutil
from pathlib import Path

import pytest

from amers.services.formats.readers import OWN_FILES, PARTS, READERS
from amers.services.statements import Subject
from scripts.make_inputs_page import PAGE, inputs_page
from tests.services.formats import statements
from tests.services.formats.statements.cell import CELLS, Cell

ROOT = Path(__file__).parents[3]
for module in pkgutil.iter_modules(statements.__path__):
    importlib.import_module(f"{statements.__name__}.{module.name}")


def reading_functions() -> set[str]:
    """Public functions of `services/formats` whose names say that they read something."""
    bodies = [ast.parse(path.read_text()).body for path in (ROOT / "services/formats").rglob("*.py")]
    functions = [node.name for body in bodies for node in body if isinstance(node, ast.FunctionDef)]
    return {name for name in functions if name.startswith(("read_", "parse_", "open_", "load_"))}


@pytest.mark.parametrize("cell", CELLS, ids=str)
def test_a_statement_becomes_what_the_page_says(cell: Cell, tmp_path: Path) -> None:
    cell.check(tmp_path)


def test_every_reader_has_a_row() -> None:
    with_row = {name for reader in READERS for name in reader.functions}
    assert reading_functions() == with_row | OWN_FILES | PARTS
    assert not with_row & (OWN_FILES | PARTS)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_a_row_speaks_of_every_subject_once_or_says_that_it_cannot_be_stated(reader) -> None:
    treated = {treatment.subject for treatment in reader.treatments}
    assert treated | set(reader.never) == set(Subject)
    assert not treated & set(reader.never)


def test_every_line_of_the_page_has_a_file_that_shows_it() -> None:
    lines = {(r.name, t.subject, t.outcome) for r in READERS for t in r.treatments}
    shown = {(cell.reader, cell.subject, cell.outcome) for cell in CELLS}
    assert shown == lines


def test_the_page_is_that_of_the_readers() -> None:
    assert PAGE.read_text() == inputs_page()
