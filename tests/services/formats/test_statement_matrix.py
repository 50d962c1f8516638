"""Every reader and every statement that its files may make: used, assumed, named or refused.

`tests/golden/all_readings.json` has what else is read of these files. After a change that is meant,
write it anew (`python -m tests.services.formats.test_statement_matrix`) and read what differs.
"""

import ast
import importlib
import json
import pkgutil
from pathlib import Path
from tempfile import TemporaryDirectory
from zlib import crc32

import pytest

from amers.services.formats.readers import OWN_FILES, PARTS, READERS
from amers.services.statements import Subject
from scripts.make_inputs_page import PAGE, inputs_page
from tests.services.figures import READ, Figures, differing, figures
from tests.services.formats import statements
from tests.services.formats.statements.cell import CELLS, Cell

ROOT = Path(__file__).parents[3]
GOLDEN = ROOT / "tests/golden/all_readings.json"
LEFT_OUT = {"statements", "line_num", "line_den", "sample_num", "sample_den"}
"""Members that cells check: of models that are fitted, many coefficients are as good as others."""
for module in pkgutil.iter_modules(statements.__path__):
    importlib.import_module(f"{statements.__name__}.{module.name}")


def reading_functions() -> set[str]:
    """Public functions of `services/formats` whose names say that they read something."""
    bodies = [ast.parse(path.read_text()).body for path in (ROOT / "services/formats").rglob("*.py")]
    functions = [node.name for body in bodies for node in body if isinstance(node, ast.FunctionDef)]
    return {name for name in functions if name.startswith(("read_", "parse_", "open_", "load_"))}


def keys() -> list[str]:
    """The names of the cells among all readings: those of one name are numbered."""
    names = [f"{cell}: {cell.shows}" for cell in CELLS]
    return [f"{name} ({names[:n].count(name) + 1})" for n, name in enumerate(names)]


def reading(cell: Cell, folder: Path) -> Figures:
    """What is read of the file of a cell, which is checked, but for what is checked already."""
    folder = folder / "files"
    folder.mkdir()
    words = json.loads(
        json.dumps(figures(cell.check(folder), LEFT_OUT)).replace(str(folder), "<folder>")
    )
    return {path: [_short(one) for one in values] for path, values in words.items()}


def _short(one: float | str) -> float | str:
    """Of a long text, such as a reference system, the beginning and a check sum."""
    return f"{one[:60]}… {crc32(one.encode())}" if isinstance(one, str) and len(one) > 60 else one


@pytest.fixture(scope="module")
def expected() -> dict[str, Figures]:
    """All that is read of each file."""
    return dict(json.loads(GOLDEN.read_text()))


@pytest.mark.parametrize(("cell", "key"), zip(CELLS, keys(), strict=True), ids=map(str, CELLS))
def test_a_statement_becomes_what_the_page_says_and_all_else_is_read_as_it_was(
    cell: Cell, key: str, expected: dict[str, Figures], tmp_path: Path
) -> None:
    assert not differing(reading(cell, tmp_path), expected.get(key, {}), READ)


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


def _written(cell: Cell, key: str) -> str:
    with TemporaryDirectory() as folder:
        return f"{json.dumps(key)}: {json.dumps(reading(cell, Path(folder)))}"


if __name__ == "__main__":
    read = [one for one in zip(CELLS, keys(), strict=True) if one[0].outcome != "refused"]
    GOLDEN.write_text("{\n" + ",\n".join(_written(*one) for one in read) + "\n}\n")
