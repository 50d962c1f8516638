"""Features without time or geometry, dates and instants of each other, and RFC 3339.

Sources: OGC 17-069r4 (`fc-time-response`, `fc-bbox-response`), OGC 21-065r2, RFC 3339, STAC API 1.0.0.
"""

import re
from datetime import UTC, datetime, timedelta

import pytest

from amers.app.db.features.outlines import SCENES
from amers.app.db.features.predicates import BoxShape, box_predicate
from amers.app.db.points import POINTS
from tests.app.conformance.conftest import COLLECTIONS, TAKEN

FIRST, LAST = "2023-03-01", "2023-06-09"
"""Dates of the views of most points."""
INSTANT = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?Z")


@pytest.fixture(scope="module")
def store(store_with_unknowns):
    return store_with_unknowns


@pytest.fixture
def count(get):
    """The number of features of a collection that meet parameters: in the page, and as it states."""

    def count(name, **parameters):
        reply = get(f"/collections/{name}/items", limit=1000, **parameters)
        assert reply.status_code == 200, reply.text
        page = reply.json()
        counted = get(f"/collections/{name}/items", limit=1, **parameters).json()["numberMatched"]
        assert page["numberMatched"] == len(page["features"]) == counted, parameters
        return counted

    return count


@pytest.mark.parametrize("name", COLLECTIONS)
def test_req_core_fc_time_response_features_without_time_meet_every_span(count, name):
    everything = count(name)
    assert everything
    for span in ("1900-01-01T00:00:00Z/2100-01-01T00:00:00Z", "1900-01-01/..", "../2100-01-01", "../.."):
        assert count(name, datetime=span) == everything, span


def test_req_core_fc_time_response_an_unknown_end_is_open(count):
    assert count("points", datetime="1990-01-01") == 3 + 2, "those without dates, or without the first"
    assert count("points", datetime="2050-01-01") == 3 + 4, "those without dates, or without the last"
    assert count("point-history", datetime="1990-01-01") == 2
    assert count("point-history", datetime=TAKEN) == 3
    assert count("density", datetime="1990-01-01") == count("density"), "they have no time at all"
    assert count("scenes", datetime=TAKEN) == 2, "of the third, the time is that of its upload"


@pytest.mark.parametrize("name", COLLECTIONS)
def test_req_core_fc_bbox_response_features_without_geometry_meet_every_box(get, count, name):
    assert count(name, bbox="-180,-90,180,90") == count(name)
    assert count(name, bbox="-180,-90,-1000,180,90,9000") == count(name)
    assert count(name, bbox="170,-20,-170,20") == count(name, filter="geometry IS NULL")
    features = get(f"/collections/{name}/items", bbox="170,-20,-170,20").json()["features"]
    assert all(feature["geometry"] is None for feature in features)


def test_a_box_meets_scenes_inside_and_those_without_an_outline_and_intersects_only_the_former(
    count, get
):
    assert count("scenes", bbox="5,43,5.1,43.1") == 2
    assert count("scenes", bbox="0,0,1,1") == 1
    assert count("scenes", filter="S_INTERSECTS(geometry, BBOX(5, 43, 5.1, 43.1))") == 1
    shape = '{"type":"Polygon","coordinates":[[[5,43],[5.1,43],[5.1,43.1],[5,43]]]}'
    assert get("/search", bbox="5,43,5.1,43.1").json()["numberMatched"] == 1, "STAC: with an outline"
    assert get("/search", bbox="-180,-90,180,90").json()["numberMatched"] == 2
    assert get("/search", intersects=shape).json()["numberMatched"] == 1
    assert get("/search", datetime="1990-01-01T00:00:00Z/..").json()["numberMatched"] == 3


def test_the_plan_of_a_box_of_points_does_not_ask_for_points_without_a_place():
    assert "IS NULL" not in str(box_predicate(POINTS, BoxShape(1, False)))
    assert "IS NULL" in str(box_predicate(SCENES, BoxShape(1, False)))


@pytest.mark.parametrize(
    ("span", "meets"),
    [
        (f"{LAST}T23:59:59.999999Z/..", True),
        (f"{LAST}T15:00:00Z", True),
        (f"{LAST}T23:30:00-01:00", False),
        ("2023-06-10T00:30:00+01:00/..", True),
        ("2023-06-10T00:00:00Z/..", False),
        (f"../{FIRST}T00:00:00Z", True),
        (f"../{FIRST}T00:59:59+01:00", False),
        (f"{FIRST}/{FIRST}", True),
    ],
)
def test_a_date_of_a_feature_meets_every_instant_of_its_day(count, span, meets):
    known = count("points", filter="first_view IS NOT NULL AND last_view IS NOT NULL", datetime=span)
    assert known == (51 if meets else 0)


