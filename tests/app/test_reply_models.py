"""Replies that no model has made, among them those of the database, follow the models of the API."""

from collections.abc import Callable
from typing import Any

import jsonschema
import pytest
from fastapi.testclient import TestClient

from tests.app.served import serve_block
from tests.factories import make_block
from tests.statements import run_sql

FIRST_POINT = 2**26

Check = Callable[[str, str], dict[str, Any]]


@pytest.fixture
def check(client: TestClient, bearer, connection, storage, tmp_path) -> Check:
    """Gets a path of a store with a block and a scene; checks the reply against a schema of the API."""
    serve_block(connection, storage, make_block(tmp_path / "block", count=20).folder)
    run_sql(connection, "insert into point_history (point_id) select id from point limit 3")
    connection.commit()
    caller = bearer("admin")
    assert caller.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100)).is_success
    components = client.get("/api").json()["components"]

    def check(path: str, name: str) -> dict[str, Any]:
        reply = caller.get(path)
        assert reply.status_code == 200, reply.text
        schema = {"$ref": f"#/components/schemas/{name}", "components": closed(components)}
        jsonschema.validate(reply.json(), schema)
        return dict(reply.json())

    return check


def closed(schema: Any) -> Any:
    """A schema whose objects have the described members and no others."""
    if isinstance(schema, list):
        return [closed(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    members = {name: closed(value) for name, value in schema.items()}
    if schema.get("type") == "object" and isinstance(schema.get("properties"), dict):
        members.setdefault("additionalProperties", False)
    return members


def test_a_page_that_the_database_makes_follows_the_schema_of_its_collection(check):
    for collection, name in [
        ("points", "PointPage"),
        ("blocks", "BlockPage"),
        ("density", "DensityPage"),
        ("point-history", "PointHistoryPage"),
    ]:
        page = check(f"/collections/{collection}/items", name)
        assert page["features"], collection
        streamed = check(f"/collections/{collection}/items?limit=10000", name)
        assert streamed["features"] == page["features"], collection
        feature = check(
            f"/collections/{collection}/items/{page['features'][0]['id']}", feature_model(name)
        )
        assert feature["id"] == page["features"][0]["id"], collection


def feature_model(page_model: str) -> str:
    """The model of one feature; that of a point has its views."""
    return "PointWithViews" if page_model == "PointPage" else page_model.replace("Page", "Feature")


def test_a_feature_has_every_property_that_its_schema_describes(check, client):
    schemas = client.get("/api").json()["components"]["schemas"]
    [point, *_] = check("/collections/points/items", "PointPage")["features"]
    assert set(point["properties"]) == set(schemas["PointFeatureProperties"]["properties"]) - {"id"}
    one = check(f"/collections/points/items/{FIRST_POINT}", "PointWithViews")
    assert set(one["properties"]) == set(schemas["PointProperties"]["properties"])


def test_stac_items_follow_their_models(check):
    page = check("/search", "StacItems")
    assert [check(f"/collections/scenes/items/{item['id']}", "StacItem") for item in page["features"]]
