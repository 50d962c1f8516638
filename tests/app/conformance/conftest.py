"""The stores of the abstract tests: a published and a staged block."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pydantic import SecretStr

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.cluster.embedded import Cluster
from amers.app.main import create_app
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.tokens import create_token
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.served import serve_block
from tests.factories import MadeBlock, make_block
from tests.statements import run_sql

COLLECTIONS = ("points", "blocks", "density", "point-history", "scenes")
TAKEN = "2024-06-21T10:30:00.25Z"
"""When two scenes of `store_with_unknowns` were taken and one of its points was tried last."""


@dataclass(frozen=True)
class Store:
    """A service with a published block of 60 points, 3 of them with history; a staged one of 10 in the
    same place.

    Attributes:
        made: the published block.
        headers: of a caller with scope `read`.
    """

    made: MadeBlock
    client: TestClient
    headers: dict[str, str]
    dsn: str

    def get(self, path: str, accept: str | None = None, **parameters: Any) -> Any:
        """The reply to GET; parameters by name."""
        headers = self.headers if accept is None else {**self.headers, "Accept": accept}
        query = {name.replace("_", "-"): value for name, value in parameters.items()}
        return self.client.get(path, params=query or None, headers=headers)


@contextmanager
def filled_store(cluster: Cluster, folder: Path) -> Iterator[Store]:
    """A store in a database and a folder of its own."""
    made = make_block(folder / "block", count=60)
    staged = make_block(folder / "staged", count=10, seed=5, name="staged")
    with fresh_database(cluster, TEMPLATE) as dsn:
        settings = Settings(database_url=SecretStr(dsn), data_folder=folder / "data")
        with engine.connect(dsn) as connection:
            storage = Storage(settings.data_folder / "storage")
            serve_block(connection, storage, made.folder)
            run_sql(connection, "insert into point_history (point_id) select id from point limit 3")
            lifecycle.ingest_block(connection, storage, staged.folder)
            secret = create_token(connection, "a token to read", ["read"]).secret
        with TestClient(create_app(settings), raise_server_exceptions=False) as client:
            yield Store(made, client, {"Authorization": f"Bearer {secret}"}, dsn)


@pytest.fixture(scope="module")
def store(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """One store for all tests of a module: they change nothing."""
    with filled_store(cluster, tmp_path_factory.mktemp("store")) as store:
        yield store


@pytest.fixture(scope="module")
def store_with_unknowns(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """The store of the abstract tests with unknown times of points and histories, and three scenes.

    Of the 60 points three have no date, two no first and four no last one. A scene has an outline and a
    time, one lies elsewhere, one has neither.
    """
    with filled_store(cluster, tmp_path_factory.mktemp("odd")) as store:
        with engine.connect(store.dsn) as connection:
            secret = create_token(connection, "registers", ["read", "register"]).secret
        store.headers["Authorization"] = f"Bearer {secret}"
        scenes = [
            store.client.post(
                f"/scenes?name={name}.tif", content=b"II*\0" + bytes(100), headers=store.headers
            ).json()["id"]
            for name in ("here", "away", "nowhere")
        ]
        with engine.connect(store.dsn) as connection:
            for change in (
                "update point set first_view = null, last_view = null where id % 64 < 3",
                "update point set first_view = null where id % 64 between 3 and 4",
                "update point set last_view = null where id % 64 between 5 and 8",
                f"update point_history set last_attempt = '{TAKEN}' where point_id % 64 = 0",
            ):
                run_sql(connection, change)
            outline = "ST_MakeEnvelope({0}, 43, {0} + 0.2, 43.2, 4326)"
            for scene, west in ((scenes[0], 5), (scenes[1], 100)):
                change = f"update scene set footprint = {outline.format(west)}, acquired_at = %s"
                run_sql(connection, f"{change} where id = %s", (TAKEN, scene))
        yield store


@pytest.fixture
def own_store(cluster: Cluster, tmp_path: Path) -> Iterator[Store]:
    """A store that its test may change."""
    with filled_store(cluster, tmp_path) as store:
        yield store


@pytest.fixture
def made(store: Store) -> MadeBlock:
    """The published block."""
    return store.made


@pytest.fixture
def get(store: Store) -> Callable[..., Any]:
    """GET with scope `read`; parameters by name."""
    return store.get


@pytest.fixture
def ids(get: Callable[..., Any]) -> Callable[..., list[int]]:
    """The ids of the points that a query returns."""

    def ids(**parameters: Any) -> list[int]:
        reply = get("/collections/points/items", limit=1000, **parameters)
        assert reply.status_code == 200, reply.text
        return [feature["id"] for feature in reply.json()["features"]]

    return ids
