"""A session that the database ends, at whatever statement of a command, ends it with one sentence.

`make test` draws statements of each command, `make test-thorough` more of them; `make test-endurance`
tries every statement of every command, in every way that a session ends.
"""

import ast
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from uuid import uuid4
from zlib import crc32

import psycopg
import pytest
from psycopg import sql

import amers.app.cli
from amers.app.cli.commands import COMMANDS
from amers.app.cli.exit_status import FAILURE, REFUSED, SUCCESS
from amers.app.cli.on_demand import Command
from amers.app.db import session
from amers.app.db.cluster import backup
from amers.app.db.cluster.embedded import ROLE, SUPERUSER, Cluster
from amers.app.usecases.blocks import deletion
from tests.app.conftest import EMPTY_TEMPLATE, TEMPLATE
from tests.app.session_relay import Ending, Relay, relayed
from tests.app.store_commands import (
    ON_REQUEST,
    STORE_COMMANDS,
    WITH_PROCESSES,
    WITHOUT_STORE,
    Installations,
    Place,
    all_commands,
    fill,
    register,
)
from tests.command_line import Done, amers_here, amers_process

pytestmark = pytest.mark.long

LONGEST_S, LONGEST_WORK_S = 60, 600
"""Time limits of one command, and of one that computes, on a machine that has other things to do."""
LONG_WORK = {"block renew", "scene register", "scene register-many"}
"""Commands that compute for seconds: `make test` leaves them out."""
OF_POSTGRES = {"db backup", "db restore"}
"""Commands whose work PostgreSQL's own programs do: their failure is that of the installation."""
READING = {
    "audit",
    "block export",
    "block list",
    "block quality",
    "block show",
    "db status",
    "points query",
    "points suspensions",
    "reference list",
    "store sweep",
    "store trash empty",
    "store usage",
    "token list",
}
"""Commands that change nothing in the database of the small installation."""
UNLOCKED = {"spatial_ref_sys", "alembic_version"}
"""The first belongs to PostGIS; the second is read by each command before it works."""
ADVISORY_LOCKS = (0x616D657273,)
"""Of upgrades."""
DRAWN = 12
"""Statements of one command that `make test-thorough` tries."""


