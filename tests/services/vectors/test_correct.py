"""Vectors of a raw image lie on the map where the ground is, as precisely as they state."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from amers.services.geodesy import metres_per_degree_at
from amers.services.imagery.source import ArrayImage, Window
from amers.services.lines_of_sight import intersect_terrain
from amers.services.map_grid import xy_of_lon_lat
from amers.services.quality.accuracy import normalised_error
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.terrain import Terrain
from amers.services.types import UNKNOWN_FRAME, Array, BoolArray, Frame
from amers.services.vectors.accuracy import ErrorSources, predict_vertices
from amers.services.vectors.correct import CorrectedVectors, correct_vectors, missed_place
from amers.services.vectors.project import HIDDEN_M, project_vectors
from amers.services.vectors.shapes import Geometries, geometries_of, shapes_of
from tests.services.vectors_world import CRS, DEM, GSD_M, SHAPE, heights, image_places, scene, terrain

a_millimetre = 1e-3
a_thousandth_of_a_pixel = 1e-3
the_tolerance_px = 0.2
NOTHING_KNOWN = ErrorSources(None, np.nan, 0.0)


def corrected(
    geometries: Geometries, ground: Terrain, tolerance_px: float = the_tolerance_px, crs: str = CRS
) -> CorrectedVectors:
    return correct_vectors(
        shapes_of(geometries), scene(), ground, crs, sources=NOTHING_KNOWN, tolerance_px=tolerance_px
    )


def long_lines(count: int = 60) -> Geometries:
    return shapely.linestrings(image_places(2 * count).reshape(count, 2, 2))


def in_image(line_sample: Array) -> BoolArray:
    return np.asarray(((line_sample > 0.0) & (line_sample < np.array(SHAPE) - 1.0)).all(axis=1))


@pytest.mark.parametrize("incidence_deg", [25.0, 45.0])
def test_what_is_visible_returns_to_its_place_on_the_map(incidence_deg: float) -> None:
    ground, view = terrain(120.0), scene(incidence_deg)
    lon_lat = intersect_terrain(view.model, image_places(3000), terrain(0.0))[:, :2]
    xy = xy_of_lon_lat(CRS, lon_lat)
    there = project_vectors(shapes_of(shapely.points(xy)), view, ground, CRS, tolerance_px=0.2)
    inside = in_image(there.shapes.vertices)
    assert inside.mean() > 0.8
    visible = inside & ~there.hidden
    assert 0.0 < there.hidden[inside].mean() < 0.5
    shapes = shapes_of(shapely.points(there.shapes.vertices[visible]))
    back = correct_vectors(shapes, view, ground, CRS, sources=NOTHING_KNOWN, tolerance_px=0.2)
    expected = there.lon_lat_h[visible][np.lexsort(there.shapes.vertices[visible].T[::-1])]
    actual = back.shapes.vertices
    # Ground that hides a place by less than a decimetre does not count as hiding it.
    grazing = actual[:, 2] > expected[:, 2] + a_millimetre
    assert grazing.mean() < 0.002
    assert (actual[:, 2] - expected[:, 2])[grazing].max(initial=0.0) < HIDDEN_M
    xy = xy_of_lon_lat(CRS, expected[:, :2])
    np.testing.assert_allclose(actual[~grazing, :2], xy[~grazing], atol=a_millimetre)
    np.testing.assert_allclose(actual[~grazing, 2], expected[~grazing, 2], atol=a_millimetre)
    again = project_vectors(back.shapes, view, ground, CRS, tolerance_px=0.2).shapes.vertices
    np.testing.assert_allclose(
        again[np.lexsort(again.T[::-1])], back.line_sample, atol=a_thousandth_of_a_pixel
    )


def test_hidden_ground_is_behind_ground_the_line_of_sight_meets_before() -> None:
    ground, view = terrain(120.0), scene(45.0)
    xy = xy_of_lon_lat(CRS, intersect_terrain(view.model, image_places(800), terrain(0.0))[:, :2])
    there = project_vectors(shapes_of(shapely.points(xy)), view, ground, CRS, tolerance_px=0.2)
    above_m = np.arange(1.0, 300.0, 1.0)
    for row in np.flatnonzero(in_image(there.shapes.vertices))[:200]:
        lon_lat_h = there.lon_lat_h[row]
        pixel = np.repeat(there.shapes.vertices[row : row + 1], len(above_m), axis=0)
        line = view.model.locate(pixel, lon_lat_h[2] + above_m)
        over_m = np.nanmax(ground.height_m(line[:, :2]) - line[:, 2])
        if not np.abs(over_m) < 1.0:
            assert there.hidden[row] == (over_m > 0.0)


@pytest.mark.parametrize("crs", [CRS, "EPSG:4326"])
def test_edges_follow_the_ground_within_the_tolerance(crs: str) -> None:
    ground, lines = terrain(), long_lines()
    result = corrected(lines, ground, crs=crs)
    assert not result.missed.any()
    straight = corrected(lines, ground, tolerance_px=1e6)
    assert straight.added == 0
    middle = shapes_of(lines).vertices[:1]
    metres = metres_per_degree_at(intersect_terrain(scene().model, middle, ground))[0]
    scale = np.ones(2) if crs == CRS else metres
    worst_px, worst_straight_px = 0.0, 0.0
    drawn = geometries_of(result.shapes.with_vertices(result.shapes.vertices[:, :2] * scale))
    for line, path, chord in zip(lines, drawn, geometries_of(straight.shapes), strict=True):
        a, b = shapely.get_coordinates(line)
        t = np.random.default_rng(2).uniform(0.0, 1.0, 700)[:, None]
        met = intersect_terrain(scene().model, a + t * (b - a), ground)
        true = shapely.points(xy_of_lon_lat(crs, met[:, :2]) * scale)
        worst_px = max(worst_px, shapely.distance(path, true).max() / GSD_M)
        on_map = shapely.points(xy_of_lon_lat(CRS, met[:, :2]))
        worst_straight_px = max(worst_straight_px, shapely.distance(chord, on_map).max() / GSD_M)
    assert worst_straight_px > 5.0
    assert worst_px < the_tolerance_px


def test_edges_have_no_more_vertices_than_half_of_the_tolerance_needs() -> None:
    """As many as the Douglas-Peucker of GEOS leaves of the same edges; the other half is unseen."""
    lines, needed = long_lines(20), 0
    for a, b in shapely.get_coordinates(lines).reshape(-1, 2, 2):
        places = a + np.linspace(0.0, 1.0, 4000)[:, None] * (b - a)
        met = xy_of_lon_lat(CRS, intersect_terrain(scene().model, places, terrain())[:, :2])
        path = shapely.simplify(
            shapely.linestrings(met), 0.5 * the_tolerance_px * GSD_M, preserve_topology=False
        )
        needed += shapely.get_num_coordinates(path) - 2
    assert corrected(lines, terrain(), the_tolerance_px).added == pytest.approx(needed, rel=0.2)


def test_ground_without_relief_needs_no_more_vertices() -> None:
    assert corrected(long_lines(), terrain(0.0)).added < 5


def test_neighbours_keep_their_common_border() -> None:
    a = shapely.from_wkt("POLYGON ((50 50, 50 200, 200 210, 210 60, 50 50))")
    b = shapely.from_wkt(
        "POLYGON ((210 60, 200 210, 350 220, 340 40, 210 60), (250 100, 300 100, 300 150, 250 100))"
    )
    result = corrected(np.array([a, b]), terrain())
    assert result.added > 20
    left, right = geometries_of(result.shapes)
    border = shapely.intersection(left.exterior, right.exterior)
    on_left = set(map(tuple, shapely.get_coordinates(left, include_z=True).tolist()))
    on_right = set(map(tuple, shapely.get_coordinates(right, include_z=True).tolist()))
    assert len(on_left & on_right) > 5
    assert shapely.line_merge(border).geom_type == "LineString"
    assert shapely.area(shapely.intersection(left, right)) == 0.0
    assert shapely.get_num_interior_rings(shapely.union_all([left, right])) == 1
    reversed_ = corrected(shapely.reverse(np.array([b, a])), terrain())
    again = {tuple(row) for row in reversed_.shapes.vertices.tolist()}
    assert again == {tuple(row) for row in result.shapes.vertices.tolist()}


def test_rings_stay_closed_and_types_stay() -> None:
    geometries = shapely.from_wkt(
        [
            "MULTIPOLYGON (((50 50, 50 200, 200 210, 50 50)), ((250 250, 300 250, 300 300, 250 250)))",
            "MULTIPOINT ((60 60), (70 70))",
            "LINESTRING (60 60, 300 300)",
        ]
    )
    result = geometries_of(corrected(geometries, terrain()).shapes)
    assert [shape.geom_type for shape in result] == [shape.geom_type for shape in geometries]
    assert shapely.is_valid(result).all()
    assert shapely.get_num_coordinates(result)[1] == 2


def test_places_without_ground_are_named() -> None:
    holed = heights()
    holed[150:158, 150:190] = np.nan
    ground = replace(terrain(), heights=ArrayImage(holed))
    row, sample = scene().model.project(
        np.array([[*ground.grid.lon_lat(np.array([[154.0, 170.0]]))[0], 700.0]])
    )[0]
    lines = shapely.linestrings([[[20, 20], [40, 40]], [[row - 50, sample], [row + 50, sample]]])
    result = corrected(lines, ground)
    assert result.missed.tolist() == [False, True]
    assert missed_place(result) == "feature 2, between two of its vertices"
    points = corrected(shapely.points([[20.0, 20.0], [row, sample]]), ground)
    assert missed_place(points).startswith("feature 2, vertex 1, at line ")
    assert missed_place(corrected(lines[:1], ground)) == ""


def test_heights_are_in_the_datum_of_the_terrain() -> None:
    over = replace(terrain(), geoid=lambda lon_lat: 40.0 + lon_lat[:, 0])
    points = shapely.points(image_places(20))
    for crs in ("EPSG:32631", "EPSG:4979"):
        result = corrected(points, over, crs=crs)
        expected_m = intersect_terrain(scene().model, result.line_sample, over)
        if crs == "EPSG:32631":
            expected_m[:, 2] -= 40.0 + expected_m[:, 0]
        np.testing.assert_allclose(result.shapes.vertices[:, 2], expected_m[:, 2], atol=a_millimetre)


def registered(frame: Frame = UNKNOWN_FRAME) -> CorrectionAccuracy:
    root = np.random.default_rng(4).normal(0.0, 0.4, (6, 6))
    covariance = root @ root.T + 0.05 * np.eye(6)
    return CorrectionAccuracy(no_correction(SHAPE), covariance, np.array([0.2, 0.3]), frame, 0.0)


@pytest.mark.long
def test_the_stated_precision_is_honest() -> None:
    """Draws of all errors: of the model, the frame, the heights of the terrain and the operator."""
    rng = np.random.default_rng(7)
    ground, view = replace(terrain(30.0), sigmas=3.0), scene()
    frame = Frame(np.array([[1.5, 0.4, 0.0], [0.4, 2.0, 0.3], [0.0, 0.3, 4.0]]))
    accuracy = registered(frame)
    sources = ErrorSources(accuracy, np.nan, 0.5)
    line_sample = image_places(12, seed=6)
    met = intersect_terrain(view.model, line_sample, ground)
    stated = predict_vertices(view.model, ground, line_sample, met, sources)
    relative, on_the_earth = [], []
    derivative = view.model.project_derivative(met)
    draws = 200
    for _ in range(draws):
        drawn = replace(
            accuracy.correction,
            parameters=rng.multivariate_normal(np.zeros(6), accuracy.covariance_px2).reshape(2, 3),
        )
        local = rng.normal(0.0, accuracy.local_sigma_px, (len(met), 2))
        seen = line_sample + local + rng.normal(0.0, sources.vertex_sigma_px, (len(met), 2))
        height_m = ground.heights.read(Window(0, 0, *ground.grid.shape)) + np.float32(
            rng.normal(0.0, 3.0)
        )
        raised = replace(ground, heights=ArrayImage(height_m))
        shift = derivative @ rng.multivariate_normal(np.zeros(3), frame.covariance_m2)
        model = CorrectedModel(view.model, drawn)
        for errors, moved in ((relative, seen), (on_the_earth, seen + shift)):
            wrong = intersect_terrain(model, moved, raised)
            errors.append((wrong - met)[:, :2] * metres_per_degree_at(met))
    for errors, covariance in ((relative, stated.relative_m2), (on_the_earth, stated.on_the_earth_m2)):
        error = np.concatenate(errors)
        found = normalised_error(error, np.tile(covariance, (draws, 1, 1)))
        assert 0.85 < found.mean_square < 1.15


def test_on_level_ground_a_height_error_moves_a_vertex_by_the_tangent_of_the_incidence() -> None:
    ground, view = terrain(0.0), scene(25.0)
    line_sample = np.array([[SHAPE[0] / 2.0, SHAPE[1] / 2.0]])
    met = intersect_terrain(view.model, line_sample, ground)
    stated, without = (
        predict_vertices(
            view.model, replace(ground, sigmas=m), line_sample, met, ErrorSources(registered(), 0.0, 0.0)
        )
        for m in (10.0, 0.0)
    )
    of_height = (stated.relative_m2 - without.relative_m2)[0]
    assert np.sqrt(np.trace(of_height)) == pytest.approx(10.0 * np.tan(np.radians(25.0)), rel=2e-3)


def test_what_nobody_stated_is_unknown() -> None:
    line_sample = image_places(3)
    met = intersect_terrain(scene().model, line_sample, terrain())

    def ce90(sources: ErrorSources) -> tuple[Array, Array]:
        stated = predict_vertices(scene().model, terrain(), line_sample, met, sources)
        return stated.relative_ce90_m, stated.on_the_earth_ce90_m

    relative, earth = ce90(ErrorSources(registered(), np.nan, 0.5))
    assert np.isfinite(relative).all()
    assert np.isnan(earth).all()
    relative, earth = ce90(ErrorSources(None, 5.0, 0.0))
    assert np.isnan(relative).all()
    of_model = ErrorSources(None, 5.0, 0.0)
    level = predict_vertices(
        scene().model, replace(terrain(0.0), sigmas=0.0), line_sample, met, of_model
    )
    np.testing.assert_allclose(level.on_the_earth_ce90_m, 5.0 * 2.146, rtol=1e-3)


@pytest.mark.parametrize("slope", [(0.5, 0.0), (-0.5, 0.0), (0.2, 0.6), (0.0, 0.0)])
def test_on_sloping_ground_errors_move_a_vertex_as_its_line_of_sight_meets_the_slope(
    slope: tuple[float, float],
) -> None:
    """Ground that rises east and north by these; a step in the image, and of all heights."""
    view, line_sample = scene(25.0), image_places(5)
    nodes = np.moveaxis(np.indices(DEM.shape), 0, -1).reshape(-1, 2).astype(np.float64)
    lon_lat = DEM.lon_lat(nodes)
    metres = metres_per_degree_at(np.append(lon_lat.mean(axis=0), 700.0)[None])[0]
    height_m = 700.0 + (lon_lat - lon_lat.mean(axis=0)) * metres @ np.array(slope)
    plane = height_m.reshape(DEM.shape)

    def met(seen: Array, raised_m: float = 0.0) -> Array:
        return intersect_terrain(view.model, seen, Terrain(DEM, ArrayImage(plane + raised_m)))

    ground = met(line_sample)
    by_line, by_sample, by_height = (
        (met(line_sample + step, raised_m) - ground)[:, :2] * metres
        for step, raised_m in (([1.0, 0.0], 0.0), ([0.0, 1.0], 0.0), ([0.0, 0.0], 1.0))
    )
    expected_m2 = {
        (3.0, 0.0): 9.0 * (outer(by_line) + outer(by_sample)),
        (0.0, 2.0): 4.0 * outer(by_height),
    }
    for (vertex_px, height_sigma_m), of_errors in expected_m2.items():
        sources = ErrorSources(None, 0.0, vertex_px)
        terrain_of = Terrain(DEM, ArrayImage(plane), sigmas=height_sigma_m)
        stated = predict_vertices(view.model, terrain_of, line_sample, ground, sources)
        tolerance = 0.02 * np.abs(of_errors).max()
        np.testing.assert_allclose(stated.on_the_earth_m2, of_errors, atol=tolerance)


def outer(error: Array) -> Array:
    """Each error (n, 2) times itself, (n, 2, 2)."""
    return error[:, :, None] * error[:, None, :]
