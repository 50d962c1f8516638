"""Blocks tied to a neighbour by common images: one seam, one frame, and no observation counts twice."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import NO_CONTROL, ControlGround
from amers.services.adjustment.known_images import known_images, tie
from amers.services.adjustment.parameters import ImageParameters, image_parameters
from amers.services.errors import InputError
from amers.services.geodesy import move_metres
from amers.services.sensors.correction import CorrectedModel, ImageCorrection
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, Frame, IntArray, Observations
from benchmarks.block_coverage import SHIFT_PX, Case, draw, whitened_square
from tests.services.adjustment.grounds import ground_of
from tests.services.conftest import SHAPE, FlatModel
from tests.services.ties import difference_m

TRIALS = 10
POINT_SIGMA_M, FRAME_SIGMA_M = 0.3, 0.8
SEAMS = {"star": ([0, 1, 2, 3, 4], [0, 3, 4, 5, 6]), "strip": ([*range(9)], [*range(6, 16)])}
"""Images of the first block and of the second, by layout."""


@dataclass(frozen=True)
class Seam:
    """Two blocks with common images.

    Attributes:
        truth: (p, 3) points.
        images: of the first block, and of the second.
        observations: of both: of common images the same.
        control: of the first block.
    """

    truth: Array
    images: tuple[list[ImageParameters], list[ImageParameters]]
    observations: tuple[Observations, Observations]
    control: ControlGround


def of_images(observations: Observations, rows: Sequence[int]) -> Observations:
    """The observations of some images, of points that two of them see."""
    number = np.full(int(observations.image.max()) + 1, -1)
    number[rows] = np.arange(len(rows))
    own = observations.take(number[observations.image] >= 0)
    own = own.take(np.bincount(own.point)[own.point] >= 2)
    return replace(own, image=number[own.image].astype(np.int64))


def known_ground(truth: Array, point: IntArray, rng: np.random.Generator) -> ControlGround:
    error_m = rng.normal(0.0, POINT_SIGMA_M, (len(point), 3)) + rng.normal(0.0, FRAME_SIGMA_M, 3)
    frame = Frame.from_sigmas(FRAME_SIGMA_M, FRAME_SIGMA_M)
    known = move_metres(truth[point], error_m)
    return ground_of(point, known, np.eye(3) * POINT_SIGMA_M**2, frame)


@cache
def seam(layout: str, trial: int) -> Seam:
    rng = np.random.default_rng([9, trial])
    truth, images, observations = draw(Case(layout, 0.3, 0.0), rng)
    one, other = SEAMS[layout]
    observed = of_images(observations, one), of_images(observations, other)
    seen = np.unique(observed[0].point)
    control = known_ground(truth, seen[:: len(seen) // 12], rng)
    return Seam(truth, ([images[i] for i in one], [images[i] for i in other]), observed, control)


@cache
def first(layout: str, trial: int) -> BlockAdjustment:
    of = seam(layout, trial)
    return adjust_block(of.images[0], of.observations[0], control=of.control)


@cache
def second(layout: str, trial: int, *, tied: bool) -> BlockAdjustment:
    of = seam(layout, trial)
    neighbour = first(layout, trial).known if tied else None
    return adjust_block(of.images[1], of.observations[1], neighbour=neighbour)


def error_m(block: BlockAdjustment, truth: Array) -> tuple[Array, Array]:
    """Errors (f, 3) of the points that were found, and their covariances relative to the frame."""
    found = np.flatnonzero(np.isfinite(block.lon_lat_h[:, 0]))
    return difference_m(block.lon_lat_h[found], truth[found]), block.point_covariance_m2[found]


def step_m(layout: str, trial: int, *, tied: bool) -> Array:
    """How far (s, 3) the points that both blocks have lie apart."""
    one, other = first(layout, trial).lon_lat_h, second(layout, trial, tied=tied).lon_lat_h
    size = min(len(one), len(other))
    both = np.isfinite(one[:size, 0]) & np.isfinite(other[:size, 0])
    return difference_m(other[:size][both], one[:size][both])


def total_covariance(block: BlockAdjustment, names: Sequence[str], move: Array) -> Array:
    """Covariance of the parameters of some images, with that of the frame."""
    assert block.known is not None
    rows = np.array([block.known.names.index(name) for name in names])
    return block.known.take(rows).relative + move @ block.known.frame.covariance_m2 @ move.T


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("layout", ["star", "strip"])
def test_the_frame_of_a_neighbour_carries_over_and_covers_the_truth(layout) -> None:
    on_earth, of_frame, ratios = [], [], []
    for trial in range(TRIALS):
        block, free = second(layout, trial, tied=True), second(layout, trial, tied=False)
        frame_m2 = block.frames[0].covariance_m2
        errors, covariance = error_m(block, seam(layout, trial).truth)
        on_earth.append(whitened_square(errors, covariance + frame_m2).mean() / 3.0)
        middle = np.median(errors, axis=0)
        of_frame.append(middle @ np.linalg.solve(frame_m2, middle) / 3.0)
        sigma = [np.sqrt(np.diagonal(of.frames[0].covariance_m2)) for of in (block, free)]
        ratios.append(sigma[0] / np.sqrt(np.diagonal(first(layout, trial).frames[0].covariance_m2)))
        assert sigma[0][2] < 0.25 * sigma[1][2], "the height of the frame is that of the neighbour"
    assert np.max(ratios) < 1.1
    assert 0.4 < np.mean(of_frame) < 1.8
    assert 0.5 < np.mean(on_earth) < 1.6


@pytest.mark.parametrize("layout", ["star", "strip"])
@pytest.mark.long
def test_both_blocks_agree_along_the_seam_as_they_declare(layout) -> None:
    """What the second block changes of the common images is what it knows more of them."""
    changes, steps, free_steps = [], [], []
    for trial in range(TRIALS):
        one, other = first(layout, trial), second(layout, trial, tied=True)
        common = tie(seam(layout, trial).images[1], one.known)
        rows = common.parameter_rows(other.values.shape[1])
        move = other.accuracy.move[rows]
        before = total_covariance(one, common.known.names, move)
        after = total_covariance(other, common.known.names, move)
        values, vectors = np.linalg.eigh(before - after)
        assert values.min() > -1e-3 * values.max(), "something was learnt twice"
        learnt = values > 0.01 * values.max()
        change = other.values[common.rows].ravel() - common.known.values.ravel()
        changes.append(np.mean((vectors[:, learnt].T @ change) ** 2 / values[learnt]))
        steps.append(np.sqrt(np.mean(step_m(layout, trial, tied=True) ** 2, axis=0)))
        free_steps.append(np.sqrt(np.mean(step_m(layout, trial, tied=False) ** 2, axis=0)))
    step, free_step = np.mean(steps, axis=0), np.mean(free_steps, axis=0)
    assert 0.5 < np.mean(changes) < 1.6
    assert step[2] < 0.4 * free_step[2]


def test_a_tied_block_knows_no_more_than_one_adjustment_of_all_images() -> None:
    """All observations at once: the tie loses little of that, and invents nothing."""
    for trial in range(3):
        rng = np.random.default_rng([9, trial])
        _, images, observations = draw(Case("star", 0.3, 0.0), rng)
        of = seam("star", trial)
        # Numbers of points are those of the draw in all three adjustments.
        whole = adjust_block(images, observations, control=of.control)
        tied = second("star", trial, tied=True)
        rows = SEAMS["star"][1]
        size = tied.values.shape[1]
        inside = (np.array(rows)[:, None] * size + np.arange(size)).ravel()
        sigma = np.sqrt(tied.accuracy.variance()[: len(rows) * size])
        best = np.sqrt(whole.accuracy.variance()[inside])
        # Counting what common images see together twice gives 0.96.
        assert (sigma > 0.99 * best).all(), (sigma / best).min()
        assert np.median(sigma / best) < 1.1
        off = (tied.values - whole.values[rows]).ravel() / sigma
        assert np.sqrt(np.mean(off**2)) < 0.5


def test_a_block_of_the_same_images_learns_nothing() -> None:
    of, one = seam("star", 0), first("star", 0)
    again = adjust_block(of.images[0], of.observations[0], neighbour=one.known)
    np.testing.assert_allclose(again.values, one.values, atol=1e-3)
    np.testing.assert_allclose(
        again.frames[0].covariance_m2, one.frames[0].covariance_m2, rtol=1e-3, atol=1e-6
    )


def test_a_neighbour_of_the_same_pass_does_not_sharpen_the_frame() -> None:
    """Nobody states how much a pass shares: if all, more of its images tell nothing new."""
    of = seam("star", 0)
    one = adjust_block(of.images[0], of.observations[0], passes=[np.ones(5, dtype=np.bool_)])
    both = [np.ones(5, dtype=np.bool_)]
    other = adjust_block(of.images[1], of.observations[1], neighbour=one.known, passes=both)
    alone = adjust_block(of.images[1], of.observations[1], neighbour=one.known)
    assert one.frames[0].sigma_m > 0.95 * SHIFT_PX
    assert other.frames[0].sigma_m > 0.95 * SHIFT_PX
    assert alone.frames[0].sigma_m < 0.75 * SHIFT_PX


def test_other_images_and_other_models_are_refused() -> None:
    of, known = seam("star", 0), first("star", 0).known
    strangers = [replace(image, name=f"other {k}") for k, image in enumerate(of.images[1])]
    with pytest.raises(InputError, match=r"none of the 5 images of the block: image 1 and 4 more there"):
        adjust_block(strangers, of.observations[1], neighbour=known)
    image = of.images[1][1]
    shift = ImageCorrection(np.array([[0.5, 0, 0], [0, 0, 0]]), image.zero.centre, image.zero.half_size)
    corrected = [*of.images[1]]
    corrected[1] = replace(image, model=CorrectedModel(image.model, shift))
    with pytest.raises(InputError, match=r"image 4: its model is not the one that the neighbour"):
        adjust_block(corrected, of.observations[1], neighbour=known)


def test_a_neighbour_and_control_place_a_block_together() -> None:
    of = seam("star", 1)
    rng = np.random.default_rng(3)
    seen = np.unique(of.observations[1].point)
    control = known_ground(of.truth, seen[:: len(seen) // 12], rng)
    neighbour = first("star", 1).known
    tied, both = (
        adjust_block(of.images[1], of.observations[1], neighbour=neighbour, control=ground)
        for ground in (NO_CONTROL, control)
    )
    assert both.frames[0].sigma_m < 0.85 * tied.frames[0].sigma_m
    assert both.control_active.all()
    errors, covariance = error_m(both, of.truth)
    assert whitened_square(errors, covariance + both.frames[0].covariance_m2).mean() / 3.0 < 3.0


def test_an_image_whose_lines_one_block_followed_and_the_other_did_not_ties_nothing() -> None:
    """Its parameters are those of the rest, and mean something else without what was followed."""
    ends = np.array([0.0, 1000.0])
    oscillation = DisplacementGrid(ends, ends, np.ones((2, 2, 2)), np.zeros((2, 2, 2)))
    still, followed = (
        image_parameters("a", FlatModel(), SHAPE, shift_px=5.0, slope_px=1.0, displacement=one)
        for one in (None, oscillation)
    )
    for before, now in ((still, still), (followed, followed), (still, followed), (followed, still)):
        known = known_images([before], np.zeros((1, 6)), np.eye(6), Frame(np.eye(3)))
        if (before is still) == (now is still):
            assert tie([now], known).rows.tolist() == [0]
            continue
        with pytest.raises(InputError, match="a: its lines or samples were followed in one block"):
            tie([now], known)
