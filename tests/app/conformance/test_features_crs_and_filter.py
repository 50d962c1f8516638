"""OGC API - Features Part 2 (CRS), Part 3 (filtering), CQL2: each test named after its requirement."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pyproj import Transformer

CRS = "http://www.opengis.net/def/crs/"
CRS84, CRS84H = f"{CRS}OGC/1.3/CRS84", f"{CRS}OGC/0/CRS84h"
ITEMS, SEARCH = "/collections/points/items", "/collections/points/search"
a_tenth_of_a_millimetre_deg = 1e-9
a_millimetre = 1e-3


def coordinates(reply):
    return np.array([feature["geometry"]["coordinates"] for feature in reply.json()["features"]])


def test_req_crs_fc_md_crs_list_and_storage_crs(get):
    points, blocks = (get(f"/collections/{name}").json() for name in ("points", "blocks"))
    assert points["storageCrs"] == points["crs"][0] == CRS84H
    assert blocks["storageCrs"] == blocks["crs"][0] == CRS84
    for uri in (f"{CRS}EPSG/0/4326", f"{CRS}EPSG/0/3857"):
        assert uri in points["crs"]
        assert uri in blocks["crs"]
    assert f"{CRS}EPSG/0/4979" in points["crs"]


def test_req_crs_fc_crs_action(get, made):
    lon_lat_h = made.points.lon_lat_h
    asked = {
        CRS84H: lon_lat_h,
        CRS84: lon_lat_h[:, :2],
        f"{CRS}EPSG/0/4979": lon_lat_h[:, [1, 0, 2]],
        f"{CRS}EPSG/0/4326": lon_lat_h[:, [1, 0]],
    }
    for uri, expected in asked.items():
        reply = get(ITEMS, crs=uri)
        assert reply.headers["content-crs"] == f"<{uri}>"
        assert_allclose(coordinates(reply), expected, rtol=0, atol=a_tenth_of_a_millimetre_deg)
    mercator = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True)
    expected = np.column_stack(mercator.transform(lon_lat_h[:, 0], lon_lat_h[:, 1]))
    assert_allclose(
        coordinates(get(ITEMS, crs=f"{CRS}EPSG/0/3857")), expected, rtol=0, atol=a_millimetre
    )


def test_req_crs_crs_of_one_feature(get):
    reply = get(f"{ITEMS}/{2**26}", crs=f"{CRS}EPSG/0/4326")
    assert reply.headers["content-crs"] == f"<{CRS}EPSG/0/4326>"
    assert reply.json()["geometry"]["coordinates"][0] == pytest.approx(43.25, abs=0.06)


def test_req_crs_fc_bbox_crs_action(get, ids):
    expected = ids(bbox="5.22,43.21,5.27,43.26")
    assert 0 < len(expected) < 60
    assert ids(bbox="43.21,5.22,43.26,5.27", bbox_crs=f"{CRS}EPSG/0/4326") == expected
    mercator = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True)
    corners = [*mercator.transform(5.22, 43.21), *mercator.transform(5.27, 43.26)]
    text = ",".join(map(repr, map(float, corners)))
    assert ids(bbox=text, bbox_crs=f"{CRS}EPSG/0/3857") == expected


@pytest.mark.parametrize("name", ["crs", "bbox-crs", "filter-crs"])
def test_req_crs_fc_crs_valid_value(get, name):
    reply = get(ITEMS, **{name: f"{CRS}EPSG/0/2154", "bbox": "0,0,1,1", "filter": "id=1"})
    assert reply.status_code == 400
    assert name in reply.json()["detail"]


@pytest.mark.parametrize("name", ["points", "blocks", "density"])
def test_req_queryables_get_queryables_response(get, name):
    reply = get(f"/collections/{name}/queryables")
    assert reply.headers["content-type"].startswith("application/schema+json")
    document = reply.json()
    assert document["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert document["$id"].endswith(f"/collections/{name}/queryables")
    assert document["type"] == "object"
    assert document["properties"]["geometry"]["format"].startswith("geometry-")
    first = get(f"/collections/{name}/items", limit=1).json()["features"][0]
    assert set(first["properties"]) < set(document["properties"])
    assert set(first["properties"]) < set(get(f"/collections/{name}/schema").json()["properties"])


def test_req_queryables_query_parameters(get, ids, made):
    assert len(ids(typology="crossroads")) == 15
    assert get(ITEMS, **{"n_views": "three"}).status_code == 400


def test_req_filter_filter_lang_param(get, ids):
    text = ids(filter="saliency > 0.5")
    assert 0 < len(text) < 60
    document = json.dumps({"op": ">", "args": [{"property": "saliency"}, 0.5]})
    assert ids(filter=document, filter_lang="cql2-json") == text
    assert get(ITEMS, filter="saliency > 0.5", filter_lang="sql").status_code == 400


def test_req_filter_filter_crs_param(ids):
    box = "S_INTERSECTS(geometry, BBOX({}))"
    expected = ids(filter=box.format("5.22,43.21,5.27,43.26"))
    swapped = "POLYGON((43.21 5.22, 43.26 5.22, 43.26 5.27, 43.21 5.27, 43.21 5.22))"
    assert 0 < len(expected) < 60
    found = ids(filter=f"S_INTERSECTS(geometry, {swapped})", filter_crs=f"{CRS}EPSG/0/4326")
    assert found == expected


def test_req_filter_mixing_expressions_with_bbox_and_datetime(ids):
    both = ids(filter="saliency > 0.5", bbox="5.22,43.21,5.27,43.26")
    assert set(both) == set(ids(filter="saliency > 0.5")) & set(ids(bbox="5.22,43.21,5.27,43.26"))
    assert ids(filter="saliency > 0.5", datetime="2000-01-01") == []


CASES = (
    ("basic-cql2", "saliency >= 0.25 and saliency < 0.75", lambda p: (p >= 0.25) & (p < 0.75)),
    ("basic-cql2", "not (saliency > 0.5) or saliency > 0.9", lambda p: (p <= 0.5) | (p > 0.9)),
    ("basic-cql2", "saliency <> 0.5", lambda p: p != 0.5),
    ("basic-cql2", "true", lambda p: p >= 0),
    ("advanced-comparison-operators", "saliency between 0.2 and 0.4", lambda p: (p >= 0.2) & (p <= 0.4)),
    ("advanced-comparison-operators", "n_views in (2, 3)", lambda p: p >= 0),
    ("arithmetic", "saliency * 2 - 1 > 0.2 / 4", lambda p: p * 2 - 1 > 0.05),
    ("property-property", "saliency < n_views", lambda p: p < 3),
)


@pytest.mark.parametrize(("conformance_class", "text", "meant"), CASES)
def test_req_cql2_numbers(ids, made, conformance_class, text, meant):
    expected = 2**26 + np.flatnonzero(meant(made.points.saliency))
    assert ids(filter=text) == expected.tolist()


TEXTS = (
    ("typology = 'crossroads'", 15),
    ("typology = 'a \"rare\" kind'", 15),
    ("typology is null", 15),
    ("typology is not null", 45),
    ("typology like 'cross%'", 15),
    ("typology not like 'cross%'", 30),
    ("typology in ('crossroads', 'building corner')", 30),
    ("casei(typology) = casei('CrossRoads')", 15),
    ("casei(typology) like casei('CROSS%')", 15),
    ("typology = 'it''s not there; drop table point'", 0),
)


@pytest.mark.parametrize(("text", "count"), TEXTS)
def test_req_cql2_texts(ids, text, count):
    assert len(ids(filter=text)) == count


TIMES = (
    ("first_view = DATE('2023-03-01')", 60),
    ("first_view < DATE('2023-03-01')", 0),
    ("last_view >= TIMESTAMP('2023-06-09T00:00:00Z')", 60),
    ("t_after(first_view, DATE('2023-02-01'))", 60),
    ("t_before(first_view, DATE('2023-02-01'))", 0),
    ("t_intersects(INTERVAL(first_view, last_view), INTERVAL('2023-04-01', '..'))", 60),
    ("t_during(INTERVAL(first_view, last_view), INTERVAL('2023-04-01', '..'))", 0),
    ("t_contains(INTERVAL(first_view, last_view), INTERVAL('2023-04-01', '2023-04-02'))", 60),
)


@pytest.mark.parametrize(("text", "count"), TIMES)
def test_req_cql2_temporal_functions(ids, text, count):
    assert len(ids(filter=text)) == count


TRIANGLE = "POLYGON((5.2 43.2, 5.3 43.2, 5.2 43.3, 5.2 43.2))"


@pytest.mark.parametrize(
    ("text", "inside"),
    [
        (f"s_intersects(geometry, {TRIANGLE})", True),
        (f"s_within(geometry, {TRIANGLE})", True),
        (f"s_disjoint(geometry, {TRIANGLE})", False),
        (f"not s_intersects(geometry, {TRIANGLE})", False),
    ],
)
def test_req_cql2_spatial_functions(ids, made, text, inside):
    lon, lat = made.points.lon_lat_h[:, 0], made.points.lon_lat_h[:, 1]
    below = (lon - 5.2) + (lat - 43.2) < 0.1
    assert ids(filter=text) == (2**26 + np.flatnonzero(below == inside)).tolist()


@pytest.mark.parametrize(
    "text",
    [
        "pg_sleep(5) is null",
        "pg_read_file('/etc/passwd') = 'x'",
        "colour = 1",
        "block_number; drop table point",
        "saliency = 'high'",
        "typology = 3",
        "typology",
        "saliency + 1",
        "first_view > 'yesterday'",
        "s_intersects(saliency, POINT(0 0))",
        "s_intersects(geometry, POINT(500 0))",
        "s_within(geometry, POLYGON((0 0, 1 1, 1 0, 0 1, 0 0)))",
        "saliency = 1 and",
        "((((",
        "(" * 17 + "id = 1" + ")" * 17,
        "not " * 2000 + "id = 1",
        "typology like 'x\\'",
        "saliency > 1e300",
        "",
    ],
)
def test_req_filter_that_cannot_be_used_is_refused(get, text):
    reply = get(ITEMS, filter=text)
    assert reply.status_code == 400, reply.text
    assert "filter" in reply.json()["detail"]


def test_req_filter_json_that_is_too_deep_or_no_cql2_is_refused(get):
    deep = {"op": "=", "args": [{"property": "id"}, 1]}
    for _ in range(40):
        deep = {"op": "not", "args": [deep]}
    for document in (deep, {"op": "="}, {"op": "pg_sleep", "args": [1]}, [], "x", None, {"args": []}):
        reply = get(ITEMS, filter=json.dumps(document), filter_lang="cql2-json")
        assert reply.status_code == 400, document
    assert get(ITEMS, filter="[" * 5000, filter_lang="cql2-json").status_code == 400


def pages(store, method, **question):
    """The features of each page that a GET or a search by POST leads to."""
    url, asked = (ITEMS, {"params": question}) if method == "GET" else (SEARCH, {"json": question})
    found = []
    while url:
        reply = store.client.request(method, url, headers=store.headers, **asked)
        assert reply.status_code == 200, reply.text
        found.append(reply.json()["features"])
        link = next((item for item in reply.json()["links"] if item["rel"] == "next"), {})
        url, asked = link.get("href"), {"json": link["body"]} if "body" in link else {}
    return found


def test_the_pages_of_a_search_by_post_are_those_of_a_get_with_all_parameters(store):
    lat_first = f"{CRS}EPSG/0/4326"
    triangle = {"type": "Polygon", "coordinates": [[[43.2, 5.2], [43.2, 5.3], [43.3, 5.2], [43.2, 5.2]]]}
    question = {
        "bbox": "43.2,5.21,43.29,5.3",
        "bbox-crs": lat_first,
        "datetime": "2023-01-01/..",
        "filter": json.dumps({"op": "s_intersects", "args": [{"property": "geometry"}, triangle]}),
        "filter-lang": "cql2-json",
        "filter-crs": lat_first,
        "crs": lat_first,
        "sortby": "-saliency",
        "properties": "saliency,n_views",
        "limit": 7,
    }
    found = pages(store, "GET", **question)
    assert len(found) > 2
    assert pages(store, "POST", **question) == found


@pytest.mark.parametrize("sortby", ["-saliency", "typology,-saliency", "+saliency", "-first_view"])
def test_req_sorting_pages_follow_each_other(get, store, sortby):
    whole = get(ITEMS, sortby=sortby, limit=100).json()["features"]
    seen = [one for page in pages(store, "GET", sortby=sortby, limit=7) for one in page]
    assert [one["id"] for one in seen] == [one["id"] for one in whole]
    assert len({one["id"] for one in seen}) == 60
    saliency = [one["properties"]["saliency"] for one in whole]
    if sortby.lstrip("+-") == "saliency":
        assert saliency == sorted(saliency, reverse=sortby[0] == "-")


def test_a_polygon_too_long_for_a_url_is_searched_by_post_page_after_page(made, store):
    angle = np.linspace(0.0, 2.0 * np.pi, 5_000)
    ring = np.column_stack([5.25 + 0.04 * np.cos(angle), 43.25 + 0.04 * np.sin(angle)])
    ring[-1] = ring[0]
    inside = {"type": "Polygon", "coordinates": [ring.tolist()]}
    found = pages(store, "POST", intersects=inside, limit=10)
    seen = [feature["id"] for page in found for feature in page]
    away = np.hypot(*(made.points.lon_lat_h[:, :2] - [5.25, 43.25]).T)
    assert seen == (2**26 + np.flatnonzero(away < 0.04)).tolist()
    assert len(seen) > 10
