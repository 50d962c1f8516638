"""A chip is found to a fraction of a pixel with an honest sigma, or rejected with a reason."""

import numpy as np
import pytest

from amers.services.matching.correlate import (
    FOUND,
    CorrelationOptions,
    Peak,
    _largest_sigma_px,
    find_chip,
)
from amers.services.types import Array, FloatImage
from tests.services.matching.chip_trials import (
    CHIPS,
    PERIOD,
    SIDE,
    Trials,
    chip_of,
    patch_of,
    searched,
)
from tests.services.textures import as_pixels, moved, texture

a_twentieth_of_a_pixel = 0.05
a_millipixel = 1e-3

OPTIONS = CorrelationOptions()


def trials(
    smoothness_px: float,
    noise: float,
    noise_smoothness_px: float | None,
    seed: int,
    side: int = SIDE,
) -> Trials:
    """Search 100 chips; noise without smoothness is white."""
    rng = np.random.default_rng(seed)

    def pair() -> tuple[FloatImage, FloatImage, Array]:
        ground, shift = texture(rng, PERIOD, smoothness_px), rng.uniform(-3.0, 3.0, 2)
        white = noise_smoothness_px is None
        other = rng.standard_normal(ground.shape) if white else texture(rng, PERIOD, noise_smoothness_px)
        return patch_of(moved(ground, *shift) + noise * other, side), chip_of(ground, side), shift

    return searched(pair() for _ in range(CHIPS))


def found_at(peak: Peak, row: float, col: float, tolerance_px: float = a_twentieth_of_a_pixel) -> bool:
    return peak.reason == FOUND and bool(np.abs(peak.row_col - [row, col]).max() < tolerance_px)


@pytest.mark.parametrize(
    ("smoothness_px", "noise"), [(1.0, 0.0), (1.5, 0.0), (2.5, 0.0), (1.5, 0.3), (2.5, 0.3)]
)
def test_a_shift_is_recovered_to_a_twentieth_of_a_pixel_also_in_white_noise(
    smoothness_px: float, noise: float
) -> None:
    outcome = trials(smoothness_px, noise, None, 1)
    assert outcome.lost == 0
    assert np.abs(outcome.error_px).max() < a_twentieth_of_a_pixel


@pytest.mark.parametrize("noise", [0.2, 0.45])
@pytest.mark.parametrize("smoothness_px", [1.0, 1.5, 2.5])
@pytest.mark.long
def test_measures_have_no_bias(smoothness_px: float, noise: float) -> None:
    for noise_smoothness in (None, smoothness_px):
        outcome = trials(smoothness_px, noise, noise_smoothness, 3)
        standard_error = outcome.error_px.std(axis=0) / np.sqrt(len(outcome.error_px))
        assert np.abs(outcome.error_px.mean(axis=0) / standard_error).max() < 4.0


@pytest.mark.parametrize("noise", [0.2, 0.45])
@pytest.mark.parametrize("noise_smoothness_px", [None, 1.0, 2.5])
@pytest.mark.parametrize("smoothness_px", [1.0, 2.5])
@pytest.mark.long
def test_the_stated_sigma_is_honest_for_any_smoothness_of_the_noise(
    smoothness_px: float, noise_smoothness_px: float | None, noise: float
) -> None:
    outcome = trials(smoothness_px, noise, noise_smoothness_px, 4)
    assert outcome.lost == 0
    assert 0.7 < outcome.normalised_square < 1.5


@pytest.mark.parametrize(("side", "smoothness_px"), [(41, 1.0), (41, 2.5), (41, 4.0), (SIDE, 4.0)])
@pytest.mark.long
def test_the_stated_sigma_is_honest_where_noise_is_smooth_over_several_squares(
    side: int, smoothness_px: float
) -> None:
    for noise_smoothness_px in (None, smoothness_px):
        outcome = trials(smoothness_px, 0.3, noise_smoothness_px, 8, side)
        assert outcome.lost <= 2
        assert 0.7 < outcome.normalised_square < 1.5


@pytest.mark.parametrize("smoothness_px", [1.0, 2.5])
def test_the_stated_sigma_is_not_too_small_under_haze(smoothness_px: float) -> None:
    # Slow differences move a position less than squares of 20 pixels can show.
    assert 0.4 < trials(smoothness_px, 0.45, 5.0, 4).normalised_square < 1.5