def test_a_date_that_is_asked_for_meets_every_instant_of_its_day(count):
    for span, meets in (
        ("2024-06-21", True),
        ("2024-06-21/..", True),
        ("../2024-06-21", False),
        ("2024-06-20", False),
        ("2024-06-22/2024-06-23", False),
        ("2024-06-20/2024-06-21", True),
        ("2024-06-21T", True),
    ):
        known = count("point-history", filter="last_attempt IS NOT NULL", datetime=span)
        later = count("scenes", filter='"amers:acquired" IS NOT NULL', datetime=span)
        assert (known, later) == ((1, 2) if meets or span == "../2024-06-21" else (0, 0)), span


COMPARED = (
    # dates of features with instants
    ("points", f"first_view = TIMESTAMP('{FIRST}T17:00:00Z')", 55),
    ("points", f"first_view <> TIMESTAMP('{FIRST}T17:00:00Z')", 0),
    ("points", f"first_view < TIMESTAMP('{FIRST}T17:00:00Z')", 0),
    ("points", f"first_view >= TIMESTAMP('{FIRST}T17:00:00Z')", 55),
    ("points", f"TIMESTAMP('{FIRST}T17:00:00Z') >= first_view", 55),
    ("points", f"last_view BETWEEN DATE('{FIRST}') AND TIMESTAMP('{LAST}T00:00:00Z')", 53),
    ("points", f"last_view IN (TIMESTAMP('{LAST}T11:00:00Z'))", 53),
    ("points", f"T_AFTER(last_view, TIMESTAMP('{LAST}T11:00:00Z'))", 0),
    ("points", f"T_BEFORE(last_view, TIMESTAMP('{LAST}T11:00:00Z'))", 0),
    ("points", f"T_EQUALS(last_view, TIMESTAMP('{LAST}T11:00:00Z'))", 53),
    ("points", f"T_INTERSECTS(last_view, INTERVAL('{LAST}T11:00:00Z', '..'))", 53),
    ("points", f"T_DISJOINT(last_view, INTERVAL('{LAST}T11:00:00Z', '..'))", 0),
    ("points", f"T_DURING(last_view, INTERVAL('{FIRST}', '2023-07-01T00:00:00Z'))", 53),
    # instants of features with dates
    ("scenes", "\"amers:acquired\" = DATE('2024-06-21')", 2),
    ("scenes", "\"amers:acquired\" <> DATE('2024-06-21')", 0),
    ("scenes", "\"amers:acquired\" > DATE('2024-06-21')", 0),
    ("scenes", "\"amers:acquired\" <= DATE('2024-06-21')", 2),
    ("scenes", "\"amers:acquired\" > DATE('2024-06-20')", 2),
    ("scenes", "\"amers:acquired\" = '2024-06-21'", 2),
    ("scenes", "T_AFTER(\"amers:acquired\", DATE('2024-06-21'))", 0),
    ("scenes", "T_DURING(\"amers:acquired\", INTERVAL('2024-06-20', '2024-06-22'))", 2),
    ("scenes", "T_INTERSECTS(\"amers:acquired\", DATE('2024-06-21'))", 2),
    # instants of each other
    ("scenes", f"\"amers:acquired\" = TIMESTAMP('{TAKEN}')", 2),
    ("scenes", "\"amers:acquired\" = TIMESTAMP('2024-06-21t12:30:00.250+02:00')", 2),
    ("scenes", "\"amers:acquired\" = TIMESTAMP('2024-06-21T10:30:00Z')", 0),
    # unknown
    ("points", "first_view IS NULL", 5),
    ("scenes", '"amers:acquired" IS NULL', 1),
    ("scenes", "\"amers:acquired\" < DATE('2100-01-01')", 2),
)


@pytest.mark.parametrize(("name", "text", "number"), COMPARED)
def test_req_temporal_comparisons_are_at_the_coarser_granularity_of_the_two(count, name, text, number):
    assert count(name, filter=text) == number


