"""CQL2 (OGC 21-065r2): spatial and temporal functions, arithmetic, both encodings; named by class."""

import json

import numpy as np
import psycopg
import pytest
import shapely

BLOCK = shapely.box(5.2, 43.2, 5.3, 43.3)
"""The outline of the block that the tests publish."""

LITERALS = {
    "point inside": "POINT(5.25 43.25)",
    "point on the edge": "POINT(5.2 43.25)",
    "point away": "POINT(6 44)",
    "points inside and away": "MULTIPOINT((5.25 43.25), (6 44))",
    "line inside": "LINESTRING(5.21 43.21, 5.29 43.29)",
    "line across": "LINESTRING(5.1 43.25, 5.4 43.25)",
    "line along the edge": "LINESTRING(5.2 43.2, 5.2 43.3)",
    "lines across and away": "MULTILINESTRING((5.1 43.25, 5.4 43.25), (6 44, 7 44))",
    "the block": "POLYGON((5.2 43.2, 5.3 43.2, 5.3 43.3, 5.2 43.3, 5.2 43.2))",
    "polygon around": "POLYGON((5 43, 6 43, 6 44, 5 44, 5 43))",
    "polygon inside": "POLYGON((5.21 43.21, 5.29 43.21, 5.29 43.29, 5.21 43.21))",
    "polygon over a side": "POLYGON((5.25 43.21, 5.4 43.21, 5.4 43.29, 5.25 43.21))",
    "polygon beside": "POLYGON((5.3 43.2, 5.4 43.2, 5.4 43.3, 5.3 43.3, 5.3 43.2))",
    "polygon away": "POLYGON((6 44, 7 44, 7 45, 6 44))",
    "polygons inside and away": (
        "MULTIPOLYGON(((5.21 43.21, 5.29 43.21, 5.29 43.29, 5.21 43.21)),((6 44, 7 44, 7 45, 6 44)))"
    ),
}
SPATIAL = ("intersects", "contains", "crosses", "disjoint", "equals", "overlaps", "touches", "within")


@pytest.fixture
def found(own_store):
    """Whether the published block meets a filter; its outline is the one that its document declares."""
    with psycopg.connect(own_store.dsn) as connection:
        connection.execute("update block set outline = null")

    def found(text: str) -> bool:
        reply = own_store.get("/collections/blocks/items", filter=text)
        assert reply.status_code == 200, reply.text
        return reply.json()["numberReturned"] == 1

    return found


def test_spatial_functions_are_those_of_simple_features(found):
    for name in SPATIAL:
        expected = {
            said: bool(getattr(shapely, name)(BLOCK, shapely.from_wkt(text)))
            for said, text in LITERALS.items()
        }
        assert len(set(expected.values())) == 2
        assert {
            said: found(f"s_{name}(geometry, {text})") for said, text in LITERALS.items()
        } == expected


def test_spatial_functions_of_points_are_those_of_simple_features(ids, made):
    places = shapely.points(made.points.lon_lat_h[:, :2])
    lon, lat = made.points.lon_lat_h[7, :2].tolist()
    literals = [LITERALS[said] for said in ("line inside", "polygon inside", "polygons inside and away")]
    for name in SPATIAL:
        for text in (f"POINT({lon!r} {lat!r})", *literals):
            expected = getattr(shapely, name)(places, shapely.from_wkt(text))
            answer = ids(filter=f"s_{name}(geometry, {text})")
            assert answer == (2**26 + np.flatnonzero(expected)).tolist(), (name, text)


def test_basic_spatial_functions_take_a_box_and_plus_a_collection_of_geometries(found):
    assert found("s_intersects(geometry, BBOX(5.29, 43.29, 6, 44))")
    assert not found("s_intersects(geometry, BBOX(5.31, 43.29, 6, 44))")
    assert found("s_intersects(geometry, GEOMETRYCOLLECTION(POINT(5.25 43.25), POINT(6 44)))")
    assert not found("s_intersects(geometry, GEOMETRYCOLLECTION(POINT(6 43), POINT(6 44)))")


def test_relations_that_a_collection_of_geometries_does_not_have_are_refused(get):
    for name in set(SPATIAL) - {"intersects"}:
        text = f"s_{name}(geometry, GEOMETRYCOLLECTION(POINT(5.25 43.25), LINESTRING(6 44, 7 44)))"
        reply = get("/collections/blocks/items", filter=text)
        assert reply.status_code == 400, (name, reply.text)
        assert "GeometryCollection" in reply.json()["detail"]


def operation(op, *args):
    return {"op": op, "args": args}


def prop(name):
    return {"property": name}


