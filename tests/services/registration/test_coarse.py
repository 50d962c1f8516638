"""A scene that may be far off is searched with the chips it should show, and found or refused."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.conventions import CHIP_CENTRE
from amers.services.errors import InputError, NoConsensus
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.registration.chip_selection import fine_gsd_m, has_chip, visibility_probability
from amers.services.registration.context import Prediction
from amers.services.registration.on_points import Registration, register_scene
from amers.services.registration.options import CoarseOptions, RegistrationOptions
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.simulation.view import SimulatedView, plan_geometry
from amers.services.types import Array, ControlPoints
from tests.services.simulated import block, plan, spoiled_view, world

pytestmark = [pytest.mark.long, pytest.mark.thorough]

HALF_THE_SCENE_M = (310.0, -160.0)
"""East and north; the scene is 700 m wide."""
SIGMA_M = 120.0
a_pixel = 1.0
of_many_draws = 0.02


def far_view() -> SimulatedView:
    return spoiled_view(HALF_THE_SCENE_M)


def registered(coarse: CoarseOptions) -> Registration:
    return register_scene(
        far_view().as_scene(SIGMA_M), *block(), replace(RegistrationOptions(), coarse=coarse)
    )


def left_over_px(result: Registration) -> Array:
    """Distance of the registered model from the true model, without the frame of the block."""
    ground = block()[0].lon_lat_h
    seen = result.model.project(ground) - far_view().geometry.true_model.project(ground)
    return np.asarray(np.hypot(*(seen - np.median(seen, axis=0)).T))


@pytest.mark.parametrize(
    ("max_search_px", "name"),
    [
        pytest.param(400, "coarse", id="around each point", marks=pytest.mark.endurance),
        pytest.param(100, "far", id="in the whole scene"),
    ],
)
def test_a_scene_wrong_by_half_its_size_is_found(max_search_px: int, name: str) -> None:
    result = registered(CoarseOptions(max_search_px=max_search_px))
    first = result.search_stages[0]
    assert first.name == name
    assert not first.limited
    assert first.displacement_rms_m == pytest.approx(np.hypot(*HALF_THE_SCENE_M), abs=20.0)
    assert first.search_radius_m >= 3.0 * SIGMA_M
    assert left_over_px(result).max() < a_pixel
    assert result.qualification.verdict == "good"


def test_a_scene_farther_off_than_it_says_is_refused_with_its_counts() -> None:
    with pytest.raises(NoConsensus, match=r"does not agree on one correction: \d+ points tried within"):
        register_scene(far_view().as_scene(SIGMA_M / 2.0), *block())


def empty_scene(lines: int, gsd_m: float, sigma_m: float) -> Scene:
    """A scene of the middle of the world of which only the geometry counts."""
    of_the_middle = plan(shape=(lines, lines), gsd_m=gsd_m)
    geometry = plan_geometry(world(), of_the_middle, np.random.default_rng(0))
    blank = ArrayImage(np.zeros((lines, lines), dtype=np.float32))
    return Scene(blank, geometry.delivered, geometry.acquisition, sigma_m)


def prediction_within(sigma_m: float, scene: Scene, points: ControlPoints) -> Prediction:
    """The delivered model's prediction of points, with a standard deviation."""
    model = CorrectedModel(scene.model, no_correction(scene.image.shape))
    return Prediction(model, np.full(len(points), sigma_m))


def with_coarse_chips() -> ControlPoints:
    points = block()[0]
    return points.take(np.flatnonzero(has_chip(points, 4.0)))


def test_the_probability_of_being_shown_is_that_of_many_draws() -> None:
    points, scene, sigma_m = block()[0], empty_scene(700, 1.0, 120.0), 120.0
    line_sample = scene.model.project(points.lon_lat_h)
    prediction = prediction_within(sigma_m, scene, points)
    probability = visibility_probability(scene, points, prediction, 1.0)
    derivative = np.abs(scene.model.project_derivative(points.lon_lat_h[:1])[0, :, :2])
    reach_px = CHIP_CENTRE * derivative.sum(axis=1)
    drawn = np.random.default_rng(1).normal(0.0, sigma_m, (5000, 1, 2)) + line_sample
    shown = ((drawn >= reach_px) & (drawn <= 699.0 - reach_px)).all(axis=2).mean(axis=0)
    np.testing.assert_allclose(probability, shown, atol=of_many_draws)
    assert probability.max() > 0.8


@pytest.mark.parametrize(
    ("lines", "gsd_m", "expected_m"),
    [(2800, 1.0, 1.0), (700, 4.0, 4.0), (150, 4.0, 1.0), (700, 3.0, 1.0)],
    ids=["fine scene", "coarse scene", "coarse scene smaller than two chips", "between the chips"],
)
def test_chips_are_as_coarse_as_the_scene_where_it_shows_them(
    lines: int, gsd_m: float, expected_m: float
) -> None:
    points = with_coarse_chips()
    scene = empty_scene(lines, gsd_m, 5.0)
    assert fine_gsd_m(scene, points, prediction_within(5.0, scene, points)) == expected_m


def test_coarse_chips_of_few_points_are_left_for_the_finer_ones_of_all() -> None:
    points = block()[0]
    few = np.flatnonzero(has_chip(points, 4.0))[:5]
    without = np.flatnonzero(~has_chip(points, 4.0))
    scene = empty_scene(700, 4.0, 5.0)
    mixed = points.take(np.sort(np.concatenate([few, without])))
    assert fine_gsd_m(scene, mixed, prediction_within(5.0, scene, mixed)) == 1.0


@pytest.mark.parametrize("name", ["points", "max_search_px", "max_reduction"])
def test_options_no_search_can_be_made_with_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"{name}: 0 given, 1 or more expected"):
        CoarseOptions(**{name: 0})
