"""Known ground places a block as precisely as its frame is known, and wrong points leave by name."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.control_ground import ControlGround
from amers.services.errors import NoConsensus
from amers.services.geodesy import move_metres
from amers.services.types import UNKNOWN_FRAME, Array, Frame, Observations
from benchmarks.block_coverage import Case, draw
from tests.services.adjustment.grounds import ground_of
from tests.services.ties import difference_m

point_sigma_m = 0.3
frame_sigma_m = 0.8
count = 12
trials = 12
CASE = Case("ring", 0.3, 0.0)
FRAME = Frame.from_sigmas(frame_sigma_m, frame_sigma_m)


def known_ground(truth: Array, rng: np.random.Generator, wrong: int = 0) -> ControlGround:
    """Points with their own errors and one of their frame; the first `wrong` are 15 m off besides."""
    error_m = rng.normal(0.0, point_sigma_m, (count, 3)) + rng.normal(0.0, frame_sigma_m, 3)
    error_m[:wrong] += rng.choice([-15.0, 15.0], (wrong, 3))
    known = move_metres(truth[:count], error_m)
    return ground_of(np.arange(count), known, np.eye(3) * point_sigma_m**2, FRAME)


def frame_error_m(block: BlockAdjustment, truth: Array) -> Array:
    return np.asarray(np.nanmedian(difference_m(block.lon_lat_h, truth[: len(block.lon_lat_h)]), axis=0))


@pytest.mark.monte_carlo
def test_the_frame_is_that_of_the_control_and_covers_the_truth() -> None:
    normalised = []
    for trial in range(trials):
        rng = np.random.default_rng([3, trial])
        truth, images, observations = draw(CASE, rng)
        block = adjust_block(images, observations, control=known_ground(truth, rng, wrong=2))
        assert not block.control_active[:2].any()
        seen = np.isin(np.arange(count), observations.point)
        assert block.control_active[2:].tolist() == seen[2:].tolist()
        covariance = block.frames[0].covariance_m2
        # Images of 3 m help a little; 0.3 m of ten points add a little.
        assert (np.sqrt(np.diagonal(covariance)) < 1.15 * frame_sigma_m).all()
        error_m = frame_error_m(block, truth)
        normalised.append(error_m @ np.linalg.solve(covariance, error_m) / 3.0)
    assert 0.4 < np.mean(normalised) < 1.8


def test_known_planimetry_places_the_position_alone() -> None:
    rng = np.random.default_rng(4)
    truth, images, observations = draw(CASE, rng)
    control = known_ground(truth, rng)
    flat = control.covariance_m2.copy()
    flat[:, 2, 2] = np.inf
    free = adjust_block(images, observations)
    placed = adjust_block(images, observations, control=replace(control, covariance_m2=flat))
    assert placed.frames[0].sigma_m < 0.75 * free.frames[0].sigma_m
    assert placed.frames[0].sigma_up_m > 0.6 * free.frames[0].sigma_up_m
    assert np.isnan(placed.control_misfit_m[:, 2]).all()


def test_control_whose_frame_is_unknown_does_not_place_the_block() -> None:
    rng = np.random.default_rng(5)
    truth, images, observations = draw(CASE, rng)
    control = replace(known_ground(truth, rng), frames=(UNKNOWN_FRAME,))
    free, shaped = (
        adjust_block(images, observations),
        adjust_block(images, observations, control=control),
    )
    np.testing.assert_allclose(
        shaped.frames[0].covariance_m2, free.frames[0].covariance_m2, rtol=0.05, atol=0.05
    )


def test_control_that_mostly_disagrees_is_refused_by_name() -> None:
    rng = np.random.default_rng(6)
    truth, images, observations = draw(CASE, rng)
    control = known_ground(truth, rng)
    scattered = move_metres(control.lon_lat_h, rng.uniform(-40.0, 40.0, (count, 3)))
    with pytest.raises(NoConsensus, match=r"of 12 control points disagree .*P\d"):
        adjust_block(images, observations, control=replace(control, lon_lat_h=scattered))


@pytest.mark.parametrize(("wrong", "accepted"), [(5, True), (7, False)])
def test_a_block_follows_its_control_as_long_as_most_of_it_agrees(wrong: int, accepted: bool) -> None:
    rng = np.random.default_rng(9)
    truth, images, observations = draw(CASE, rng)
    control = known_ground(truth, rng)
    off_m = np.where(np.arange(count) < wrong, 1.0, 0.0)[:, None] * rng.uniform(-40.0, 40.0, (count, 3))
    mixed = replace(control, lon_lat_h=move_metres(control.lon_lat_h, off_m))
    if accepted:
        block = adjust_block(images, observations, control=mixed)
        assert not block.control_active[:wrong].any()
        assert block.control_active[wrong:].all()
    else:
        with pytest.raises(NoConsensus, match=r"of 12 control points disagree .*P1, P2, P3"):
            adjust_block(images, observations, control=mixed)


def of_one_image(observations: Observations, known: int) -> Observations:
    """The observations with the first rays alone of the first `known` points."""
    first = np.unique(observations.point, return_index=True)[1]
    is_first = np.isin(np.arange(len(observations)), first)
    return observations.take(is_first | (observations.point >= known))


@pytest.mark.thorough
def test_known_points_that_one_image_shows_place_the_block_as_well() -> None:
    normalised = []
    for trial in range(trials):
        rng = np.random.default_rng([7, trial])
        truth, images, observations = draw(CASE, rng)
        control = known_ground(truth, rng, wrong=2)
        free = adjust_block(images, of_one_image(observations, count))
        block = adjust_block(images, of_one_image(observations, count), control=control)
        assert not block.control_active[:2].any()
        assert block.control_active[2:].sum() >= count - 3
        covariance = block.frames[0].covariance_m2
        assert block.frames[0].sigma_m < 0.75 * free.frames[0].sigma_m
        error_m = np.nanmedian(difference_m(block.lon_lat_h, truth)[count:], axis=0)
        normalised.append(error_m @ np.linalg.solve(covariance, error_m) / 3.0)
    assert 0.4 < np.mean(normalised) < 1.8


def test_images_far_off_are_placed_by_known_points_of_one_image_each() -> None:
    rng = np.random.default_rng(8)
    truth, images, observations = draw(CASE, rng)
    far = [
        replace(image, prior_px=np.where(image.prior_px > 1.0, 60.0, image.prior_px)) for image in images
    ]
    moved = replace(observations, line_sample=observations.line_sample + [45.0, -50.0])
    block = adjust_block(far, of_one_image(moved, count), control=known_ground(truth, rng))
    assert block.control_active.sum() >= count - 1
    error_m = np.nanmedian(difference_m(block.lon_lat_h, truth)[count:], axis=0)
    covariance = block.frames[0].covariance_m2
    assert error_m @ np.linalg.solve(covariance, error_m) < 11.3
    assert np.sqrt(np.diagonal(covariance)).max() < 1.5
