"""The model of an ortho-image: a map grid into which corrections fold, and errors of its terrain."""

import numpy as np

from amers.services.geodesy import ecef_from_lon_lat_h, metres_per_degree_at
from amers.services.imagery.scene import view_direction
from amers.services.map_grid import MapGrid
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import AdjustmentOptions
from amers.services.sensors.correction import CorrectedModel, ImageCorrection
from amers.services.sensors.ortho import OrthoModel, ReliefDisplacement, fold_into_ortho

a_micropixel = 1e-6
a_nanometre = 1e-9

SHAPE = (3200, 2400)
GRID = MapGrid(
    "EPSG:32633", np.array([330005.0, 5861995.0]), np.array([[0.0, 10.0], [-10.0, 0.0]]), SHAPE
)
MODEL = OrthoModel(GRID)
PARAMETERS = np.array([[3.2, -0.4, 0.7], [-1.1, 0.5, 0.3]])
CORRECTION = ImageCorrection(PARAMETERS, (np.array(SHAPE) - 1.0) / 2.0, np.array(SHAPE) / 2.0)


TANGENT = np.array([[0.1, 0.0, 0.08], [-0.05, 0.0, 0.02]])


def sloping_m(lon_lat: np.ndarray) -> np.ndarray:
    """Heights that rise by some 30 m per 100 m eastwards."""
    return np.asarray(200.0 + 20_000.0 * (lon_lat[:, 0] - MODEL.locate(pixels(1), np.zeros(1))[0, 0]))


def pixels(n: int = 100) -> np.ndarray:
    return np.random.default_rng(2).uniform(0.0, np.array(SHAPE) - 1.0, (n, 2))


def test_image_positions_do_not_depend_on_the_height() -> None:
    heights = np.linspace(-400.0, 8000.0, 100)
    ground = MODEL.locate(pixels(), heights)
    np.testing.assert_array_equal(ground[:, 2], heights)
    np.testing.assert_allclose(MODEL.project(ground), pixels(), atol=a_micropixel)
    derivative = MODEL.project_derivative(ground)
    assert (derivative[:, :, 2] == 0.0).all()
    np.testing.assert_allclose(np.abs(np.linalg.det(derivative[:, :, :2])) ** -0.5, 10.0, rtol=2e-3)


def test_lines_of_sight_are_vertical() -> None:
    ground = MODEL.locate(pixels(), np.zeros(100))
    incidence_deg, _ = view_direction(MODEL, pixels(), ground)
    np.testing.assert_allclose(incidence_deg, 0.0, atol=1e-9)
    origin, direction = MODEL.line_of_sight(pixels())
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, atol=a_nanometre)
    assert ((origin * direction).sum(axis=1) < 0.0).all()


def test_what_lies_off_the_terrain_is_displaced_by_the_tangent_of_the_incidence() -> None:
    model = OrthoModel(GRID, displacement=ReliefDisplacement(sloping_m, TANGENT))
    on_terrain = MODEL.locate(pixels(), np.zeros(100))
    on_terrain[:, 2] = sloping_m(on_terrain[:, :2])
    np.testing.assert_allclose(model.project(on_terrain), pixels(), atol=a_micropixel)
    ground = model.locate(pixels(), on_terrain[:, 2] + 12.0)
    t = (pixels() - CORRECTION.centre) / CORRECTION.half_size
    east_north_m = 12.0 * (TANGENT[:, 0] + t @ TANGENT[:, 1:].T)
    moved = (on_terrain - ground)[:, :2] * metres_per_degree_at(ground)
    np.testing.assert_allclose(moved, east_north_m, atol=1e-4)
    # Three steps on a slope of 0.3 with a tangent of 0.2 leave a ten thousandth of the displacement.
    np.testing.assert_allclose(model.project(ground), pixels(), atol=1e-4)


def test_the_displaced_line_of_sight_passes_the_terrain_where_the_pixel_lies() -> None:
    model = OrthoModel(GRID, displacement=ReliefDisplacement(sloping_m, TANGENT))
    origin, direction = model.line_of_sight(pixels())
    low = model.locate(pixels(), np.full(100, 150.0))
    across = np.cross(ecef_from_lon_lat_h(low) - origin, direction)
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), 0.0, atol=0.5)
    derivative = model.project_derivative(low)[:, :, 2]
    higher = low + [0.0, 0.0, 1.0]
    np.testing.assert_allclose(
        derivative, model.project(higher) - model.project(low), rtol=0.12, atol=1e-6
    )


def test_a_correction_folds_exactly_into_the_map_grid() -> None:
    folded, corrected = fold_into_ortho(MODEL, CORRECTION), CorrectedModel(MODEL, CORRECTION)
    ground = MODEL.locate(pixels(), np.zeros(100))
    np.testing.assert_allclose(folded.project(ground), corrected.project(ground), atol=a_micropixel)
    np.testing.assert_allclose(
        folded.locate(pixels(), np.zeros(100)), corrected.locate(pixels(), np.zeros(100)), atol=1e-10
    )


def test_wrong_heights_of_points_do_not_reach_the_adjustment_of_an_ortho_image() -> None:
    rng = np.random.default_rng(5)
    ground = MODEL.locate(pixels(), np.full(100, 200.0))
    seen = CORRECTION.apply(pixels()) + rng.normal(0.0, 0.1, (100, 2))
    covariance = np.tile(np.diag([1.0, 1.0, 1e6]), (100, 1, 1))
    ground[:, 2] += rng.normal(0.0, 1000.0, 100)
    observations = ControlObservations(ground, seen, np.full(100, 0.1), covariance)
    adjusted = adjust_scene(MODEL, SHAPE, observations, AdjustmentOptions(order="affine"))
    assert adjusted.active.sum() > 90
    # Points of 1 m in pixels of 10 m add 0.1 px to the 0.1 px of the measures.
    std_px = np.sqrt(np.diag(adjusted.covariance).reshape(2, 3))
    assert (std_px < 0.06).all()
    assert (np.abs(adjusted.correction.parameters - PARAMETERS) < 4.0 * std_px).all()
