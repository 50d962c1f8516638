"""What commands print for programs and for people, and names of tokens that are theirs alone."""

import csv
import json
import os
import re

import psycopg
import pytest

from amers.app.cli.demo import LABELS
from amers.app.db import engine
from amers.app.errors import Conflict
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from amers.app.usecases.tokens import create_token, revoke_token
from tests.command_line import amers_here
from tests.factories import make_block
from tests.imports import COMMAND, LISTING, beyond_budget, imported_by
from tests.statements import run_sql

NAME = re.compile(r"[a-z][a-z0-9_]*")
LISTS = (("block", "list"), ("token", "list"), ("audit",))


@pytest.fixture
def run(dsn, tmp_path):
    """Runs a command on a store with a published block and a token, with its output on a pipe."""
    made = make_block(tmp_path / "block", 5, n_images=2, gsds_m=(2.0,))
    with engine.connect(dsn) as connection:
        ingest_block(connection, Storage(tmp_path / "storage"), made.folder)
        publish_block(connection, "calanques")
        create_token(connection, "tab\tand\nline", ["read"])
    environment = {**os.environ, "AMERS_DATABASE_URL": dsn, "AMERS_DATA_FOLDER": str(tmp_path)}

    def run(*words: str) -> str:
        done = amers_here(words, environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def names_in(value: object) -> set[str]:
    """All keys of objects in a JSON value, but those of stored rows, which are columns."""
    if isinstance(value, list):
        return {name for one in value for name in names_in(one)}
    if isinstance(value, dict):
        return set(value) | {name for one in value.values() for name in names_in(one)}
    return set()


def test_a_list_on_a_pipe_has_a_header_and_one_line_a_record(run):
    for words in LISTS:
        records = json.loads(run(*words, "--json"))
        rows = list(csv.reader(run(*words).splitlines(), delimiter="\t", quoting=csv.QUOTE_NONE))
        assert all(NAME.fullmatch(name) for name in rows[0]), rows[0]
        assert len(rows) == 1 + len(records) > 1
        assert {len(row) for row in rows} == {len(rows[0])}


def test_the_extent_of_a_block_is_a_box_that_a_query_takes(run):
    shown = dict(re.split("  +", line) for line in run("block", "show", "calanques").splitlines())
    box = json.loads(run("block", "show", "calanques", "--json"))["extent"]
    assert shown["extent"] == ",".join(f"{value:.6f}" for value in box)
    found = run("points", "query", "--bbox", shown["extent"], "--format", "csv").splitlines()
    assert len(found) == 1 + int(shown["points"]) == 6


def test_blocks_are_listed_within_the_budget_of_imports(run, dsn, tmp_path):
    imported = imported_by(
        COMMAND, "block list", AMERS_DATABASE_URL=dsn, AMERS_DATA_FOLDER=str(tmp_path)
    )
    assert beyond_budget(imported, LISTING) == {}, "see who asks for it first"


def test_names_in_json_have_no_blanks(run):
    for words in (*LISTS, ("block", "show", "calanques"), ("store", "usage"), ("db", "status")):
        names = names_in(json.loads(run(*words, "--json")))
        assert names
        assert [name for name in names if not NAME.fullmatch(name)] == []
    assert [name for name in LABELS if not NAME.fullmatch(name)] == []


def test_the_audit_shows_what_a_change_replaced(run):
    rows = list(csv.DictReader(run("audit", "--kind", "block").splitlines(), delimiter="\t"))
    assert [row["action"] for row in rows] == ["changed", "created"]
    assert rows[0]["subject"] == "calanques@1"
    assert "state: staged -> published" in rows[0]["change"]
    assert "{" not in rows[0]["change"]


def test_a_name_belongs_to_one_valid_token(connection):
    first = create_token(connection, "survey office", ["read"]).token
    with pytest.raises(Conflict, match=f"{first.id} is named 'survey office' already"):
        create_token(connection, " survey office ", ["admin"])
    revoke_token(connection, "survey office")
    create_token(connection, "survey office", ["read"], days=1)
    run_sql(connection, "update token set expires_at = now() - interval '1 second'")
    create_token(connection, "survey office", ["read"])


def test_two_who_take_one_name_at_the_same_time_wait_for_each_other(dsn, connection):
    create_token(connection, "survey office", ["read"])
    with engine.connect(dsn) as other:
        engine.limit_lock_wait(other, 0.1)
        with pytest.raises(psycopg.errors.LockNotAvailable):
            create_token(other, "survey office", ["read"])
