"""The store of the abstract tests: a published and a staged block."""

from collections.abc import Callable
from typing import Any

import pytest

from app.usecases.blocks import lifecycle
from tests.factories import make_block
from tests.statements import run_sql


@pytest.fixture
def made(connection, storage, tmp_path):
    """A published block of 60 points, 3 of them with history; a staged one of 10 in the same place."""
    made = make_block(tmp_path / "block", count=60)
    lifecycle.ingest_block(connection, storage, made.folder)
    lifecycle.publish_block(connection, "calanques")
    run_sql(connection, "insert into point_history (point_id) select id from point limit 3")
    staged = make_block(tmp_path / "staged", count=10, seed=5, name="staged")
    lifecycle.ingest_block(connection, storage, staged.folder)
    connection.commit()
    return made


@pytest.fixture
def get(made, client, bearer) -> Callable[..., Any]:
    """GET with scope `read`; parameters by name."""
    headers = bearer("read")

    def get(path: str, accept: str | None = None, **parameters: Any) -> Any:
        all_headers = headers if accept is None else {**headers, "Accept": accept}
        query = {name.replace("_", "-"): value for name, value in parameters.items()}
        return client.get(path, params=query or None, headers=all_headers)

    return get


@pytest.fixture
def ids(get) -> Callable[..., list[int]]:
    """The ids of the points that a query returns."""

    def ids(**parameters: Any) -> list[int]:
        reply = get("/collections/points/items", limit=1000, **parameters)
        assert reply.status_code == 200, reply.text
        return [feature["id"] for feature in reply.json()["features"]]

    return ids
