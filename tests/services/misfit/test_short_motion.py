"""Motion within the lines of a chip is found in strips of chips, and is in the stated accuracy."""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.misfit.short_motion import (
    MAX_CHANCE,
    STRIPS,
    ChipStrips,
    ShortMotion,
    short_motion,
)
from amers.services.quality.accuracy import normalised_error
from amers.services.sensors.correction import no_correction
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array
from tests.services.conftest import GSD_M, FlatModel

SHAPE = (4000, 3000)
SIDE_PX = 400.0
NOISE_PX = 0.4
"""Of a strip of a chip."""
SLOPE_PX = 1.0
"""By which slopes of the ground displace the first and the last strip of a chip, typically."""
WITHIN = np.linspace(-0.5, 0.5, 33) / STRIPS * SIDE_PX
MIDDLE = (np.arange(STRIPS) - (STRIPS - 1) / 2.0) * SIDE_PX / STRIPS

Motion = Callable[[Array], Array]
"""Displacement (..., 2) at lines (...)."""


def still(line: Array) -> Array:
    return np.zeros((*line.shape, 2))


def oscillation(period: float, size_px: tuple[float, float]) -> Motion:
    def motion(line: Array) -> Array:
        turn = 2.0 * np.pi * line / period
        return np.stack([size_px[0] * np.sin(turn), size_px[1] * np.cos(turn + 1.0)], axis=-1)

    return motion


def several(*motions: Motion) -> Motion:
    return lambda line: np.sum([motion(line) for motion in motions], axis=0)


def chips(rng: np.random.Generator, count: int) -> Array:
    """Places (n, 2) of chips inside the image."""
    return SIDE_PX / 2.0 + rng.random((count, 2)) * (np.array(SHAPE) - 1.0 - SIDE_PX)


def of_strips(motion: Motion, place: Array) -> Array:
    """Displacement (n, s, 2) of strips as they show it: averaged over their lines."""
    line = place[:, :1] + MIDDLE
    return np.asarray(motion(line[:, :, None] + WITHIN).mean(axis=2))


def strips(motion: Motion, place: Array, rng: np.random.Generator) -> ChipStrips:
    """Strips of chips with noise, slopes of the ground, and one chip in twenty that shows nonsense."""
    shown = of_strips(motion, place)
    shown = shown - shown.mean(axis=1, keepdims=True)
    slope = SLOPE_PX * rng.normal(size=(len(place), 1, 2)) * np.linspace(-1.0, 1.0, STRIPS)[:, None]
    noise = NOISE_PX * rng.normal(size=shown.shape)
    noise[rng.random(len(place)) < 0.05] *= 8.0
    return ChipStrips(
        np.broadcast_to(MIDDLE, shown.shape[:2]), shown + slope + noise, np.full(shown.shape, NOISE_PX)
    )


def found(motion: Motion, seed: int, count: int = 100) -> ShortMotion:
    rng = np.random.default_rng(seed)
    place = chips(rng, count)
    return short_motion(strips(motion, place, rng), place, SIDE_PX)


@pytest.mark.parametrize("period", [140.0, 200.0, 330.0, 600.0])
def test_an_oscillation_shorter_than_chips_is_found_with_its_period_and_its_size(period: float) -> None:
    size_px = (1.0, 2.0)
    results = [found(oscillation(period, size_px), seed) for seed in range(8)]
    assert all(one.structure.chance < MAX_CHANCE for one in results)
    assert [one.structure.at for one in results] == pytest.approx([period] * 8, rel=0.08)
    sizes = np.mean([np.sqrt(2.0 * one.variance_px2) for one in results], axis=0)
    assert sizes == pytest.approx(size_px, rel=0.15)
    largest = np.mean([one.structure.largest_px for one in results])
    assert largest == pytest.approx(np.hypot(*size_px), rel=0.15)


