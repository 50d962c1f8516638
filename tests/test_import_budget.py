"""What a command may import before it works: every package of others costs tenths of a second."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from amers.app.cli import commands
from amers.app.cli.on_demand import Command, Tree
from amers.app.one_thread import ONE_THREAD
from tests.imports import COMMAND, CONNECTION, LISTING, PACKAGES, beyond_budget, imported_by

ROOT = Path(__file__).parent.parent
STORE = CONNECTION | {"geoalchemy2", "numpy", "shapely", "sqlalchemy"}
"""What the tables and a connection to them need."""
BUDGETS = {
    "--version": {"importlib.metadata"},
    "--help": frozenset(),
    "block --help": {"importlib.metadata"},
    # The help of a command is read from a file: see `tests/app/test_recorded_help.py`.
    "scene register --help": {"importlib.metadata"},
}
MODULES = {
    "serve": CONNECTION,
    "token": STORE,
    "audit": STORE,
    "block_listing": LISTING,
    "block_detail": LISTING,
    "block_state": STORE,
    # The jobs are done by other processes, which a warm server of the worker forks. Products may lie in
    # buckets: obstore takes 4 ms.
    "worker": STORE | {"obstore", "procrastinate"},
    # Without the statistics of scipy: a third of the time that its start takes.
    "scene": PACKAGES - {"scipy.stats", "fastapi", "matplotlib", "pandas", "uvicorn"},
}
"""By the module of a command: what it imports before it works."""


@pytest.mark.parametrize("name", MODULES)
@pytest.mark.long
def test_the_module_of_a_command_imports_no_more_than_its_budget(name):
    beyond = beyond_budget(imported_by(f"import amers.app.cli.{name}"), MODULES[name])
    assert beyond == {}, f"amers.app.cli.{name} imports what it does not need; see who asks for it first"


@pytest.mark.parametrize("words", BUDGETS)
@pytest.mark.long
def test_a_command_imports_no_more_than_its_budget(words):
    beyond = beyond_budget(imported_by(COMMAND, words), BUDGETS[words])
    assert beyond == {}, f"amers {words} imports what it does not need; see who asks for it first"


def test_the_python_client_imports_nothing_of_weight_but_httpx():
    imported = imported_by("import amers.app.client")
    assert beyond_budget(imported, {"httpx", "importlib.metadata"}) == {}
    assert "httpx" in imported


def test_rows_on_a_pipe_are_printed_without_the_tables_of_terminals():
    program = """
import sys
from amers.app.cli.output import show
show([{"number": 7}], as_json=False)
print("rich" in sys.modules)
"""
    printed = subprocess.check_output([sys.executable, "-c", program], cwd=ROOT, text=True)
    assert printed.split() == ["number", "7", "False"]


@pytest.mark.parametrize(("stated", "threads"), [({}, 1), ({"OPENBLAS_NUM_THREADS": "2"}, 2)])
def test_linear_algebra_of_a_command_has_one_thread_unless_more_are_asked_for(stated, threads):
    program = """
import os, sys
from amers.app.cli.main import main
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
