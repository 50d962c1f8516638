"""OGC API - Features - Part 1: Core 1.0 (OGC 17-069r4), each test named after its requirement."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from amers.app.db import engine
from tests.statements import run_sql

COLLECTIONS = ("points", "blocks", "density", "point-history")
a_tenth_of_a_millimetre_deg = 1e-9
GEOJSON = "application/geo+json"


def link(document, rel, kind=None):
    found = [
        item
        for item in document["links"]
        if item["rel"] == rel and (kind is None or item["type"].startswith(kind))
    ]
    assert found, f"no link {rel} {kind}"
    return found[0]["href"]


def test_req_core_root_success(get):
    page = get("/").json()
    assert page["title"] == "Amers"
    for rel in ("service-desc", "service-doc", "conformance", "data", "self"):
        assert get(link(page, rel)).status_code == 200


def test_req_core_api_definition_success(get):
    reply = get(link(get("/").json(), "service-desc"))
    assert reply.headers["content-type"] == "application/vnd.oai.openapi+json;version=3.1"
    document = reply.json()
    assert document["openapi"].startswith("3.1")
    limit = {
        item["name"]: item
        for item in document["paths"]["/collections/points/items"]["get"]["parameters"]
    }["limit"]["schema"]
    assert (limit["type"], limit["minimum"], limit["maximum"], limit["default"]) == (
        "integer",
        1,
        10_000,
        100,
    )
    assert get(link(get("/").json(), "service-doc")).headers["content-type"].startswith("text/html")


def test_req_core_fc_bbox_definition_and_fc_time_definition(get):
    paths = get(link(get("/").json(), "service-desc")).json()["paths"]
    for name in COLLECTIONS:
        asked = paths[f"/collections/{name}/items"]["get"]["parameters"]
        defined = {item["name"]: item for item in asked}
        bbox = defined["bbox"]
        assert (bbox["in"], bbox["required"], bbox["style"], bbox["explode"]) == (
            "query",
            False,
            "form",
            False,
        )
        assert (bbox["schema"]["type"], bbox["schema"]["items"]["type"]) == ("array", "number")
        assert (bbox["schema"]["minItems"], bbox["schema"]["maxItems"]) == (4, 6)
        assert defined["datetime"]["schema"]["type"] == "string"
        assert {"saliency", "typology", "first_view"} <= set(defined) or name != "points"


def test_req_core_conformance_success(get):
    classes = get("/conformance").json()["conformsTo"]
    for name in ("core", "geojson", "html"):
        assert f"http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/{name}" in classes
    assert len(set(classes)) == len(classes)


def test_req_core_fc_md_success(get):
    listed = get("/collections").json()
    assert [one["id"] for one in listed["collections"]] == list(COLLECTIONS)
    assert link(listed, "self")
    assert link(listed, "alternate", "text/html")


@pytest.mark.parametrize("name", COLLECTIONS)
def test_req_core_sfc_md_success(get, name):
    one = get(f"/collections/{name}").json()
    assert one in get("/collections").json()["collections"]
    west, south, east, north = one["extent"]["spatial"]["bbox"][0]
    assert -180 <= west < east <= 180
    assert -90 <= south < north <= 90
    for item in one["links"]:
        assert {"rel", "href", "type"} <= set(item)
        assert get(item["href"]).status_code == 200, item


@pytest.mark.parametrize("name", COLLECTIONS)
def test_req_core_fc_response(get, name):
    reply = get(f"/collections/{name}/items", limit=1)
    assert reply.headers["content-type"] == GEOJSON
    page = reply.json()
    assert page["type"] == "FeatureCollection"
    assert page["numberReturned"] == len(page["features"]) == 1
    assert page["numberMatched"] >= 1
    assert link(page, "self", GEOJSON)
    assert link(page, "alternate", "text/html")
    feature = page["features"][0]
    assert feature["type"] == "Feature"
    single = get(f"/collections/{name}/items/{feature['id']}")
    assert single.headers["content-type"] == GEOJSON
    geometry = single.json()["geometry"]
    assert geometry["type"] == feature["geometry"]["type"]
    assert_allclose(
        geometry["coordinates"], feature["geometry"]["coordinates"], atol=a_tenth_of_a_millimetre_deg
    )


@pytest.mark.parametrize("name", COLLECTIONS)
def test_req_core_f_links(get, name):
    feature = get(f"/collections/{name}/items", limit=1).json()["features"][0]
    one = get(f"/collections/{name}/items/{feature['id']}").json()
    assert get(link(one, "self")).json()["id"] == feature["id"]
    assert link(one, "collection").endswith(f"/collections/{name}")


@pytest.mark.parametrize("name", COLLECTIONS)
def test_req_core_fc_limit_response(get, name):
    total = get(f"/collections/{name}/items", limit=1).json()["numberMatched"]
    for limit in (1, 2, 10_000, 1_000_000):
        assert get(f"/collections/{name}/items", limit=limit).json()["numberReturned"] == min(
            limit, total
        )


def test_req_core_fc_bbox_response(get, ids, made):
    lon, lat, height = made.points.lon_lat_h.T
    inside = (lon >= 5.22) & (lon <= 5.27) & (lat >= 43.21) & (lat <= 43.26)
    assert ids(bbox="5.22,43.21,5.27,43.26") == (2**26 + np.flatnonzero(inside)).tolist()
    low = inside & (height <= 200.0)
    assert ids(bbox="5.22,43.21,0,5.27,43.26,200") == (2**26 + np.flatnonzero(low)).tolist()
    assert 0 < low.sum() < inside.sum()


def test_req_core_fc_time_response(get, ids):
    # Views are of 2023-03-01 to 2023-06-09; the last image has no time.
    everything = ids()
    for inside in (
        "2023-03-01",
        "2023-05-05T00:00:00Z",
        "../2023-03-01",
        "2023-06-09/..",
        "2020-01-01/",
    ):
        assert ids(datetime=inside) == everything, inside
    for outside in ("2023-02-28", "../2023-02-28T23:59:59Z", "2023-06-10/..", "2024-01-01/2025-01-01"):
        assert ids(datetime=outside) == [], outside


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("limit", "0"),
        ("limit", "ten"),
        ("bbox", "1,2,3"),
        ("bbox", "1,2,3,x"),
        ("datetime", "yesterday"),
        ("datetime", "2024-01-02/2023-01-01"),
        ("datetime", "/"),
        ("f", "shp"),
        ("crs", "http://www.opengis.net/def/crs/EPSG/0/2154"),
        ("sortby", "colour"),
        ("properties", "colour"),
        ("token", "AAAA"),
    ],
)
def test_req_core_query_param_invalid(get, name, value):
    reply = get("/collections/points/items", **{name: value})
    assert reply.status_code == 400
    assert reply.headers["content-type"] == "application/problem+json"
    assert name in reply.json()["detail"]


@pytest.mark.parametrize(
    "path", ["/", "/conformance", "/collections", "/collections/points", "/collections/points/items"]
)
def test_req_core_query_param_unknown(get, path):
    reply = get(path, colour="red")
    assert reply.status_code == 400
    assert "colour" in reply.json()["detail"]


def test_req_core_http_not_found(get):
    for path in ("roads", "roads/items", "blocks/items/none", "density/items/1.5", "points/items/1"):
        assert get(f"/collections/{path}").status_code == 404, path


def test_req_core_fc_links_next_page_while_data_change(own_store):
    first = own_store.get("/collections/points/items", limit=25).json()
    with engine.connect(own_store.dsn) as connection:
        run_sql(connection, "update block set state = 'published' where id = 'staged'")
    seen, page = [feature["id"] for feature in first["features"]], first
    while following := [item for item in page["links"] if item["rel"] == "next"]:
        page = own_store.get(following[0]["href"]).json()
        seen += [feature["id"] for feature in page["features"]]
    assert seen[:60] == (2**26 + np.arange(60)).tolist()
    assert len(seen) == len(set(seen)) == 70


@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/conformance",
        "/api",
        "/collections",
        "/collections/points",
        "/collections/points/items",
        "/collections/density/items",
        "/collections/blocks/items/1",
        f"/collections/points/items/{2**26}",
        "/collections/points/queryables",
    ],
)
def test_req_html_definition_and_content(get, path):
    for reply in (get(path, f="html"), get(path, accept="text/html,application/json;q=0.5")):
        assert reply.status_code == 200
        assert reply.headers["content-type"].startswith("text/html")
        assert "<h1>" in reply.text
        assert "<script" not in reply.text
        assert reply.headers["content-security-policy"] == (
            "default-src 'none'; style-src 'unsafe-inline'; img-src 'self' data:; form-action 'self'; "
            "frame-ancestors 'none'"
        )
