"""Parts of an image between breaks are placed by their own points, or stated as unknown."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest

from amers.services.misfit.broken_image import held_parts, placed_steps
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.displacement_components import Component
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.quality.accuracy import normalised_error
from amers.services.quality.normal_law import normal_ce90
from amers.services.sensors.correction import ImageCorrection, no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, IntArray
from tests.services.conftest import FlatModel

SHAPE = (4000, 3000)
CHIP_PX = 120.0
SIGMA_PX = 0.4


@dataclass(frozen=True)
class Broken:
    """A scene that lost lines (a negative number: repeated them) before a line of its image.

    Attributes:
        truth: its affine correction, before the break.
        line, lost: first line behind the break, and number of lines.
    """

    truth: ImageCorrection
    line: int
    lost: float

    def shown(self, predicted: Array) -> tuple[Array, Array]:
        """Where it shows positions (n, 2) of the model, and which (n,) it shows once."""
        before = self.truth.apply(predicted)
        behind = before - [self.lost, 0.0]
        is_before, is_behind = before[:, 0] < self.line - 0.5, behind[:, 0] > self.line - 0.5
        return np.where(is_before[:, None], before, behind), is_before ^ is_behind

    def observed(self, rng: np.random.Generator, count: int = 100) -> ControlObservations:
        """Points all over it, with noise; those that it does not show are not found."""
        predicted = rng.random((count, 2)) * (np.array(SHAPE) - 1.0)
        line_sample, once = self.shown(predicted)
        line_sample = line_sample + SIGMA_PX * rng.normal(size=(count, 2))
        line_sample[~once] = np.nan
        return ControlObservations(
            FlatModel().locate(predicted, np.zeros(count)),
            line_sample,
            np.full(count, SIGMA_PX),
            np.zeros((count, 3, 3)),
            chip_side_px=CHIP_PX,
            breaks=np.array([self.line]),
        )

    def errors(self, adjustment: SceneAdjustment) -> tuple[Array, Array, Array]:
        """Places (n, 2) all over the image, errors (n, 2) there and covariances (n, 2, 2)."""
        predicted = np.random.default_rng(0).random((400, 2)) * (np.array(SHAPE) - 1.0)
        shown, once = self.shown(predicted)
        place = adjustment.correction.apply(predicted[once])
        return shown[once], place - shown[once], adjustment.covariance_at(place)


def broken(seed: int, lost: float, line: int = 1500) -> tuple[Broken, np.random.Generator]:
    rng = np.random.default_rng(seed)
    parameters = np.column_stack([rng.normal(0.0, 30.0, 2), rng.normal(0.0, 1.0, (2, 2))])
    return Broken(replace(no_correction(SHAPE), parameters=parameters), line, lost), rng


def without(observations: ControlObservations, hidden: Array) -> ControlObservations:
    return replace(observations, line_sample=np.where(hidden[:, None], np.nan, observations.line_sample))


@pytest.mark.parametrize("lost", [3.0, 40.0, 150.0, -3.0, -60.0])
@pytest.mark.long
def test_both_parts_are_right_and_so_is_what_is_stated(lost: float) -> None:
    normalised, largest = [], []
    for seed in range(12):
        scene, rng = broken(seed, lost)
        place, error, covariance = scene.errors(adjust_scene(FlatModel(), SHAPE, scene.observed(rng)))
        # The boundary in the model is known to a few pixels; what lies there is in neither part.
        clear = np.abs(place[:, 0] - scene.line) > 5.0
        normalised.append(normalised_error(error[clear], covariance[clear]).mean_square)
        largest.append(float(np.hypot(*error[clear].T).max()))
    assert 0.6 < np.mean(normalised) < 1.4
    assert np.max(largest) < 1.5


def test_a_part_without_points_is_stated_as_unknown_and_the_other_is_as_precise_as_ever() -> None:
    scene, rng = broken(1, 40.0, line=3000)
    observations = scene.observed(rng)
    hidden = observations.line_sample[:, 0] >= scene.line
    adjustment = adjust_scene(FlatModel(), SHAPE, without(observations, hidden))
    place, error, covariance = scene.errors(adjustment)
    behind, ce90_px = place[:, 0] > scene.line, normal_ce90(covariance)
    assert np.abs(error[behind, 0]).min() > 30.0
    assert ce90_px[behind].min() > 70.0
    assert ce90_px[~behind].max() < 1.0
    assert np.hypot(*error[~behind].T).max() < 1.0


def test_two_points_do_not_hold_a_part() -> None:
    scene, rng = broken(2, 40.0, line=3000)
    observations = scene.observed(rng)
    behind = np.flatnonzero(observations.line_sample[:, 0] >= scene.line + CHIP_PX)
    hidden = observations.line_sample[:, 0] >= scene.line
    hidden[behind[:2]] = False
    two = adjust_scene(FlatModel(), SHAPE, without(observations, hidden))
    assert not two.active[behind].any()
    hidden[behind[:4]] = False
    four = adjust_scene(FlatModel(), SHAPE, without(observations, hidden))
    assert four.active[behind[:4]].all()


def test_chips_that_a_break_cuts_near_their_middle_are_left_out() -> None:
    scene, rng = broken(3, 8.0)
    observations = scene.observed(rng, count=300)
    apart = np.abs(observations.line_sample[:, 0] - scene.line)
    active = adjust_scene(FlatModel(), SHAPE, observations).active
    assert not active[apart < 0.2 * CHIP_PX].any()
    assert active[apart > 0.3 * CHIP_PX].mean() > 0.9
    assert active[(apart > 0.3 * CHIP_PX) & (apart < 0.7 * CHIP_PX)].mean() > 0.5


@pytest.mark.parametrize("lost", [150.0, -60.0])
def test_a_break_is_in_the_middle_of_the_lines_that_are_missing_or_repeated(lost: float) -> None:
    scene, rng = broken(7, lost)
    (step,) = adjust_scene(FlatModel(), SHAPE, scene.observed(rng)).components
    assert step.kind == "break"
    middle = np.array([[scene.line - 0.5 + lost / 2.0, SHAPE[1] / 2.0]])
    expected = scene.truth.invert(middle)[0, 0]
    assert step.at_px + step.length_px / 2.0 == pytest.approx(expected, abs=3.0)


def test_lines_end_half_a_pixel_before_the_first_line_behind_a_break() -> None:
    """Pixel positions are those of the middles of pixels: both sides end between two lines."""
    nodes = np.array([0.0, 2000.0, 2001.0, SHAPE[0] - 1.0])
    moved = np.zeros((4, 2, 2))
    moved[2:, :, 0] = -20.0
    grid = DisplacementGrid(nodes, np.array([0.0, SHAPE[1] - 1.0]), moved, np.zeros(moved.shape))
    correction = replace(no_correction(SHAPE), displacement=grid)
    before = Component("break", 1.0, 2000.0, np.ones(2))
    (placed,) = placed_steps(np.array([2000]), (before,), correction)
    assert placed.at_px + placed.length_px / 2.0 == pytest.approx((1999.5 + 2019.5) / 2.0)


@pytest.mark.parametrize("counts", list(product((0, 2, 3), repeat=3)))
def test_a_part_is_held_by_three_active_points_whatever_others_are(counts: tuple[int, int, int]) -> None:
    """First lines behind breaks belong to the part behind, and the last before them to the other."""
    breaks = np.array([1000, 2500])
    borders = [(0.0, 999.0), (1000.0, 2499.0), (2500.0, 3999.0)]
    line = np.concatenate(
        [np.linspace(first, last, count) for (first, last), count in zip(borders, counts, strict=True)]
    )
    beside = np.repeat(np.array(borders).ravel(), 2)
    active = np.arange(len(line) + len(beside)) < len(line)
    held = held_parts(breaks, np.concatenate([line, beside]), active)
    assert held.tolist() == [count >= 3 for count in counts]


def test_a_break_where_nothing_moved_costs_little() -> None:
    scene, rng = broken(4, 0.0)
    observations = scene.observed(rng)
    places = np.random.default_rng(0).random((200, 2)) * (np.array(SHAPE) - 1.0)
    told, untold = (
        adjust_scene(FlatModel(), SHAPE, one)
        for one in (observations, replace(observations, breaks=np.zeros(0, dtype=np.int64)))
    )
    ratio = normal_ce90(told.covariance_at(places)) / normal_ce90(untold.covariance_at(places))
    assert np.median(ratio) < 2.0
    apart = told.correction.apply(places) - untold.correction.apply(places)
    assert np.quantile(np.hypot(*apart.T), 0.9) < 0.5


def test_the_order_that_a_user_gives_is_kept() -> None:
    scene, rng = broken(5, 40.0)
    adjustment = adjust_scene(FlatModel(), SHAPE, scene.observed(rng), AdjustmentOptions(order="drift"))
    assert adjustment.correction.displacement is None


def test_several_breaks_are_followed() -> None:
    first, rng = broken(6, 30.0, line=1200)
    second = Broken(first.truth, 2600, 30.0 + -55.0)
    predicted = rng.random((160, 2)) * (np.array(SHAPE) - 1.0)
    line_sample, once = first.shown(predicted)
    later, later_once = second.shown(predicted)
    is_later = line_sample[:, 0] > 2500.0
    line_sample = np.where(is_later[:, None], later, line_sample)
    line_sample[~np.where(is_later, later_once, once)] = np.nan
    breaks: IntArray = np.array([1200, 2600])
    observations = replace(
        first.observed(rng, count=160),
        lon_lat_h=FlatModel().locate(predicted, np.zeros(160)),
        line_sample=line_sample + SIGMA_PX * rng.normal(size=(160, 2)),
        breaks=breaks,
    )
    adjustment = adjust_scene(FlatModel(), SHAPE, observations)
    steps = [one for one in adjustment.components if one.kind == "break"]
    assert len(steps) == 2
    found = np.isfinite(observations.line_sample).all(axis=1)
    left = adjustment.residual_px[found & adjustment.active]
    assert adjustment.active[found].mean() > 0.85
    assert np.sqrt(np.mean(left**2)) < 1.3 * SIGMA_PX
