"""What a command may import before it works: every package of others costs tenths of a second."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from app.cli import commands
from app.cli.on_demand import Command, Tree
from app.one_thread import ONE_THREAD

ROOT = Path(__file__).parent.parent
PACKAGES = frozenset(
    """
    alembic cql2 cv2 fastapi geoalchemy2 httpx importlib.metadata jinja2 matplotlib numba numpy obstore
    pandas procrastinate prometheus_client psycopg pyarrow pydantic_settings pyogrio pyproj rasterio
    scipy scipy.spatial scipy.stats shapely sqlalchemy uvicorn
    """.split()  # noqa: SIM905
)
"""What takes long to import."""
CONNECTION = frozenset({"importlib.metadata", "psycopg", "pydantic_settings", "sqlalchemy"})
"""What the settings and a connection need."""
STORE = CONNECTION | {"geoalchemy2", "numpy", "shapely"}
"""What the tables and a connection to them need."""
BUDGETS = {
    "--version": {"importlib.metadata"},
    "--help": frozenset(),
    "block --help": {"importlib.metadata"},
    "serve --help": CONNECTION,
    "token list --help": STORE,
    "audit --help": STORE,
    "block list --help": STORE,
    "block publish --help": STORE,
    # The jobs are done by other processes, which a warm server of the worker forks.
    "worker --help": STORE | {"procrastinate"},
    # Without the statistics of scipy: a third of the time that its start takes.
    "scene register --help": PACKAGES - {"scipy.stats", "fastapi", "matplotlib", "pandas", "uvicorn"},
}
PROGRAM = """
import atexit, json, sys

class Importers:
    "Notes which file first imports a package."
    first = {}

    def find_spec(self, name, path=None, target=None):
        if name not in self.first:
            frame = sys._getframe(1)
            while frame and "importlib" in frame.f_code.co_filename:
                frame = frame.f_back
            self.first[name] = f"{frame.f_code.co_filename}:{frame.f_lineno}" if frame else ""

sys.meta_path.insert(0, Importers())
atexit.register(lambda: print(json.dumps(Importers.first)))
"""
COMMAND = "from app.cli.main import main; main()"


def imported_by(statement: str, words: str = "") -> dict[str, str]:
    """The modules that a statement imports, each with the line that imported it first.

    Args:
        words: arguments of the program.
    """
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM + statement, *words.split()],
        cwd=ROOT,
        env=os.environ,
        capture_output=True,
        text=True,
        check=True,
    )
    first: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return first


@pytest.mark.parametrize("words", BUDGETS)
def test_a_command_imports_no_more_than_its_budget(words):
    imported = imported_by(COMMAND, words)
    beyond = {
        name: line for name, line in imported.items() if name in PACKAGES and name not in BUDGETS[words]
    }
    assert beyond == {}, f"amers {words} imports what it does not need; see who asks for it first"


def test_the_python_client_imports_nothing_of_weight_but_httpx():
    imported = imported_by("import app.client")
    assert {
        name: line
        for name, line in imported.items()
        if name in PACKAGES - {"httpx", "importlib.metadata"}
    } == {}
    assert "httpx" in imported


def test_rows_on_a_pipe_are_printed_without_the_tables_of_terminals():
    program = """
import sys
from app.cli.output import show
show([{"number": 7}], as_json=False)
print("rich" in sys.modules)
"""
    printed = subprocess.check_output([sys.executable, "-c", program], cwd=ROOT, text=True)
    assert printed.split() == ["number", "7", "False"]


@pytest.mark.parametrize(("stated", "threads"), [({}, 1), ({"OPENBLAS_NUM_THREADS": "2"}, 2)])
def test_linear_algebra_of_a_command_has_one_thread_unless_more_are_asked_for(stated, threads):
    program = """
import os, sys
from app.cli.main import main
sys.argv = ["amers", "--version"]
try:
    main()
except SystemExit:
    pass
import numpy
print(len(os.listdir("/proc/self/task")))
"""
    inherited = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    environment = {**inherited, **stated}
    printed = subprocess.check_output(
        [sys.executable, "-c", program], cwd=ROOT, env=environment, text=True
    )
    assert int(printed.split()[-1]) == min(threads, os.cpu_count() or 1)


def entries(tree: Tree, words: str = "amers") -> list[tuple[str, Command]]:
    """All commands of a tree with their words."""
    found = []
    for name, entry in tree.items():
        below = f"{words} {name}"
        found += [(below, entry)] if isinstance(entry, Command) else entries(entry.commands, below)
    return found


def test_the_line_of_a_command_in_lists_is_that_of_its_function():
    for words, command in entries(commands.COMMANDS):
        module, function = command.function.split(":")
        source = (ROOT / "app" / "cli" / f"{module}.py").read_text()
        body = source[source.index(f"def {function}(") :]
        assert " ".join(body.split('"""')[1].split("\n\n")[0].split()) == command.help, words