VALID = (
    "1985-04-12t23:20:50.000z",
    "1985-04-12T23:20:50.52-08:00",
    "1985-04-12T23:20:50.0123456789Z",
    "1985-04-12T23:20:50-00:00",
    "0001-01-01T00:00:00Z",
    "9999-12-31T23:59:59Z",
)
INVALID = (
    "1985-04-12T23:20:50",
    "1985-04-12T23:20:50,5Z",
    "1985-04-12T23:20:50.Z",
    "1985-04-12 23:20:50Z",
    "1985-04-12T23:20Z",
    "1985-04-12T24:00:00Z",
    "1985-04-12T23:60:00Z",
    "1990-12-31T23:59:60Z",
    "1985-04-12T23:20:50+0100",
    "1985-04-12T23:20:50+24:00",
    "1985-04-12T23:20:50+01:60",
    "1985-02-29T00:00:00Z",
    "1985-13-01",
    "19850412",
    "1985-W15-5",
    "0000-01-01T00:00:00Z",
    "21985-04-12T23:20:50Z",
    "0001-01-01T00:00:00+14:00",
    "9999-12-31T23:59:59-14:00",
    "\uff11985-04-12T23:20:50Z",
    "infinity",
)


def asked(store, text):
    """The replies to a time in each place that takes one."""
    get, items = store.get, "/collections/point-history/items"
    search, body = "/collections/point-history/search", {"datetime": text}
    literal = {"op": "<", "args": [{"property": "last_attempt"}, {"timestamp": text}]}
    within = {"op": "t_before", "args": [{"property": "last_attempt"}, {"interval": [text, ".."]}]}
    yield from (get(path, datetime=text) for path in (items, "/search", "/jobs"))
    yield from (get(items, datetime=span) for span in (f"{text}/..", f"../{text}"))
    yield get(items, filter=f"last_attempt < TIMESTAMP('{text}')")
    yield get(items, filter=f"last_attempt > '{text}'")
    yield get("/collections/points/items", filter=f"T_AFTER(last_view, INTERVAL('{text}', '..'))")
    for path, sent in (
        ("/search", body),
        (search, body),
        (search, {"filter": literal}),
        (search, {"filter": within}),
    ):
        yield store.client.post(path, json=sent, headers=store.headers)


@pytest.mark.parametrize("text", VALID)
def test_every_place_takes_an_instant_of_rfc_3339(store, text):
    for reply in asked(store, text):
        assert reply.status_code == 200, (reply.request.url, reply.text)


@pytest.mark.parametrize("text", INVALID)
def test_every_place_refuses_what_is_no_instant_of_rfc_3339_and_names_it(store, text):
    for reply in asked(store, text):
        assert reply.status_code == 400, (reply.request.url, reply.text)
        assert "found" in reply.json()["detail"]


def test_a_literal_of_a_date_holds_a_date_and_one_of_a_time_a_time(get):
    for text in ("DATE('2024-06-21T00:00:00Z')", "TIMESTAMP('2024-06-21')"):
        assert get("/collections/scenes/items", filter=f"created > {text}").status_code == 400, text


def test_a_search_of_stac_expects_instants_and_an_end(store):
    for span in ("2024-06-21", "2024-06-21/..", "../..", "/..", "../"):
        assert store.get("/search", datetime=span).status_code == 400, span
        sent = store.client.post("/search", json={"datetime": span}, headers=store.headers)
        assert sent.status_code == 400, span


def test_instants_of_replies_are_in_utc_with_z(store):
    found = []

    def walk(value, key=""):
        if isinstance(value, dict):
            for name, one in value.items():
                walk(one, name)
        elif isinstance(value, list):
            for one in value:
                walk(one, key)
        elif isinstance(value, str) and re.match(r"\d{4}-\d\d-\d\dT", value):
            found.append((key, value))

    for name in COLLECTIONS:
        page = store.get(f"/collections/{name}/items").json()
        walk(page)
        walk(store.get(f"/collections/{name}/items/{page['features'][0]['id']}").json())
        walk(store.get(f"/collections/{name}").json())
    walk(store.get("/search").json())
    walk(store.get("/scenes").json())
    text = store.get("/collections/scenes/items", f="csv").text
    found += [("csv", value) for value in re.findall(r"\d{4}-\d\d-\d\dT[^,\"\r]*", text)]
    assert len(found) > 20
    assert [pair for pair in found if not INSTANT.fullmatch(pair[1])] == []
    taken = [datetime.fromisoformat(value) for key, value in found if key == "amers:acquired"]
    assert taken
    assert set(taken) == {datetime(2024, 6, 21, 10, 30, tzinfo=UTC) + timedelta(seconds=0.25)}