def test_several_oscillations_add_up() -> None:
    motion = several(
        oscillation(130.0, (1.0, 0.0)), oscillation(210.0, (0.0, 1.5)), oscillation(370.0, (0.8, 0.8))
    )
    variance = np.mean([found(motion, seed).variance_px2 for seed in range(8)], axis=0)
    assert variance == pytest.approx([(1.0 + 0.64) / 2.0, (2.25 + 0.64) / 2.0], rel=0.2)


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_scenes_that_do_not_move_are_not_accused() -> None:
    """400 scenes, of which chance may accuse one in ten thousand; slopes of the ground move none."""
    results = [found(still, seed, count=60) for seed in range(400)]
    assert sum(one.structure.chance < MAX_CHANCE for one in results) <= 1
    assert np.mean([one.variance_px2 for one in results]) < 0.02 * NOISE_PX**2


@pytest.mark.monte_carlo
def test_the_chance_of_a_scene_that_does_not_move_is_what_it_says() -> None:
    """As many periods are tried as there are, and most scenes show none of them."""
    results = [found(still, seed, count=40) for seed in range(400, 520)]
    assert 0.005 < np.mean([one.structure.chance < 0.05 for one in results]) < 0.08
    assert np.mean([one.variance_px2.any() for one in results]) < 0.4


@pytest.mark.monte_carlo
def test_lines_of_a_scene_whose_samples_oscillate_get_less_than_chance_shows_of_them() -> None:
    results = [found(oscillation(200.0, (0.0, 1.0)), seed, count=40) for seed in range(40)]
    contrasts = 40 * (STRIPS - 3)
    by_chance_px2 = 2.0 * NOISE_PX**2 / contrasts
    lines_px2, samples_px2 = np.mean([one.variance_px2 for one in results], axis=0)
    assert samples_px2 == pytest.approx(0.5, rel=0.1)
    # What exceeds its mean by chance, if the rest counts as nothing: 0.37 of an exponential law.
    assert 0.2 * by_chance_px2 < lines_px2 < 1.2 * by_chance_px2


