"""Filters within bounds, in both languages, and their geometries."""

import json
import math

import numpy as np
import pytest
import shapely

from amers.app.db.features.cql2 import translate
from amers.app.db.features.cql2_bounds import parse_geometry, parse_json
from amers.app.db.features.cql2_text import LONGEST_TEXT, parse_text
from amers.app.db.features.crs import CRS84, EPSG_3857, EVERY
from amers.app.db.points import POINTS
from amers.app.errors import InvalidParameter
from tests.app.filter_attacks import NAMED

pytestmark = pytest.mark.security

WITHIN = '{"op": "s_within", "args": [{"property": "geometry"}, %s]}'


@pytest.mark.parametrize("text", NAMED.values(), ids=NAMED.keys())
def test_an_attack_is_refused(text: str) -> None:
    with pytest.raises(InvalidParameter, match=r"^filter: "):
        translate(parse_text(text), POINTS, CRS84)


@pytest.mark.parametrize(
    "text",
    [
        "saliency > 0.5",
        "a <> 'it''s' and b >= -1.5e-3 or not (c is not null)",
        r"typology like 'a\%b' and typology = 'a\b'",
        '"saliency" = 1',
        "a not in (1, 2, 3) and b not like 'x%' and c not between -1 and +2",
        "a BETWEEN 1 AND 2 AND b = 3",
        "s_within(g, MULTIPOLYGON Z (((0 0 1, 1 0 1, 1 1 1, 0 0 1)), ((5 5 1, 6 5 1, 6 6 1, 5 5 1))))",
        "s_intersects(geom, GEOMETRYCOLLECTION(POINT(1 2), LINESTRING(-1 -2, +3 4)))",
        "s_intersects(geom, POLYGON EMPTY)",
        "s_within(geometry, BBOX(1, 2, 3, 4))",
        "t_during(first_view, INTERVAL('2020-01-01', '..'))",
        "casei(typology) like casei('A%')",
        "a = 7 div 2 and b = 2 ^ -3 and c = - -1",
        "notes = 1 and order.by:x = 2",
        "(((((((((saliency > 1)))))))))",
    ],
)
def test_a_filter_of_the_standard_passes(text: str) -> None:
    assert parse_text(text)


def test_the_largest_filters_of_each_kind_are_answered() -> None:
    for text in (
        "saliency in (" + "1," * 990 + "1)",
        "1 or " * 799 + "1",
        "(" * 10 + "1" + ",2)" * 10,
        "typology='" + "''" * 1990 + "'",
        "s_intersects(geometry,MULTIPOLYGON(((" + ",".join(["1 2"] * 980) + "))))",
        "saliency=" + "-" * 31 + "1",
        "(" * 5 + "saliency=1" + " and saliency=1" * 90 + " and" + ")" * 5,
    ):
        assert len(text) <= LONGEST_TEXT
        _answer(text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('{"op": "=", "args": [{"property": "saliency"}, NaN]}', "NaN"),
        ('{"op": "=", "args": [{"property": "saliency"}, -Infinity]}', "Infinity"),
        ('{"op": "=", "op": "<", "args": [{"property": "saliency"}, 1]}', "twice"),
        ('{"op": "=", "args": [{"property": "typology"}, "\\ud800"]}', "surrogate"),
        ('{"op": "=", "args": [{"property": "saliency"}, 1' + "0" * 400 + "]}", "filter"),
        ('{"op": "=", "args": [{"property": "saliency"}, 1' + "0" * 9000 + "]}", "filter"),
        ('{"op": "not", "args": [' * 40 + "true" + "]}" * 40, "deeper"),
        ("[" * 100_000, "JSON"),
        ('{"op": "in", "args": [{"property": "saliency"}, [' + "1," * 15_000 + "1]]}", "more than"),
        ('"true"', "filter"),
        ('{"op": "=", "args": [{"property": "saliency", "date": "2020-01-01"}, 1]}', "one member of"),
        ('{"op": "isNull", "args": [{"op": ["x"], "property": "saliency"}]}', "one member of"),
        (WITHIN % '{"type": "Feature", "geometry": {"type": "Point", "coordinates": [1, 2]}}', "type"),
        (WITHIN % '{"type": ["Point"], "coordinates": [1, 2]}', "type"),
        (WITHIN % ('{"bbox": [1, 2, 3, 1' + "0" * 400 + "]}"), "filter"),
    ],
)
def test_a_json_filter_that_cannot_be_used_is_refused(text: str, reason: str) -> None:
    with pytest.raises(InvalidParameter, match=reason):
        translate(parse_json(text), POINTS, CRS84)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "\ud800"])
