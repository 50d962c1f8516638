"""Chips that a scene shows sheared against them are found so, with their precision."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from amers.services.conventions import CHIP_SIZE
from amers.services.matching.chip_shears import ChipShears, chip_shears
from amers.services.matching.correlate import CorrelationOptions, Peak, find_chip
from amers.services.types import Array

RADIUS = 6
SIDE = CHIP_SIZE + 2 * RADIUS
LEAN = np.array([0.2, -0.1])
NOISE = 60.0


def peak_of(gradient: Array, seed: int) -> Peak:
    """Of a chip in a scene whose content is displaced east and north by (2, 2) of the way there."""
    rng = np.random.default_rng(seed)
    ground = cv2.GaussianBlur(rng.normal(0.0, 1.0, (SIDE + 40, SIDE + 40)), (0, 0), 2.0)
    ground = np.asarray(600.0 + 200.0 * ground / ground.std(), dtype=np.float32)
    row, col = np.indices((SIDE, SIDE), dtype=np.float64) - (SIDE - 1) / 2.0
    east, north = np.einsum("ij,jrc->irc", gradient, np.stack([col, -row]))
    middle = 20.0 + (SIDE - 1) / 2.0
    map_col, map_row = (
        (middle + col - east).astype(np.float32),
        (middle + row + north).astype(np.float32),
    )
    patch = cv2.remap(ground, map_col, map_row, cv2.INTER_CUBIC)
    patch += rng.normal(0.0, NOISE, patch.shape).astype(np.float32)
    inside = slice(20 + RADIUS, 20 + RADIUS + CHIP_SIZE)
    return find_chip(patch, np.ascontiguousarray(ground[inside, inside]), CorrelationOptions())


@pytest.mark.parametrize("at", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_chip_is_sheared_as_the_scene_shows_it(at: tuple[int, int]) -> None:
    gradient = np.zeros((2, 2))
    gradient[at] = 0.012
    peaks = [peak_of(gradient, seed) for seed in range(8)]
    shears = chip_shears(np.arange(8), np.tile(LEAN, (8, 1)), peaks)
    assert len(shears.point) == 8
    np.testing.assert_allclose(shears.gradient.mean(axis=0), gradient, atol=0.002)


def test_the_sigmas_of_shears_are_those_of_their_noise() -> None:
    peaks = [peak_of(np.zeros((2, 2)), seed) for seed in range(60)]
    shears = chip_shears(np.arange(60), np.tile(LEAN, (60, 1)), peaks)
    normalised = (shears.gradient**2).mean(axis=(1, 2)) / shears.sigma**2
    assert 0.5 < normalised.mean() < 2.0
    assert shears.sigma.max() < 0.002


def test_views_of_unknown_direction_and_no_views_have_no_shears() -> None:
    lean = np.array([[0.2, 0.1], [np.nan, np.nan]])
    shears = chip_shears(np.arange(2), lean, [peak_of(np.zeros((2, 2)), seed) for seed in range(2)])
    np.testing.assert_array_equal(shears.point, [0])
    assert not len(chip_shears(np.zeros(0, dtype=np.int64), np.empty((0, 2)), []).point)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0])
def test_a_chip_whose_squares_tell_nothing_has_no_shears(bad: float) -> None:
    """It does not end the search of the others."""
    peak = peak_of(np.zeros((2, 2)), 0)
    leverage = np.full_like(peak.leverage, bad)
    shears = chip_shears(np.arange(2), np.tile(LEAN, (2, 1)), [replace(peak, leverage=leverage), peak])
    np.testing.assert_array_equal(shears.point, [1])


def test_points_that_are_measured_anew_have_their_new_shears() -> None:
    before = ChipShears(
        np.array([0, 0, 2, 3]), np.zeros((4, 2)), np.zeros((4, 2, 2)), np.array([1.0, 2.0, 3.0, 4.0])
    )
    anew = ChipShears(
        np.array([1, 2, 2]), np.ones((3, 2)), np.ones((3, 2, 2)), np.array([5.0, 6.0, 7.0])
    )
    both = before.replaced(np.array([1, 2]), anew)
    np.testing.assert_array_equal(both.point, [0, 0, 1, 2, 2, 3])
    np.testing.assert_array_equal(both.sigma, [1.0, 2.0, 5.0, 6.0, 7.0, 4.0])
    np.testing.assert_array_equal(both.lean[:, 0], [0, 0, 1, 1, 1, 0])
    np.testing.assert_array_equal(both.gradient[:, 0, 1], [0, 0, 1, 1, 1, 0])
