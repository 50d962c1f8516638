"""Vectors of the map lie in the raw image where it shows them."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from amers.services.errors import InputError
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import xy_of_lon_lat
from amers.services.vectors.accuracy import ErrorSources
from amers.services.vectors.correct import correct_vectors
from amers.services.vectors.project import (
    ProjectedVectors,
    _inside,
    cut,
    ground_outline,
    hidden_share,
    image_outline,
    project_vectors,
)
from amers.services.vectors.shapes import geometries_of, shapes_of
from tests.services.vectors_world import CRS, SHAPE, heights, image_places, scene, terrain

the_tolerance_px = 0.2


def on_map(count: int) -> np.ndarray:
    ground = scene().model.locate(image_places(count), np.full(count, 700.0))
    return xy_of_lon_lat(CRS, ground[:, :2])


def test_straight_edges_of_the_map_are_bent_in_the_image_within_the_tolerance() -> None:
    lines = shapely.linestrings(on_map(80).reshape(40, 2, 2))
    ground = terrain()
    result = project_vectors(shapes_of(lines), scene(), ground, CRS, tolerance_px=the_tolerance_px)
    assert result.added > 100
    worst_px = 0.0
    for line, path in zip(lines, geometries_of(result.shapes), strict=True):
        between = np.random.default_rng(3).uniform(0.0, line.length, 500)
        places = shapes_of(shapely.line_interpolate_point(line, between))
        true = project_vectors(places, scene(), ground, CRS, tolerance_px=1.0).shapes.vertices
        worst_px = max(worst_px, shapely.distance(path, shapely.points(true)).max())
    assert worst_px < the_tolerance_px


def test_heights_of_the_vectors_count_and_missing_ones_are_those_of_the_terrain() -> None:
    xy = np.sort(on_map(1), axis=0)
    base_m = float(terrain().height_m(scene().model.locate(image_places(1), np.array([700.0])))[0])
    high, low, none = (
        project_vectors(shapes_of(points), scene(), terrain(), CRS, tolerance_px=0.2).shapes.vertices
        for points in (
            shapely.points([[*xy[0], base_m + 30.0]]),
            shapely.points([[*xy[0], base_m]]),
            shapely.points(xy),
        )
    )
    np.testing.assert_allclose(low, none, atol=1e-3)
    lean_px = np.hypot(*(high - low)[0])
    assert lean_px == pytest.approx(30.0 * np.tan(np.radians(25.0)) / 2.0, rel=0.1)


def test_ground_behind_a_ridge_is_hidden_and_a_tower_is_not() -> None:
    ground, view = terrain(120.0), scene(45.0)
    xy = xy_of_lon_lat(CRS, view.model.locate(image_places(500), np.full(500, 700.0))[:, :2])
    points = project_vectors(shapes_of(shapely.points(xy)), view, ground, CRS, tolerance_px=0.2)
    assert 0.05 < points.hidden.mean() < 0.6
    towers = shapely.points(np.column_stack([xy, np.full(500, float(heights(120.0).max()) + 1.0)]))
    assert not project_vectors(shapes_of(towers), view, ground, CRS, tolerance_px=0.2).hidden.any()
    # It is looked for as far as the image goes, to the outer border of its last pixels.
    for row in np.flatnonzero(points.hidden)[:10]:
        last, one = np.rint(points.shapes.vertices[row]).astype(int), points.shapes.vertices[row]
        at = shapes_of(shapely.points(xy_of_lon_lat(CRS, points.lon_lat_h[row : row + 1, :2])))
        for cut_off, expected in (((1, 1), True), ((0, 1), False), ((1, 0), False)):
            image = ArrayImage(np.ones(last + cut_off, dtype=np.float32))
            part = project_vectors(at, replace(view, image=image), ground, CRS, tolerance_px=0.2)
            np.testing.assert_allclose(part.shapes.vertices[0], one, atol=1e-6)
            assert part.hidden[0] == expected
    line = shapes_of(np.array([None, shapely.LineString(xy)], dtype=object))
    share = hidden_share(project_vectors(line, view, ground, CRS, tolerance_px=0.2))
    assert np.isnan(share[0])
    assert 0.05 < share[1] < 0.6


def test_the_outline_of_the_ground_contains_what_the_image_shows() -> None:
    outline = ground_outline(scene(), terrain(), CRS)
    assert shapely.contains_xy(outline, *on_map(200).T).all()
    far = on_map(1)[0] + 5000.0
    assert not shapely.contains_xy(outline, *far)


def test_geometries_are_cut_at_the_border() -> None:
    box = image_outline(SHAPE)
    geometries = shapely.from_wkt(
        [
            "POINT (10 10)",
            "LINESTRING (-100 10, 100 10, 100 900)",
            "POLYGON ((-50 -50, -50 30, 30 30, 30 -50, -50 -50))",
            "POINT (-10 10)",
            "LINESTRING (10 10, 20 900, 30 10)",
            "POLYGON ((-9 -9, -0.5 -9, -0.5 9, -9 9, -9 -9))",
        ]
    )
    kept = cut(geometries, box)
    assert shapely.is_missing(kept).tolist() == [False, False, False, True, False, True]
    assert kept[2].area == pytest.approx(30.5**2)
    assert [kept[row].geom_type for row in (1, 2, 4)] == ["LineString", "Polygon", "MultiLineString"]
    bow = shapely.from_wkt(["POINT (0 0)", "POLYGON ((-5 -5, 9 9, 9 -5, -5 9, -5 -5))"])
    with pytest.raises(InputError, match=r"feature 2: Self-intersection.* do without --clip"):
        cut(bow, box)


def test_places_without_heights_have_no_position() -> None:
    line = shapely.linestrings([[on_map(1)[0], on_map(1)[0] + 30_000.0]])
    assert project_vectors(shapes_of(line), scene(), terrain(), CRS, tolerance_px=0.2).missed.all()


@pytest.mark.parametrize("crs", [CRS, "EPSG:4979"])
def test_vectors_with_heights_return_to_the_image_they_were_corrected_from(crs: str) -> None:
    """Their heights refer to the geoid of the terrain, or to the ellipsoid where the map has heights."""
    over = replace(terrain(), geoid=lambda lon_lat: 40.0 + 10.0 * lon_lat[:, 0])
    points = shapes_of(shapely.points(image_places(20)))
    there = correct_vectors(
        points, scene(), over, crs, sources=ErrorSources(None, np.nan, 0.0), tolerance_px=0.2
    )
    back = project_vectors(there.shapes, scene(), over, crs, tolerance_px=0.2)
    np.testing.assert_allclose(back.shapes.vertices, there.line_sample, atol=0.01)


def test_the_hidden_share_is_that_of_the_vertices_of_each_geometry() -> None:
    """A vertex that two of them have counts in both, and one that a ring has twice counts twice."""
    crossing = [[0.0, 0.0], [0.0, 4.0], [4.0, 4.0]]
    shapes = shapes_of(np.array([shapely.LineString(crossing), shapely.Polygon(crossing)]))
    hidden = (shapes.vertices == 0.0).all(axis=1)
    ground = np.zeros((len(hidden), 3))
    share = hidden_share(ProjectedVectors(shapes, ground, hidden, np.zeros(2, dtype=bool), 0))
    np.testing.assert_allclose(share, [1.0 / 3.0, 2.0 / 4.0])


def test_an_image_reaches_to_the_borders_of_its_pixels() -> None:
    places = np.array([[-0.5, 30.5], [9.5, -0.5], [-0.6, 3.0], [9.6, 3.0], [3.0, -0.6], [3.0, 30.6]])
    assert _inside(places, (10, 31)).tolist() == [True, True, False, False, False, False]