def test_a_document_with_a_value_that_json_does_not_have_is_refused(value: object) -> None:
    with pytest.raises(InvalidParameter, match=r"^filter: "):
        parse_json({"op": "=", "args": [{"property": "saliency"}, value]})


def test_a_geometry_that_states_its_extent_is_no_box() -> None:
    point = {"type": "Point", "bbox": [1.0, 2.0, 3.0, 4.0], "coordinates": [2.0, 3.0]}
    document = {"op": "s_within", "args": [{"property": "geometry"}, point]}
    assert parse_json(document) == document
    assert shapely.from_wkb(parse_geometry(point, CRS84, "filter")).equals(shapely.Point(2.0, 3.0))


def as_mercator(lon_lat: list[tuple[float, float]]) -> dict[str, object]:
    """A polygon in metres of the map projection, by its own formula (Snyder 1987, equation 7-1)."""
    ring = [
        (6378137.0 * math.radians(lon), 6378137.0 * math.asinh(math.tan(math.radians(lat))))
        for lon, lat in lon_lat
    ]
    return {"type": "Polygon", "coordinates": [ring]}


def test_a_polygon_means_the_same_in_every_reference_system() -> None:
    corners = [(5.2, 43.2), (5.3, 43.2), (5.3, 43.4), (5.2, 43.2)]
    swapped = [(lat, lon) for lon, lat in corners]
    (lat_first,) = (crs for crs in EVERY.values() if crs.lat_first and not crs.has_height)
    given = (
        ({"type": "Polygon", "coordinates": [corners]}, CRS84),
        ({"type": "Polygon", "coordinates": [swapped]}, lat_first),
        (as_mercator(corners), EPSG_3857),
    )
    for geometry, crs in given:
        shape = shapely.from_wkb(parse_geometry(geometry, crs, "filter"))
        assert shapely.get_coordinates(shape) == pytest.approx(np.array(corners), abs=1e-9), crs.uri


def test_a_box_across_180_degrees_is_the_small_part_of_the_earth() -> None:
    shape = shapely.from_wkb(parse_geometry({"bbox": [170.0, -5.0, -160.0, 5.0]}, CRS84, "filter"))
    inside, outside = ([(175, 0), (-170, 0), (180, 0)], [(0, 0), (165, 0), (-155, 0), (175, 6)])
    assert shapely.intersects(shape, shapely.points(inside)).all()
    assert not shapely.intersects(shape, shapely.points(outside)).any()
    assert shape.area == pytest.approx(30.0 * 10.0)


def test_a_large_polygon_in_json_passes() -> None:
    ring = [[5.0 + number * 1e-6, 43.0] for number in range(9_000)] + [[5.0, 44.0], [5.0, 43.0]]
    polygon = {"type": "Polygon", "coordinates": [ring]}
    document = {"op": "s_intersects", "args": [{"property": "geometry"}, polygon]}
    assert translate(parse_json(json.dumps(document)), POINTS, CRS84).has_spatial_predicate


def _answer(text: str) -> None:
    try:
        translate(parse_text(text), POINTS, CRS84)
    except InvalidParameter:
        return
