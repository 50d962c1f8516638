"""STAC documents of scenes: their links, what filters may name, and reference systems."""

import json

import pystac
import pytest

ITEMS = "/collections/scenes/items"
CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
MERCATOR = "http://www.opengis.net/def/crs/EPSG/0/3857"


@pytest.fixture
def get(client, bearer):
    """GET as the owner of two scenes."""
    caller = bearer("register")
    for name in ("a", "b"):
        caller.post(f"/scenes?name={name}.tif", content=b"II*\0" + bytes(100))
    return lambda path, **parameters: caller.get(path, params=parameters or None)


def links(document):
    return {one["rel"]: one["href"] for one in document["links"]}


def test_every_document_of_stac_links_the_root_and_its_own_place(get):
    scene = get(ITEMS).json()["features"][0]["id"]
    for path, related in (
        ("/", {"self"}),
        ("/collections", {"self"}),
        ("/collections/scenes", {"self", "parent", "items"}),
        (ITEMS, {"self", "collection"}),
        (f"{ITEMS}/{scene}", {"self", "parent", "collection"}),
        ("/search", {"self"}),
    ):
        document = get(path).json()
        found = links(document)
        assert found["root"] == "http://testserver/", path
        assert related <= set(found), path
        assert found["self"] in (f"http://testserver{path}", found["root"]), path
        for one in document.get("features", []):
            assert {"root", "parent", "collection", "self"} <= set(links(one)), path
            assert pystac.Item.from_dict(one).collection_id == "scenes"


@pytest.mark.parametrize("crs", [CRS84, f"[{CRS84}]"])
def test_items_in_longitude_and_latitude_are_stac_when_that_is_said_too(get, crs):
    plain, named = get(ITEMS).json(), get(ITEMS, crs=crs).json()
    assert named["features"] == plain["features"]
    assert all(one["stac_version"] == "1.1.0" for one in named["features"])
    item = f"{ITEMS}/{plain['features'][0]['id']}"
    assert get(item, crs=crs).json() == get(item).json()
    assert "stac_version" not in get(item, crs=MERCATOR).json(), "STAC has no other reference system"
    assert get(item, crs="EPSG:4326").status_code == 400


def test_a_filter_of_stac_names_the_collection_as_well(get):
    for text, count in [
        ("collection = 'scenes'", 2),
        ("collection <> 'scenes'", 0),
        ("collection IN ('points', 'scenes')", 2),
        ("collection LIKE 'sc%' AND geometry IS NULL", 2),
        ("collection = 'scenes' AND id = 'none'", 0),
        ("datetime > TIMESTAMP('2020-01-01T00:00:00Z') AND collection IS NOT NULL", 2),
        ("CASEI(collection) = CASEI('SCENES')", 2),
    ]:
        for path in ("/search", ITEMS):
            reply = get(path, filter=text)
            assert reply.status_code == 200, reply.text
            assert reply.json()["numberMatched"] == count, path


def test_what_a_filter_may_name_is_what_the_queryables_state(get):
    stated = get(links(get("/").json())["http://www.opengis.net/def/rel/ogc/1.0/queryables"]).json()
    assert {"id", "collection", "geometry", "datetime"} <= set(stated["properties"])
    for name in set(stated["properties"]) - {"geometry"}:
        assert get("/search", filter=f'"{name}" IS NOT NULL').status_code == 200, name
    assert "collection" not in get("/collections/scenes/schema").json()["properties"]
    assert "collection" not in get("/collections/scenes/sortables").json()["properties"]
    assert get(ITEMS, sortby="collection").status_code == 400


def test_a_filter_in_json_names_the_collection(get):
    named = {"op": "=", "args": [{"property": "collection"}, "scenes"]}
    reply = get("/search", filter=json.dumps(named), **{"filter-lang": "cql2-json"})
    assert reply.json()["numberMatched"] == 2
