"""Missing and saturated pixels are left out of a match, and the sigma grows with what they hide."""

from itertools import product
from typing import Literal

import numpy as np
import pytest

from amers.services.imagery.gaps import missing_reason
from amers.services.matching.correlate import (
    FOUND,
    CorrelationOptions,
    correlation_map,
    find_chip,
)
from amers.services.types import Array, BoolArray, FloatImage
from tests.services.matching.chip_trials import (
    CHIPS,
    PERIOD,
    RADIUS_PX,
    SIDE,
    Trials,
    chip_of,
    patch_of,
    searched,
)
from tests.services.textures import as_pixels, moved, texture

OPTIONS = CorrelationOptions()

a_millipixel = 1e-3
a_hundred_thousandth = 1e-5
a_twentieth_of_a_pixel = 0.05
four_standard_errors = 4.0

Kind = Literal["scattered", "patches"]
Where = Literal["patch", "chip", "both"]


def missing(rng: np.random.Generator, side: int, kind: Kind, share: float) -> BoolArray:
    if kind == "scattered":
        return rng.random((side, side)) < share
    gaps = np.zeros((side, side), dtype=bool)
    while gaps.mean() < share:
        row, column = rng.integers(0, side, 2)
        lines, samples = rng.integers(3, 16, 2)
        gaps[row : row + lines, column : column + samples] = True
    return gaps


def trials(kind: Kind, where: Where, share: float, smoothness_px: float, white: bool) -> Trials:
    """Search 100 chips under noise that is white or as smooth as the ground."""
    rng = np.random.default_rng(5)

    def pair() -> tuple[FloatImage, FloatImage, Array]:
        ground, shift = texture(rng, PERIOD, smoothness_px), rng.uniform(-3.0, 3.0, 2)
        noise = rng.standard_normal(ground.shape) if white else texture(rng, PERIOD, smoothness_px)
        chip, patch = chip_of(ground), patch_of(moved(ground, *shift) + 0.3 * noise)
        if where != "patch":
            chip[missing(rng, len(chip), kind, share)] = np.nan
        if where != "chip":
            patch[missing(rng, len(patch), kind, share)] = np.inf
        return patch, chip, shift

    return searched(pair() for _ in range(CHIPS))


def half_for_endurance() -> list[object]:
    """All 16 cases; in the half that `make test` runs, any three of the factors meet in all ways."""
    cases = product(("scattered", "patches"), ("patch", "chip"), (1.0, 2.5), (True, False))
    return [
        pytest.param(*case, marks=pytest.mark.endurance if sum(index) % 2 else ())
        for case, index in zip(cases, product((0, 1), repeat=4), strict=True)
    ]


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "where", "smoothness_px", "white"), half_for_endurance())
def test_the_stated_sigma_is_honest_whatever_is_missing(
    kind: Kind, where: Where, smoothness_px: float, white: bool
) -> None:
    for share in (0.1, 0.4):
        outcome = trials(kind, where, share, smoothness_px, white)
        assert outcome.lost == 0
        assert 0.7 < outcome.normalised_square < 1.5
        standard_error = outcome.error_px.std(axis=0) / np.sqrt(CHIPS)
        assert np.abs(outcome.error_px.mean(axis=0) / standard_error).max() < four_standard_errors


@pytest.mark.parametrize("kind", ["scattered", "patches"])
@pytest.mark.long
def test_the_stated_sigma_is_honest_with_gaps_on_both_sides(kind: Kind) -> None:
    outcome = trials(kind, "both", 0.15, 1.5, white=True)
    assert outcome.lost == 0
    assert 0.7 < outcome.normalised_square < 1.5


@pytest.mark.parametrize("where", ["patch", "chip", "both"])
@pytest.mark.parametrize("kind", ["scattered", "patches"])
@pytest.mark.long
def test_less_than_one_percent_missing_costs_nothing(kind: Kind, where: Where) -> None:
    whole, damaged = (trials(kind, where, share, 1.5, white=True) for share in (0.0, 0.009))
    assert damaged.lost == 0
    assert damaged.rms_px < 1.1 * whole.rms_px
    np.testing.assert_allclose(np.median(damaged.sigma_px), np.median(whole.sigma_px), rtol=0.05)


@pytest.mark.thorough
def test_the_stated_sigma_grows_with_what_is_missing() -> None:
    sigma = [
        float(np.median(trials("patches", "patch", share, 1.5, white=True).sigma_px))
        for share in (0.0, 0.2, 0.4)
    ]
    assert sigma[0] < sigma[1] < sigma[2]


def test_a_chip_is_found_to_the_same_place_whether_pixels_are_missing_or_saturated() -> None:
    rng = np.random.default_rng(0)
    ground = texture(rng, PERIOD, 1.5)
    chip, patch = chip_of(ground), patch_of(moved(ground, 1.3, -2.4))
    gaps = missing(rng, len(patch), "patches", 0.2)
    peaks = [find_chip(np.where(gaps, value, patch), chip, OPTIONS) for value in (np.nan, np.inf)]
    for peak in peaks:
        assert peak.reason == FOUND
        np.testing.assert_allclose(peak.row_col, [1.3, -2.4], atol=a_twentieth_of_a_pixel)
    assert (peaks[0].row_col == peaks[1].row_col).all()