BOTH_LANGUAGES = (
    (
        f"s_within(geometry, {LITERALS['polygon around']}) and not s_touches(geometry, POINT(6 44))",
        operation(
            "and",
            operation(
                "s_within",
                prop("geometry"),
                {"type": "Polygon", "coordinates": [[[5, 43], [6, 43], [6, 44], [5, 44], [5, 43]]]},
            ),
            operation(
                "not",
                operation("s_touches", prop("geometry"), {"type": "Point", "coordinates": [6, 44]}),
            ),
        ),
    ),
    (
        "t_after(created_at, TIMESTAMP('2020-01-01T00:00:00Z')) and n_points between 10 and 100",
        operation(
            "and",
            operation("t_after", prop("created_at"), {"timestamp": "2020-01-01T00:00:00Z"}),
            operation("between", prop("n_points"), 10, 100),
        ),
    ),
    (
        "casei(id) like casei('CAL%') and state in ('published', 'staged')",
        operation(
            "and",
            operation("like", operation("casei", prop("id")), operation("casei", "CAL%")),
            operation("in", prop("state"), ["published", "staged"]),
        ),
    ),
    (
        "n_points * 2 - 20 > n_points ^ 1 or title is null",
        operation(
            "or",
            operation(
                ">",
                operation("-", operation("*", prop("n_points"), 2), 20),
                operation("^", prop("n_points"), 1),
            ),
            operation("isNull", prop("title")),
        ),
    ),
)


@pytest.mark.parametrize(("text", "document"), BOTH_LANGUAGES)
def test_json_means_the_same_as_text(get, text, document):
    for language, filter in (("cql2-text", text), ("cql2-json", json.dumps(document))):
        reply = get("/collections/blocks/items", filter=filter, filter_lang=language)
        assert reply.json()["numberReturned"] == 1, (text, reply.text)


# Views are of 2023-03-01 to 2023-06-09; each of these has one relation to that interval.
INTERVALS = {
    "after": ("2023-01-01", "2023-02-01"),
    "metby": ("2023-01-01", "2023-03-01"),
    "overlappedby": ("2023-01-01", "2023-04-01"),
    "finishes": ("2023-01-01", "2023-06-09"),
    "during": ("2023-01-01", "2023-07-01"),
    "startedby": ("2023-03-01", "2023-04-01"),
    "equals": ("2023-03-01", "2023-06-09"),
    "starts": ("2023-03-01", "2023-07-01"),
    "contains": ("2023-04-01", "2023-05-01"),
    "finishedby": ("2023-04-01", "2023-06-09"),
    "overlaps": ("2023-04-01", "2023-07-01"),
    "meets": ("2023-06-09", "2023-07-01"),
    "before": ("2023-07-01", "2023-08-01"),
}


def test_temporal_functions_are_the_thirteen_relations_of_intervals(ids):
    for meant, (low, high) in INTERVALS.items():
        said = f"INTERVAL(first_view, last_view), INTERVAL('{low}', '{high}')"
        others = " or ".join(f"t_{name}({said})" for name in INTERVALS if name != meant)
        assert len(ids(filter=f"t_{meant}({said})")) == 60, meant
        assert ids(filter=others) == [], meant
        apart = meant in ("before", "after")
        assert bool(ids(filter=f"t_disjoint({said})")) == apart
        assert bool(ids(filter=f"t_intersects({said})")) == (not apart)


ARITHMETIC = (
    ("saliency + 1 > 1.5", lambda s: s + 1 > 1.5),
    ("saliency - 1 > -0.5", lambda s: s - 1 > -0.5),
    ("saliency * 10 % 2 >= 1", lambda s: s * 10 % 2 >= 1),
    ("saliency * 10 div 2 = 3", lambda s: s * 10 // 2 == 3),
    ("(saliency - 1) * 10 div 2 = -2", lambda s: np.trunc((s - 1) * 10 / 2) == -2),
    ("-saliency < -0.5", lambda s: -s < -0.5),
    ("saliency ^ 2 > 0.25", lambda s: s**2 > 0.25),
    ("1 / saliency < 2", lambda s: 1 / s < 2),
    ("0.5 < saliency / 1", lambda s: s > 0.5),
)


def test_arithmetic_calculates_with_properties(ids, made):
    saliency = made.points.saliency.astype(np.float32).astype(np.float64)
    for text, meant in ARITHMETIC:
        assert ids(filter=text) == (2**26 + np.flatnonzero(meant(saliency))).tolist(), text


def test_arithmetic_by_zero_is_unknown_and_so_not_met(ids):
    for text in ("1 / (saliency - saliency) > 0", "saliency % 0 > 1", "id div 0 = 1"):
        assert ids(filter=text) == [], text


def test_arithmetic_beyond_numbers_is_refused(get):
    for text in ("(0 - saliency - 1) ^ 0.5 > 0", "10 ^ 1000 > saliency"):
        reply = get("/collections/points/items", filter=text)
        assert reply.status_code == 400, text
        assert "filter" in reply.json()["detail"]


PROPERTY_PROPERTY = (
    ("first_view < last_view", 60),
    ("first_view = last_view", 0),
    ("typology = typology", 45),
    ("n_views between saliency and id", 60),
    ("2 < n_views", 60),
    ("s_equals(geometry, geometry)", 60),
    ("'crossroads' = typology", 15),
)


def test_property_property_compares_expressions_on_both_sides(ids, made):
    east, north = (made.points.covariance_m2[:, i, i].astype(np.float32) for i in (0, 1))
    assert len(ids(filter="sigma_east_m < sigma_north_m")) == (east < north).sum() > 0
    for text, count in PROPERTY_PROPERTY:
        assert len(ids(filter=text)) == count, text
