"""Parts of a chip that a scene shows displaced against the chip are found, with their precision."""

import cv2
import numpy as np
import pytest

from amers.services.conventions import CHIP_SIZE
from amers.services.matching.chip_strips import chip_strips
from amers.services.matching.correlate import CorrelationOptions, find_chip
from amers.services.matching.view_combination import combine_views, no_measure
from amers.services.misfit.short_motion import STRIPS, ChipStrips
from amers.services.types import Array, FloatImage

RADIUS = 6
SIDE = CHIP_SIZE + 2 * RADIUS
UPRIGHT = np.eye(2)
"""Lines and samples of the scene are rows and columns of the chip."""


def texture(rng: np.random.Generator) -> FloatImage:
    ground = cv2.GaussianBlur(rng.normal(0.0, 1.0, (SIDE + 40, SIDE + 40)), (0, 0), 2.0)
    return np.asarray(600.0 + 200.0 * ground / ground.std(), dtype=np.float32)


def seen(ground: FloatImage, moved: Array) -> FloatImage:
    """The patch of a scene whose rows show the ground displaced by (rows, 2)."""
    row, col = np.indices((SIDE, SIDE), dtype=np.float32)
    map_row = (row + 20.0 - moved[:, :1]).astype(np.float32)
    map_col = (col + 20.0 - moved[:, 1:]).astype(np.float32)
    return cv2.remap(ground, map_col, map_row, cv2.INTER_CUBIC)


def strips_of(
    amplitude: tuple[float, float], seed: int, derivative: Array, noise: float = 4.0
) -> tuple[ChipStrips, Array]:
    """Strips of a chip in a scene that oscillates along the rows, and how far each is off (s, 2)."""
    rng = np.random.default_rng(seed)
    ground = texture(rng)
    row = np.arange(SIDE, dtype=np.float64)
    moved = np.sin(2.0 * np.pi * row / 60.0 + rng.uniform(0.0, 6.0))[:, None] * amplitude
    patch = seen(ground, moved) + rng.normal(0.0, noise, (SIDE, SIDE)).astype(np.float32)
    chip = ground[20 + RADIUS : 20 + RADIUS + CHIP_SIZE, 20 + RADIUS : 20 + RADIUS + CHIP_SIZE]
    peak = find_chip(patch, np.ascontiguousarray(chip), CorrelationOptions())
    strips = chip_strips([combine_views([peak], 1.0)], derivative[None])
    inside = moved[RADIUS + 1 : RADIUS + CHIP_SIZE - 1]
    true = np.array([part.mean(axis=0) for part in np.array_split(inside, STRIPS)]) - peak.row_col
    return strips, true


def test_strips_are_displaced_as_the_scene_shows_them() -> None:
    for seed in range(10):
        strips, true = strips_of((0.3, 0.5), seed, UPRIGHT)
        assert np.sqrt(np.mean((strips.displacement_px[0] - true) ** 2)) < 0.1
        assert np.corrcoef(strips.displacement_px[0].ravel(), true.ravel())[0, 1] > 0.9
        assert (np.diff(strips.line[0]) > 10.0).all()


def test_the_sigmas_of_strips_are_those_of_their_noise() -> None:
    squares = []
    for seed in range(60):
        strips, true = strips_of((0.0, 0.0), seed, UPRIGHT, noise=80.0)
        squares.append(((strips.displacement_px[0] - true) / strips.sigma_px[0]) ** 2)
    assert 0.6 < np.mean(squares) < 1.6


def test_strips_lie_along_the_lines_of_the_scene_however_the_chip_is_turned() -> None:
    """A scene whose lines run along the columns of the chip, with two pixels to one of the chip."""
    turned = np.array([[0.0, 2.0], [-2.0, 0.0]])
    upright, _ = strips_of((0.3, 0.5), 1, UPRIGHT)
    across, _ = strips_of((0.3, 0.5), 1, turned)
    assert np.ptp(across.line) == pytest.approx(2.0 * np.ptp(upright.line), rel=1e-6)
    # All strips show all rows: none moves against the others.
    assert np.abs(across.displacement_px).max() < 0.3 < np.abs(upright.displacement_px).max()


def test_a_point_that_was_not_found_shows_no_strips() -> None:
    strips = chip_strips([no_measure(2, "low_score")], UPRIGHT[None])
    assert np.isnan(strips.displacement_px).all()