class Hung(BaseException):
    """A command has not ended in time; no code that it is raised in catches it."""


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Raise `Hung` in this thread after a time, in whatever loop or wait it is."""

    def end(number: int, frame: FrameType | None) -> None:
        raise Hung(f"more than {seconds} s")

    former = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, former)


@pytest.fixture(scope="module")
def small(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Installations:
    """Copies of one small installation."""
    made = tmp_path_factory.mktemp("small")
    installations = Installations(cluster, made, new_database(cluster), EMPTY_TEMPLATE)
    fill(cluster.dsn(installations.filled), made, points=40, size=900)
    return installations


@pytest.fixture(scope="module")
def with_registration(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Installations:
    """Copies of one installation that has registered a scene well."""
    made = tmp_path_factory.mktemp("registered")
    installations = Installations(cluster, made, new_database(cluster), EMPTY_TEMPLATE)
    fill(cluster.dsn(installations.filled), made, points=100, size=1200)
    register(cluster.dsn(installations.filled), made)
    return installations


@pytest.fixture
def installations(command: str, request: pytest.FixtureRequest) -> Installations:
    """Copies of an installation that a command succeeds on."""
    wanted = "with_registration" if command == "block renew" else "small"
    copies: Installations = request.getfixturevalue(wanted)
    return copies


def new_database(cluster: Cluster) -> str:
    """The name of a database with the schema, which goes with the cluster."""
    name = f"filled_{uuid4().hex}"
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as connection:
        connection.execute(
            sql.SQL("create database {} template {} owner {}").format(
                *map(sql.Identifier, (name, TEMPLATE, ROLE))
            )
        )
    return name


@contextmanager
def reached(installations: Installations, folder: Path, command: str) -> Iterator[tuple[Place, Relay]]:
    """An installation for one run of a command, whose database is behind a relay."""
    with installations.new(folder, command) as place, relayed(place.dsn) as relay:
        yield Place(place.folder, place.made, relay.dsn), relay


def run(place: Place, command: str) -> Done:
    """A command in this process, within its time limit."""
    with limited(LONGEST_WORK_S if command in LONG_WORK else LONGEST_S):
        return amers_here([*command.split(), *STORE_COMMANDS[command](place)], place.environment)


def statements_of(installations: Installations, folder: Path, command: str) -> int:
    """The number of statements that a command sends when nothing happens; it succeeds."""
    with reached(installations, folder, command) as (place, relay):
        relay.arm()
        done = run(place, command)
        assert done.returncode == SUCCESS, done.stderr
        return relay.count


def lose(installations: Installations, folder: Path, command: str, number: int, ending: Ending) -> None:
    """Run a command whose session ends at a statement, and once more if it has failed."""
    with reached(installations, folder, command) as (place, relay):
        relay.arm(number, ending)
        done = run(place, command)
        check_ending(command, done)
        if done.returncode != SUCCESS:
            relay.arm()
            again = run(place, command)
            assert "Traceback" not in again.stderr
            assert again.returncode in (SUCCESS, REFUSED), again.stderr


def check_ending(command: str, done: Done) -> None:
    """A command has succeeded all the same, or has said in one sentence that it has not."""
    is_early = "cannot be reached" in done.stderr
    failed = {FAILURE, REFUSED} if is_early or command in OF_POSTGRES else {FAILURE}
    assert done.returncode in failed | {SUCCESS}, (done.returncode, done.stderr)
    assert "Traceback" not in done.stderr
    if done.returncode != SUCCESS:
        *before, sentence = done.stderr.splitlines()
        assert sentence.startswith("amers: "), done.stderr
        assert "should not happen" not in sentence
        assert all(" % " in line for line in before), done.stderr


def drawn(command: str, ending: Ending, n_statements: int, count: int) -> list[int]:
    """Some statements, always the same ones of a command."""
    numbers = range(1, n_statements + 1)
    key = f"{command} {ending}"
    return sorted(numbers, key=lambda number: crc32(f"{key} {number}".encode()))[:count]


def test_every_command_is_tried_or_works_without_the_store():
    tried = (*STORE_COMMANDS, *WITHOUT_STORE, *ON_REQUEST, *WITH_PROCESSES)
    assert sorted(tried) == sorted(all_commands())


@pytest.mark.parametrize("command", sorted(WITHOUT_STORE))
def test_a_command_without_the_store_has_no_way_to_open_it(command: str):
    opening = {
        "amers.app.cli.transaction",
        "amers.app.cli.reading",
        "amers.app.db.engine",
        "amers.app.db.ready",
        "psycopg",
    }
    *nouns, verb = command.split()
    tree = COMMANDS
    for noun in nouns:
        tree = tree[noun].commands
    entry = tree[verb]
    assert isinstance(entry, Command)
    module = entry.function.partition(":")[0]
    if command not in {"db verify-backup", "store trash list", "store trash restore"}:
        assert not opening & imported_through(f"amers.app.cli.{module}")


def imported_through(module: str) -> set[str]:
    """What a module of commands imports, and the modules of commands that it imports."""
    folder, found, waiting = Path(amers.app.cli.__path__[0]), set[str](), [module]
    while waiting:
        path = folder / f"{waiting.pop().rpartition('.')[2]}.py"
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module and node.module not in found:
                found.add(node.module)
                if node.module.startswith("amers.app.cli."):
                    waiting.append(node.module)
    return found


@pytest.mark.parametrize("command", sorted(set(STORE_COMMANDS) - LONG_WORK))
def test_a_command_on_a_read_only_database_reads_or_says_that_it_cannot_write(
    installations: Installations, tmp_path: Path, command: str
):
    with installations.new(tmp_path, command) as place:
        with psycopg.connect(place.dsn, autocommit=True) as connection:
            name = sql.Identifier(connection.info.dbname)
            connection.execute(
                sql.SQL("alter database {} set default_transaction_read_only = on").format(name)
            )
        done = run(place, command)
    check_ending(command, done)
    if command in READING:
        assert done.returncode == SUCCESS, done.stderr
    else:
        assert "read-only" in done.stderr


@pytest.mark.parametrize("command", sorted(set(STORE_COMMANDS) - LONG_WORK))
def test_a_command_does_not_wait_for_ever_for_what_others_hold(
    installations: Installations,
    tmp_path: Path,
    command: str,
    monkeypatch: pytest.MonkeyPatch,
):
    """Somebody has left a transaction open that holds all tables, and all that has a lock of its own."""
    monkeypatch.setitem(session.SETTINGS, "lock_timeout", "200ms")
    monkeypatch.setattr(backup, "LOCK_WAIT", "200ms")
    monkeypatch.setattr(deletion, "LONGEST_WAIT_S", 0.2)
    with installations.new(tmp_path, command) as place, psycopg.connect(place.dsn) as other:
        tables = other.execute("select tablename from pg_tables where schemaname = 'public'")
        names = [sql.Identifier(name) for (name,) in tables if name not in UNLOCKED]
        if names:
            other.execute(
                sql.SQL("lock table {} in access exclusive mode").format(sql.SQL(", ").join(names))
            )
        for number in ADVISORY_LOCKS:
            other.execute("select pg_advisory_xact_lock(%s)", [number])
        hurried = {**place.environment, "AMERS_READ_TIMEOUT_SECONDS": "0.2"}
        with limited(LONGEST_S):
            done = amers_here([*command.split(), *STORE_COMMANDS[command](place)], hurried)
    check_ending(command, done)
    assert done.returncode != SUCCESS or command in {"db status", "db restore"}


@pytest.mark.parametrize("command", sorted(set(STORE_COMMANDS) - LONG_WORK))
def test_a_session_lost_at_drawn_statements_ends_a_command_with_a_sentence(
    installations: Installations, tmp_path: Path, command: str
):
    n_statements = statements_of(installations, tmp_path, command)
    for ending in (Ending.TERMINATED, Ending.UNANSWERED):
        for number in drawn(command, ending, n_statements, 1):
            lose(installations, tmp_path, command, number, ending)


@pytest.mark.endurance
@pytest.mark.parametrize("command", sorted(set(STORE_COMMANDS) - {"scene register-many"}))
def test_a_session_lost_at_more_statements_ends_a_command_with_a_sentence(
    installations: Installations, tmp_path: Path, command: str
):
    n_statements = statements_of(installations, tmp_path, command)
    for ending in Ending:
        count = DRAWN // len(Ending) if command not in LONG_WORK else 1
        for number in drawn(command, ending, n_statements, count):
            lose(installations, tmp_path, command, number, ending)


@pytest.mark.endurance
@pytest.mark.parametrize("ending", list(Ending))
@pytest.mark.parametrize("command", sorted(STORE_COMMANDS))
def test_a_session_lost_at_any_statement_ends_a_command_with_a_sentence(
    installations: Installations, tmp_path: Path, command: str, ending: Ending
):
    n_statements = statements_of(installations, tmp_path, command)
    assert n_statements > 0
    for number in range(1, n_statements + 1):
        lose(installations, tmp_path, command, number, ending)


@pytest.mark.thorough
@pytest.mark.parametrize("command", ["db backup", "token create", "block ingest"])
def test_a_process_whose_session_is_lost_ends_as_the_command_does(
    installations: Installations, tmp_path: Path, command: str
):
    (number,) = drawn(command, Ending.CUT, statements_of(installations, tmp_path, command), 1)
    with reached(installations, tmp_path, command) as (place, relay):
        relay.arm(number, Ending.TERMINATED)
        words = [*command.split(), *STORE_COMMANDS[command](place)]
        check_ending(command, amers_process(words, place.environment))
        assert relay.has_ended
