"""A database of your own whose PostGIS is in another schema, or whose role lacks a right."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import psycopg
import pytest
from fastapi.testclient import TestClient
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict
from pydantic import SecretStr

from amers.app.cli.failures import failure
from amers.app.config import Settings
from amers.app.db import engine, revisions
from amers.app.db.cluster.embedded import ROLE, SUPERUSER, Cluster
from amers.app.db.engine import READER
from amers.app.main import create_app
from amers.app.storage import Storage
from amers.app.usecases import readiness
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.tokens import create_token
from tests.factories import make_block

Operator = Callable[..., None]


@contextmanager
def new_database(cluster: Cluster) -> Iterator[tuple[str, Operator]]:
    """A database without anything, and a superuser who runs statements there."""
    name = f"test_{uuid4().hex}"
    names = {"database": name, "role": ROLE, "reader": READER, "weak": f"weak_{name}"}
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as server:
        quoted = {key: sql.Identifier(value) for key, value in names.items()}
        server.execute(sql.SQL("create database {database} owner {role}").format(**quoted))
        try:
            with psycopg.connect(cluster.dsn(name, SUPERUSER), autocommit=True) as operator:

                def run(*statements: str) -> None:
                    for statement in statements:
                        operator.execute(sql.SQL(statement).format(**quoted))  # type: ignore[arg-type]

                yield cluster.dsn(name), run
        finally:
            server.execute(sql.SQL("drop database {database} with (force)").format(**quoted))
            server.execute(sql.SQL("drop role if exists {weak}").format(**quoted))


@contextmanager
def served(dsn: str, folder: Path) -> Iterator[tuple[TestClient, dict[str, str]]]:
    """The application on a database, and a caller who may do everything."""
    with TestClient(
        create_app(Settings(database_url=SecretStr(dsn), data_folder=folder / "data")),
        raise_server_exceptions=False,
    ) as client:
        yield client, {"Authorization": f"Bearer {(folder / 'secret').read_text()}"}


def fill(dsn: str, folder: Path) -> None:
    """Make the tables of a database, a block and a token."""
    revisions.upgrade(dsn)
    with engine.connect(dsn) as connection:
        block = make_block(folder / "block", 5, name="calanques")
        lifecycle.ingest_block(connection, Storage(folder / "data" / "storage"), block.folder)
        lifecycle.publish_block(connection, "calanques")
        (folder / "secret").write_text(create_token(connection, "keeper", ["admin"]).secret)


@pytest.fixture(autouse=True)
def checked_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Readiness repeats no result."""
    monkeypatch.setattr(readiness, "VALID_S", 0.0)


@pytest.mark.parametrize(
    ("path", "reader"),
    [
        ("nowhere", "may use it"),
        *(
            pytest.param(path, reader, marks=pytest.mark.thorough)
            for path, reader in ((None, "may use it"), ("store, public", "may not use it"))
        ),
    ],
)
def test_postgis_and_the_tables_are_found_in_their_schemas(
    cluster: Cluster, tmp_path: Path, path: str | None, reader: str
):
    with new_database(cluster) as (dsn, operator):
        operator(
            "create schema extensions",
            "create extension postgis schema extensions",
            "create schema store authorization {role}",
            "grant usage on schema extensions to {role}",
        )
        if reader == "may use it":
            operator("grant usage on schema extensions to {reader}")
        if path is not None:
            operator(f"alter database {{database}} set search_path = {path}")
        fill(dsn, tmp_path)
        for after in (path, "elsewhere"):
            operator(f"alter database {{database}} set search_path = {after or 'public'}")
            with served(dsn, tmp_path) as (client, me):
                items = client.get("/collections/points/items?f=csv", headers=me)
                assert items.status_code == 200, items.text
                assert len(items.text.splitlines()) == 6
                tile = client.get("/collections/points/tiles/WebMercatorQuad/0/0/0", headers=me)
                assert tile.status_code in (200, 204), tile.text
                assert client.get("/readyz").json()["parts"]["database"] == {"status": "ok"}
                changed = client.post("/blocks/calanques/withdraw", headers=me)
                assert changed.status_code == 200, changed.text
                assert client.post("/blocks/calanques/publish", headers=me).status_code == 200
        assert revisions.status(dsn).current


def test_a_role_that_may_only_read_serves_reads_and_names_what_is_missing(
    cluster: Cluster, tmp_path: Path
):
    with new_database(cluster) as (dsn, operator):
        operator("create extension postgis")
        fill(dsn, tmp_path)
        with served(dsn, tmp_path):
            pass  # the storage now belongs to the database
        operator(
            "create role {weak}",
            "grant {weak} to {role}",
            "grant select on all tables in schema public to {weak}",
            "grant insert on scene to {weak}",
            "alter role {role} in database {database} set role = {weak}",
        )
        with served(dsn, tmp_path) as (client, me):
            assert client.get("/collections/points/items", headers=me).status_code == 200
            refused = client.post("/blocks/calanques/withdraw", headers=me)
            assert refused.status_code == 503, refused.text
            assert "permission denied for table block" in refused.json()["detail"]
            assert "retry-after" not in refused.headers
            ready = client.get("/readyz")
            part = ready.json()["parts"]["database"]
            assert (ready.status_code, part["status"]) == (200, "degraded")
            assert "insert on block" in part["reason"]
            assert "insert on scene" not in part["reason"]


def test_a_role_without_any_right_gets_a_sentence_that_names_it(cluster: Cluster, tmp_path: Path):
    with new_database(cluster) as (dsn, operator):
        operator("create extension postgis")
        fill(dsn, tmp_path)
        operator(
            "create role {weak}",
            "grant {weak} to {role}",
            "alter role {role} in database {database} set role = {weak}",
        )
        with pytest.raises(psycopg.errors.InsufficientPrivilege) as refused:
            revisions.status(dsn)
        sentence, _ = failure(refused.value)
        assert "permission denied for table alembic_version" in sentence
        assert "its owner has to grant it" in sentence


def test_triggers_that_are_switched_off_are_refused(cluster: Cluster, dsn: str):
    name = sql.Identifier(str(conninfo_to_dict(dsn)["dbname"]))
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as operator:
        statement = "alter database {} set session_replication_role = replica"
        operator.execute(sql.SQL(statement).format(name))
    with (
        pytest.raises(revisions.InputError, match="reset session_replication_role"),
        revisions.driver_connection(dsn),
    ):
        pass