@pytest.mark.parametrize(("value", "reason"), [(np.nan, "nodata"), (np.inf, "saturated")])
def test_a_chip_of_which_more_than_the_largest_share_is_missing_is_rejected(
    value: float, reason: str
) -> None:
    ground = texture(np.random.default_rng(0), PERIOD, 1.5)
    chip, patch = chip_of(ground), patch_of(ground)
    few, many = chip.copy(), chip.copy()
    few[:, :50], many[:, :51] = value, value
    assert find_chip(patch, few, OPTIONS).reason == FOUND
    assert find_chip(patch, many, OPTIONS).reason == reason
    for gap in (np.s_[:, :], np.s_[:, :70], np.s_[20:90, :]):
        damaged = patch.copy()
        damaged[gap] = value
        assert find_chip(damaged, chip, OPTIONS).reason == reason


def test_the_reason_is_the_one_of_most_invalid_pixels() -> None:
    pixels = np.array([[np.nan, np.nan, np.inf, 1.0]], dtype=np.float32)
    assert missing_reason(pixels) == "nodata"
    pixels[0, 0] = np.inf
    assert missing_reason(pixels) == "saturated"


def test_positions_where_too_much_is_missing_cannot_win() -> None:
    rng = np.random.default_rng(0)
    ground = texture(rng, PERIOD, 1.5)
    chip, patch = chip_of(ground), patch_of(np.roll(ground, (0, 5), (0, 1)))
    patch[:, 60:] = np.nan  # the true position, 11 columns from the left, shows 49 of 101 columns
    scores = correlation_map(patch, chip)
    assert scores is not None
    shown = 60 - np.arange(2 * RADIUS_PX + 1)
    assert ((scores == -1.0).all(axis=0) == (shown < SIDE / 2)).all()
    assert find_chip(patch, chip, OPTIONS).reason == "low_score"


def test_only_what_chips_reach_beyond_the_border_of_a_scene_is_searched_and_nothing_is_lost() -> None:
    rng = np.random.default_rng(2)
    chip = as_pixels(texture(rng, PERIOD, 1.5)[:20, :20])
    patch = as_pixels(texture(rng, PERIOD, 1.5)[:90, :80])
    patch[:30], patch[:, 50:] = np.nan, np.nan
    scores = correlation_map(patch, chip)
    assert scores is not None
    assert scores.shape == (71, 61)
    for row, column in np.ndindex(scores.shape):
        window = patch[row : row + 20, column : column + 20]
        valid = np.isfinite(window)
        expected = -1.0
        if 2 * valid.sum() >= valid.size:
            expected = np.corrcoef(window[valid], chip[valid])[0, 1]
        assert scores[row, column] == pytest.approx(expected, abs=a_hundred_thousandth)


def test_a_peak_beside_a_blocked_position_is_rejected() -> None:
    ground = texture(np.random.default_rng(3), PERIOD, 1.5)
    chip, patch = chip_of(ground), patch_of(np.roll(ground, (2, 3), (0, 1)))
    patch[:, 61:] = np.nan  # at the true position 52 columns are seen, a column to the right 51
    assert find_chip(patch, chip, OPTIONS).reason == FOUND
    patch[:, 60:] = np.nan
    assert find_chip(patch, chip, OPTIONS).reason == "border_peak"


def test_masked_scores_are_those_of_the_valid_pixels() -> None:
    rng = np.random.default_rng(0)
    ground = 41_500.0 + 30.0 * texture(rng, PERIOD, 1.5)
    chip, patch = ground[6:47, 6:47].astype(np.float32), ground[:53, :53].astype(np.float32)
    patch += rng.normal(0.0, 10.0, patch.shape).astype(np.float32)
    chip[missing(rng, len(chip), "patches", 0.1)] = np.nan
    patch[missing(rng, len(patch), "scattered", 0.1)] = np.nan
    scores = correlation_map(patch, chip)
    assert scores is not None
    for row, column in np.ndindex(scores.shape):
        under = patch[row : row + 41, column : column + 41].astype(np.float64)
        both = np.isfinite(under) & np.isfinite(chip)
        expected = np.corrcoef(under[both], chip[both].astype(np.float64))[0, 1]
        assert scores[row, column] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("level", [0.0, 1_500.0, 41_500.0])
def test_flat_ground_under_a_chip_has_no_score(level: float) -> None:
    rng = np.random.default_rng(0)
    chip, patch = chip_of(texture(rng, PERIOD, 1.5)), patch_of(np.zeros((PERIOD, PERIOD)))
    patch[:] = level
    patch[:, -3:] += rng.normal(0.0, 100.0, patch[:, -3:].shape).astype(np.float32)
    patch[40:60, 40:60] = np.nan
    scores = correlation_map(patch, chip)
    assert scores is not None
    assert np.isfinite(scores).all()
    assert (scores[:, :10] == 0.0).all()


def test_saturated_impulses_do_not_move_a_chip() -> None:
    rng = np.random.default_rng(0)
    ground = texture(rng, PERIOD, 1.5)
    chip, patch = chip_of(ground), patch_of(moved(ground, -2.3, -1.6) + 0.2 * texture(rng, PERIOD, 1.0))
    whole = find_chip(patch, chip, OPTIONS)
    patch[rng.random(patch.shape) < 300e-6] = np.inf
    damaged = find_chip(patch, chip, OPTIONS)
    assert damaged.reason == FOUND
    np.testing.assert_allclose(damaged.row_col, whole.row_col, atol=a_millipixel)
    assert damaged.sigma_px == pytest.approx(whole.sigma_px, rel=0.01)
