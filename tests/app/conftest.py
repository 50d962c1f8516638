"""A real PostGIS for the tests: one private cluster a session, one database a test."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

import httpx
import psycopg
import pytest
from fastapi.testclient import TestClient
from psycopg import sql
from pydantic import SecretStr

from amers.app.config import Settings
from amers.app.db import engine, revisions
from amers.app.db.cluster.embedded import ROLE, SUPERUSER, Cluster
from amers.app.db.engine import Connection, Database
from amers.app.main import create_app
from amers.app.storage import MARKER, Storage
from amers.app.usecases.tokens import create_token, list_tokens
from tests.app.callers import Bearer, Caller

if TYPE_CHECKING:
    from tests.app import full_storage, installation

TEMPLATE = "amers_template"
EMPTY_TEMPLATE = "amers_empty"


@pytest.fixture(scope="session")
def cluster(cluster_folder: Path) -> Iterator[Cluster]:
    """A running cluster with two databases of the application's role: one with the schema, one empty."""
    cluster = Cluster(cluster_folder, durable=False)
    with cluster.lease():
        with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as connection:
            for name in (EMPTY_TEMPLATE, TEMPLATE):
                connection.execute(sql.SQL("create database {}").format(sql.Identifier(name)))
                cluster.hand_over(name)
        revisions.upgrade(cluster.dsn(TEMPLATE))
        yield cluster


@pytest.fixture(scope="session", autouse=True)
def one_warm_connection() -> Iterator[None]:
    """Applications in the process of the tests open one connection of each pool at their start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "WARM_CONNECTIONS", 1)
        yield


@contextmanager
def fresh_database(cluster: Cluster, template: str) -> Iterator[str]:
    """The connection string of a copy of a database of the application's role, dropped at the end."""
    name = f"test_{uuid4().hex}"
    with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as connection:
        connection.execute(
            # Copied as files: through the log, the server works twice as long.
            sql.SQL("create database {} template {} owner {} strategy file_copy").format(
                *map(sql.Identifier, (name, template, ROLE))
            )
        )
        try:
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
    with fresh_database(cluster, EMPTY_TEMPLATE) as dsn:
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
        client.event_hooks = {"response": [refuse_shared_caches]}
        yield client


def refuse_shared_caches(reply: httpx.Response) -> None:
    """Nothing that a token opens may stay in a cache that people share, whatever a test asks for.

    The files of the map page are for everybody.
    """
    if "authorization" in reply.request.headers and not reply.url.path.startswith("/map"):
        directives = {one.strip().lower() for one in reply.headers["cache-control"].split(",")}
        assert directives & {"no-store", "private"}, (reply.url, directives)
        assert not any(one.startswith(("public", "s-maxage")) for one in directives), reply.url


@pytest.fixture
def token(dsn: str) -> Callable[[str], str]:
    """Makes a token with a scope and returns its secret."""

    def make(scope: str) -> str:
        with engine.connect(dsn) as connection:
            taken = {token.name for token in list_tokens(connection)}
            names = chain([f"a token to {scope}"], (f"token {n} to {scope}" for n in count(2)))
            name = next(name for name in names if name not in taken)
            return create_token(connection, name, [scope]).secret

    return make


@pytest.fixture
def bearer(token: Callable[[str], str], request: pytest.FixtureRequest) -> Bearer:
    """Makes a caller with a scope: `bearer("read").get(path)`; it is also the headers of that caller."""

    def client() -> TestClient:
        client: TestClient = request.getfixturevalue("client")
        return client

    return lambda scope: Caller(client, {"Authorization": f"Bearer {token(scope)}"})


@pytest.fixture
def me(client: TestClient, bearer: Bearer) -> Caller:
    """A caller of the started application who may register scenes."""
    return bearer("register")


@pytest.fixture
def admin(client: TestClient, bearer: Bearer) -> Caller:
    """An administrator who calls the started application."""
    return bearer("admin")


@pytest.fixture
def installation(
    client: TestClient, me: Caller, settings: Settings, dsn: str, storage: Storage, tmp_path: Path
) -> Iterator["installation.Installation"]:
    """An installation without points; the log of its workers is printed when the test fails."""
    from tests.app.installation import Installation  # which needs this module

    log = tmp_path / "worker.log"
    log.touch()
    yield Installation(client, me, settings, dsn, storage, log)
    print(log.read_text())


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