@pytest.mark.long
def test_the_stated_sigma_grows_with_the_noise_and_with_the_smoothness() -> None:
    def sigma(smoothness_px: float, noise: float) -> float:
        return float(np.median(trials(smoothness_px, noise, smoothness_px, 6).sigma_px))

    assert sigma(1.5, 0.2) < sigma(1.5, 0.45) < sigma(3.0, 0.45)


def test_brightness_and_contrast_do_not_move_a_chip() -> None:
    ground = texture(np.random.default_rng(0), PERIOD, 1.5)
    patch, chip = patch_of(moved(ground, 1.3, -2.4)), chip_of(ground)
    plain, changed = find_chip(patch, chip, OPTIONS), find_chip(3.0 * patch + 700.0, chip, OPTIONS)
    assert found_at(plain, 1.3, -2.4)
    np.testing.assert_allclose(changed.row_col, plain.row_col, atol=a_millipixel)
    assert changed.score == pytest.approx(plain.score, abs=1e-4)


def test_a_chip_without_contrast_is_flat() -> None:
    rng = np.random.default_rng(0)
    patch = patch_of(texture(rng, PERIOD, 1.5))
    for contrast in (0.0, 0.009):
        grey = 500.0 * (1.0 + contrast * texture(rng, PERIOD, 1.5)[:SIDE, :SIDE])
        assert find_chip(patch, grey.astype(np.float32), OPTIONS).reason == "flat"


def test_other_ground_has_a_low_score() -> None:
    rng = np.random.default_rng(0)
    peak = find_chip(patch_of(texture(rng, PERIOD, 1.5)), chip_of(texture(rng, PERIOD, 1.5)), OPTIONS)
    assert peak.reason == "low_score"
    assert 0.0 < peak.score < 0.5
    assert np.isnan(peak.sigma_px)
    assert np.isnan(peak.row_col).all()


@pytest.mark.parametrize("shift", [(7.0, 0.0), (0.0, -7.5), (-7.0, 7.0)])
def test_a_chip_beyond_the_search_radius_has_a_border_peak(shift: tuple[float, float]) -> None:
    ground = texture(np.random.default_rng(0), PERIOD, 5.0)
    assert find_chip(patch_of(moved(ground, *shift)), chip_of(ground), OPTIONS).reason == "border_peak"


def test_a_repeated_pattern_is_ambiguous() -> None:
    rng = np.random.default_rng(0)
    side = SIDE + 40
    repeated = np.tile(texture(rng, 16, 1.5), (10, 10))[:side, :side] + 0.1 * rng.standard_normal(
        (side, side)
    )
    chip = as_pixels(repeated[20 : 20 + SIDE, 20 : 20 + SIDE])
    assert find_chip(as_pixels(repeated), chip, OPTIONS).reason == "ambiguous"


def test_a_straight_edge_is_ambiguous() -> None:
    rng = np.random.default_rng(0)
    side = SIDE + 40
    edge = np.broadcast_to(np.tanh((np.arange(side) - 70.0) / 2.0), (side, side))
    seen, cut = (edge + 0.02 * rng.standard_normal((side, side)) for _ in range(2))
    chip = as_pixels(cut[20 : 20 + SIDE, 20 : 20 + SIDE])
    assert find_chip(as_pixels(seen), chip, OPTIONS).reason == "ambiguous"


def test_nodata_away_from_a_chip_does_not_move_it() -> None:
    ground = texture(np.random.default_rng(0), PERIOD, 1.5)
    patch = patch_of(moved(ground, -2.3, -1.6))
    whole = find_chip(patch, chip_of(ground), OPTIONS)
    patch[:, 110:] = np.nan
    beside = find_chip(patch, chip_of(ground), OPTIONS)
    assert beside.reason == FOUND
    np.testing.assert_allclose(beside.row_col, whole.row_col, atol=a_millipixel)


def test_the_largest_sigma_is_that_along_the_worst_direction() -> None:
    """Of covariances with correlation: the root of their larger eigenvalue."""
    for factor in np.random.default_rng(3).normal(size=(20, 2, 2)):
        covariance = factor @ factor.T
        expected = np.sqrt(np.linalg.eigvalsh(covariance)[-1])
        assert _largest_sigma_px(covariance) == pytest.approx(expected)
