"""A real PostGIS for the tests: one private cluster a session, one database a test."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

import psycopg
import pytest
from fastapi.testclient import TestClient
from psycopg import sql
from pydantic import SecretStr

from app.config import Settings
from app.db import engine, revisions
from app.db.cluster.embedded import SUPERUSER, Cluster
from app.db.engine import Connection, Database
from app.main import create_app
from app.storage import MARKER, Storage
from app.usecases.tokens import create_token

if TYPE_CHECKING:
    from tests.app import full_storage

TEMPLATE = "amers_template"


@pytest.fixture(scope="session")
def cluster(open_folder: Path) -> Iterator[Cluster]:
    """A running cluster whose database `amers_template` has the schema."""
    cluster = Cluster(open_folder / "postgres", durable=False)
    with cluster.lease():
        with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as connection:
            connection.execute(sql.SQL("create database {}").format(sql.Identifier(TEMPLATE)))
        cluster.hand_over(TEMPLATE)
        revisions.upgrade(cluster.dsn(TEMPLATE))
        yield cluster


@contextmanager
def fresh_database(cluster: Cluster, template: str) -> Iterator[str]:
    """The connection string of a new database of the application's role, dropped at the end."""
    name = f"test_{uuid4().hex}"
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as connection:
        connection.execute(
            sql.SQL("create database {} template {}").format(
                sql.Identifier(name), sql.Identifier(template)
            )
        )
        try:
            cluster.hand_over(name)
            yield cluster.dsn(name)
        finally:
            connection.execute(sql.SQL("drop database {} with (force)").format(sql.Identifier(name)))


@pytest.fixture
def dsn(cluster: Cluster) -> Iterator[str]:
    """A database of this test alone, empty but for its tables."""
    with fresh_database(cluster, TEMPLATE) as dsn:
        yield dsn


@pytest.fixture
def empty_dsn(cluster: Cluster) -> Iterator[str]:
    """A database of this test alone without any table."""
    with fresh_database(cluster, "template1") as dsn:
        yield dsn


@pytest.fixture
def settings(dsn: str, tmp_path: Path) -> Settings:
    """Settings on the test's database and a temporary data folder."""
    return Settings(database_url=SecretStr(dsn), data_folder=tmp_path / "data")


@pytest.fixture
def storage(settings: Settings) -> Storage:
    """The storage that the client of the same test uses."""
    return Storage(settings.data_folder / "storage")


def stored_files(storage: Storage) -> list[Path]:
    """All files of a storage but the one that names its installation."""
    marker = storage.folder / MARKER
    return [path for path in storage.folder.rglob("*") if path.is_file() and path != marker]


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    """The test's database with its pools."""
    assert settings.database_url is not None
    with engine.pooled(settings.database_url.get_secret_value(), settings) as database:
        yield database


@pytest.fixture
def connection(dsn: str) -> Iterator[Connection]:
    """A connection in a transaction of its own; commit for others to see."""
    with engine.connect(dsn) as connection:
        yield connection


@pytest.fixture
def client(settings: Settings) -> Iterator[TestClient]:
    """The application, started, without a token; unexpected errors are replies, as for a real caller."""
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


@pytest.fixture
def token(dsn: str) -> Callable[[str], str]:
    """Makes a token with a scope and returns its secret."""

    def make(scope: str) -> str:
        with engine.connect(dsn) as connection:
            return create_token(connection, f"a token to {scope}", [scope]).secret

    return make


@pytest.fixture
def bearer(token: Callable[[str], str]) -> Callable[[str], dict[str, str]]:
    """Makes the headers of a caller with a scope: `client.get(path, headers=bearer("read"))`."""
    return lambda scope: {"Authorization": f"Bearer {token(scope)}"}


@pytest.fixture(params=["folder", "bucket"])
def kind(request: pytest.FixtureRequest) -> str:
    """The kind of a storage."""
    return str(request.param)


@pytest.fixture
def full(
    kind: str, dsn: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator["full_storage.Full"]:
    """An installation whose storage is full."""
    from tests.app import full_storage  # which needs this module

    with full_storage.filled(kind, dsn, tmp_path, monkeypatch) as full:
        yield full