def test_chips_that_overlap_are_no_further_evidence() -> None:
    """What one place shows by chance, it shows in all its chips: copies change nothing."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        place = chips(rng, 40)
        once = strips(still, place, rng)
        four = ChipStrips(*(np.repeat(column, 4, axis=0) for column in vars(once).values()))
        again = short_motion(four, np.repeat(place, 4, axis=0), SIDE_PX)
        alone = short_motion(once, place, SIDE_PX)
        assert again.structure.chance == pytest.approx(alone.structure.chance, rel=1e-6)


def test_errors_of_the_points_and_the_order_of_the_points_do_not_count() -> None:
    rng = np.random.default_rng(3)
    place = chips(rng, 60)
    shown = strips(oscillation(200.0, (1.0, 1.0)), place, rng)
    before = short_motion(shown, place, SIDE_PX)
    moved = replace(shown, displacement_px=shown.displacement_px + rng.normal(0.0, 30.0, (60, 1, 2)))
    order = rng.permutation(60)
    after = short_motion(moved.take(order), place[order], SIDE_PX)
    assert after.variance_px2 == pytest.approx(before.variance_px2, rel=1e-6)


def test_few_or_unknown_strips_show_nothing() -> None:
    rng = np.random.default_rng(4)
    place = chips(rng, 60)
    shown = strips(oscillation(200.0, (3.0, 3.0)), place, rng)
    unknown = replace(shown, displacement_px=np.full(shown.displacement_px.shape, np.nan))
    for some, where in ((shown.take(np.arange(5)), place[:5]), (unknown, place)):
        assert not short_motion(some, where, SIDE_PX).variance_px2.any()


@pytest.mark.long
def test_the_memory_does_not_grow_with_the_scene() -> None:
    """A scene of 60,000 lines has thousands of periods and points."""
    rng = np.random.default_rng(5)
    place = rng.random((2000, 2)) * [60_000.0, 20_000.0]
    middle = MIDDLE / SIDE_PX * 100.0
    shown = ChipStrips(
        np.broadcast_to(middle, (2000, STRIPS)),
        rng.normal(0.0, NOISE_PX, (2000, STRIPS, 2)),
        np.full((2000, STRIPS, 2), NOISE_PX),
    )
    tracemalloc.start()
    assert short_motion(shown, place, 100.0).structure.chance > MAX_CHANCE
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40e6


def adjusted(motion: Motion, seed: int, of_points_px: float) -> tuple[SceneAdjustment, float]:
    """A scene adjusted on chips that average its motion, and its normalised error at all its places."""
    rng = np.random.default_rng(seed)
    place = chips(rng, 100)
    frame = no_correction(SHAPE)
    truth = replace(frame, parameters=rng.normal(0.0, 2.0, (2, 3)))
    line_sample = truth.apply(place) + of_strips(motion, place).mean(axis=1)
    line_sample += np.hypot(0.1, of_points_px) * rng.normal(size=(100, 2))
    observations = ControlObservations(
        FlatModel().locate(place, np.zeros(100)),
        line_sample,
        np.full(100, 0.1),
        np.tile((of_points_px * GSD_M) ** 2 * np.eye(3), (100, 1, 1)),
        chip_side_px=SIDE_PX,
        strips=strips(motion, place, rng),
    )
    adjustment = adjust_scene(FlatModel(), SHAPE, observations)
    places = rng.random((400, 2)) * (np.array(SHAPE) - 1.0)
    error = adjustment.correction.apply(places) - truth.apply(places) - motion(places[:, 0])
    covariance = adjustment.covariance_at(adjustment.correction.apply(places))
    return adjustment, normalised_error(error, covariance).mean_square


@pytest.mark.parametrize("of_points_px", [0.3, 2.0])
def test_the_stated_accuracy_holds_motion_that_positions_of_chips_cannot_show(
    of_points_px: float,
) -> None:
    """However inaccurate the points are: strips of a chip share their errors."""
    results = [adjusted(oscillation(180.0, (1.5, 2.0)), seed, of_points_px) for seed in range(10)]
    assert 0.7 < np.mean([square for _, square in results]) < 1.5
    named = [one for result, _ in results for one in result.structures if one.family == "chips"]
    assert all(one.chance < MAX_CHANCE for one in named)


def test_a_displacement_moves_the_strips_of_a_chip_as_the_motion_that_it_follows() -> None:
    motion, place = oscillation(700.0, (2.0, 3.0)), chips(np.random.default_rng(7), 30)
    line, sample = np.linspace(0.0, SHAPE[0] - 1.0, 2000), np.array([0.0, SHAPE[1] - 1.0])
    moved = np.repeat(motion(line)[:, None], 2, axis=1)
    grid = DisplacementGrid(line, sample, moved, np.zeros(moved.shape))
    shown = motion(place[:, :1] + MIDDLE)
    strips_of_all = strips(still, place, np.random.default_rng(8))
    np.testing.assert_allclose(
        strips_of_all.against(grid, place), shown - shown.mean(axis=1, keepdims=True), atol=1e-3
    )


@pytest.mark.long
def test_motion_that_is_followed_is_not_counted_again() -> None:
    """An oscillation longer than chips moves their strips as well, until the correction follows it."""
    results = [adjusted(oscillation(1200.0, (3.0, 3.0)), seed, 0.3) for seed in range(5)]
    assert all(result.components for result, _ in results)
    assert all(result.short_motion.variance_px2.max() < 0.05 for result, _ in results)


def test_repetitions_without_some_points_keep_the_motion() -> None:
    rng = np.random.default_rng(6)
    place = chips(rng, 80)
    observations = ControlObservations(
        FlatModel().locate(place, np.zeros(80)),
        place + 0.3 * rng.normal(size=(80, 2)),
        np.full(80, 0.3),
        np.zeros((80, 3, 3)),
        chip_side_px=SIDE_PX,
        strips=strips(oscillation(180.0, (2.0, 2.0)), place, rng),
    )
    whole = adjust_scene(FlatModel(), SHAPE, observations)
    part = replace(observations, usable=np.arange(80) % 4 > 0)
    repeated = adjust_scene(FlatModel(), SHAPE, part, like=whole)
    assert repeated.short_motion is whole.short_motion
    assert (repeated.local_sigma_px >= np.sqrt(whole.short_motion.variance_px2)).all()
