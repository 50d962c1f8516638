"""An area of the ground that moved is told from lines and samples that did."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.quality.accuracy import normalised_error
from amers.services.quality.normal_law import normal_ce90
from amers.services.sensors.correction import ImageCorrection
from amers.services.types import Array, BoolArray, IntArray
from tests.services.conftest import FlatModel
from tests.services.misfit.test_displacement_components import (
    MOTIONS,
    SHAPE,
    WRONG,
    beyond_affine,
    draw,
    trial,
)

SIGMA_PX = 0.5


@dataclass(frozen=True)
class Landslide:
    """An ellipse of an image whose ground moved, in pixels."""

    centre: Array
    half_axes: Array
    direction: float
    moved: Array

    def holds(self, place: Array) -> BoolArray:
        cos, sin = np.cos(self.direction), np.sin(self.direction)
        axes = (place - self.centre) @ np.array([[cos, -sin], [sin, cos]]) / self.half_axes
        return np.asarray((axes**2).sum(axis=1) <= 1.0)

    def __call__(self, place: Array) -> Array:
        return self.holds(place)[:, None] * self.moved


def landslide(share: float, moved: Array, where: Array, stretch: float = 1.4) -> Landslide:
    """An ellipse of a share of the image, at a place from -1 to 1 between the borders."""
    size = np.array(SHAPE, dtype=np.float64)
    half_axes = np.sqrt(share * size.prod() / np.pi) * np.sqrt([stretch, 1.0 / stretch])
    centre = 0.5 * size + where * np.maximum(0.5 * size - half_axes, 0.0)
    return Landslide(centre, half_axes, 0.6, moved)


def drawn_landslide(rng: np.random.Generator) -> Landslide:
    angle, length_px = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(3.0, 5.0)
    moved = length_px * np.array([np.cos(angle), np.sin(angle)])
    where = rng.uniform(-0.6, 0.6, 2)
    return landslide(rng.uniform(0.3, 0.42), moved, where, rng.uniform(1.0, 1.8))


def beside(
    adjustment: SceneAdjustment, truth: ImageCorrection, moved: "Landslide | OtherArea"
) -> tuple[float, float]:
    """True over predicted CE90, and normalised error, where the ground did not move."""
    places = np.random.default_rng(0).random((400, 2)) * (np.array(SHAPE) - 1.0)
    places = places[~moved.holds(places)]
    error = adjustment.correction.apply(places) - truth.apply(places)
    covariance = adjustment.covariance_at(adjustment.correction.apply(places))
    ratio = float(np.quantile(np.hypot(*error.T), 0.9) / np.median(normal_ce90(covariance)))
    return ratio, normalised_error(error, covariance).mean_square


def taken(observations: ControlObservations, rows: IntArray) -> ControlObservations:
    """Some of the observations, or all of them several times."""
    names = ("lon_lat_h", "line_sample", "sigma_px", "covariance_m2")
    return replace(observations, **{name: getattr(observations, name)[rows] for name in names})


THIRD = landslide(0.3, np.array([2.5, 3.5]), np.array([0.3, -0.2]))
"""Nine times the scatter of the points: a jitter and a bow come near to it."""


def test_points_of_a_third_of_the_image_that_moved_are_left_out_together():
    observations, truth = draw(THIRD, np.random.default_rng(3), wrong=0.0)
    adjustment = adjust_scene(FlatModel(), SHAPE, observations, ground_may_move=True)
    assert adjustment.moved is not None
    on_it = THIRD.holds(FlatModel().project(observations.lon_lat_h))
    assert np.mean(adjustment.moved.measures == on_it) > 0.95
    assert not (adjustment.active & adjustment.moved.measures).any()
    assert adjustment.components == ()
    moved_px = np.median(adjustment.residual_px[adjustment.moved.measures], axis=0)
    np.testing.assert_allclose(moved_px, THIRD.moved, atol=3.0 * SIGMA_PX)
    ratio, _ = beside(adjustment, truth, THIRD)
    assert ratio < WRONG


def test_a_refit_leaves_out_the_same_ground():
    observations, truth = draw(THIRD, np.random.default_rng(3), wrong=0.0)
    adjustment = adjust_scene(FlatModel(), SHAPE, observations, ground_may_move=True)
    every_other = np.arange(len(observations.line_sample)) % 2 == 0
    again = adjust_scene(FlatModel(), SHAPE, replace(observations, usable=every_other), like=adjustment)
    assert adjustment.moved is not None
    assert again.moved is adjustment.moved
    assert not (again.active & (adjustment.moved.measures | ~every_other)).any()
    assert beside(again, truth, THIRD)[0] < WRONG


@pytest.mark.long
def test_the_larger_area_is_the_scene_even_where_the_smaller_has_more_points():
    rng = np.random.default_rng(8)
    observations, truth = draw(THIRD, rng, count=200, wrong=0.0)
    on_it = THIRD.holds(FlatModel().project(observations.lon_lat_h))
    fewer = np.flatnonzero(~on_it)[: int(0.8 * on_it.sum())]
    kept = np.sort(np.concatenate([np.flatnonzero(on_it), fewer]))
    adjustment = adjust_scene(FlatModel(), SHAPE, taken(observations, kept), ground_may_move=True)
    assert adjustment.moved is not None
    assert beside(adjustment, truth, THIRD)[0] < WRONG


def test_ground_that_holds_nearly_all_usable_points_stays_the_scene():
    """Beside it, too few measures would be left; what agrees elsewhere is told by other means."""
    observations, _ = draw(THIRD, np.random.default_rng(3), wrong=0.0)
    on_it = THIRD.holds(FlatModel().project(observations.lon_lat_h))
    usable = on_it | (np.cumsum(~on_it) <= 3)
    adjustment = adjust_scene(
        FlatModel(), SHAPE, replace(observations, usable=usable), ground_may_move=True
    )
    assert adjustment.moved is None
    assert adjustment.active[on_it].mean() > 0.9


@pytest.mark.long
def test_chips_that_are_the_same_can_be_compared():
    observations, truth = draw(THIRD, np.random.default_rng(3), wrong=0.0)
    twice = taken(observations, np.repeat(np.arange(len(observations.sigma_px)), 2))
    adjustment = adjust_scene(FlatModel(), SHAPE, twice, ground_may_move=True)
    assert adjustment.moved is not None
    assert beside(adjustment, truth, THIRD)[0] < WRONG


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_ground_that_moved_by_a_few_times_the_scatter_makes_no_scene_wrong():
    """A third of the image moved by 6 to 10 times what points scatter: motion followed it in 2 of 40."""
    ratios, normalised = [], []
    for seed in range(20, 60):
        rng = np.random.default_rng([seed, 1])
        moved = drawn_landslide(rng)
        observations, truth = draw(moved, rng, sigma_px=SIGMA_PX, averaged=True)
        adjustment = adjust_scene(FlatModel(), SHAPE, observations, ground_may_move=True)
        ratio, mean_square = beside(adjustment, truth, moved)
        ratios.append(ratio)
        normalised.append(mean_square)
    assert np.max(ratios) < WRONG
    assert 0.3 < np.mean(normalised) < 1.5


@dataclass(frozen=True)
class OtherArea:
    """An area of another shape; one that moves unevenly does so by up to 1.7 times a vector."""

    shape: str
    moved: Array

    def holds(self, place: Array) -> BoolArray:
        line, sample = (place / SHAPE).T
        if self.shape == "corner":
            return np.asarray(line + sample < 0.75)
        if self.shape == "angle":
            return np.asarray((line < 0.3) & (sample < 0.8) | (sample < 0.3) & (line < 0.7))
        return THIRD.holds(place)

    def __call__(self, place: Array) -> Array:
        uneven = 0.3 + 1.4 * place[:, :1] / SHAPE[0] if self.shape == "uneven" else 1.0
        return self.holds(place)[:, None] * self.moved * uneven


@pytest.mark.monte_carlo
@pytest.mark.parametrize("shape", ["corner", "angle", "uneven"])
def test_areas_that_are_no_ellipse_make_no_scene_wrong(shape: str):
    ratios = []
    for seed in range(8):
        rng = np.random.default_rng([seed, 6])
        angle = rng.uniform(0.0, 2.0 * np.pi)
        moved = OtherArea(shape, rng.uniform(3.0, 5.0) * np.array([np.cos(angle), np.sin(angle)]))
        observations, truth = draw(moved, rng, sigma_px=SIGMA_PX, averaged=True)
        adjustment = adjust_scene(FlatModel(), SHAPE, observations, ground_may_move=True)
        ratios.append(beside(adjustment, truth, moved)[0])
    assert np.max(ratios) < WRONG


@pytest.mark.monte_carlo
@pytest.mark.parametrize("name", MOTIONS)
def test_lines_and_samples_that_move_are_not_taken_for_ground_that_did(name: str):
    trials = [trial(MOTIONS[name], 300 + seed) for seed in range(6)]
    assert sum(one.adjustment.moved is not None for one in trials) <= 1
    places = np.random.default_rng(1).random((100, 2)) * SHAPE
    assert np.abs(beyond_affine(MOTIONS[name], places)).max() > 2.0 * SIGMA_PX
