"""A chip is matched to a fraction of a pixel, and its squares state what they do to the position."""

import numpy as np
import pytest

from amers.services.imagery.resampling import resample, spline_coefficients
from amers.services.matching.least_squares import Fit, covariance_from_influence, fit_chip
from amers.services.matching.least_squares_kernels import (
    CELL_PX,
    REACH_PX,
    add_bartlett_sums,
    neighbour_correlation,
)
from amers.services.types import Array, FloatImage
from tests.services.textures import as_pixels, moved, texture

SIDE, MARGIN, PERIOD = 34, 15, 64
CELLS = 8
"""Squares along the side of a chip without its outermost pixels."""
INSIDE = SIDE - 2
a_hundredth_of_a_pixel = 0.01


def chip_and_patch(shift: tuple[float, float], noise: float) -> tuple[FloatImage, FloatImage]:
    """A chip, and a patch that shows it moved from row and column `MARGIN`, under smooth noise."""
    rng = np.random.default_rng(0)
    ground = texture(rng, PERIOD, 1.5)
    heart = slice(MARGIN, MARGIN + SIDE)
    return as_pixels(ground[heart, heart]), as_pixels(
        moved(ground, *shift) + noise * texture(rng, PERIOD, 1.5)
    )


def fitted(
    patch: FloatImage,
    chip: FloatImage,
    weight: Array | None = None,
    start: tuple[float, float] = (MARGIN, MARGIN),
) -> Fit:
    of_pixels = None if weight is None else weight.astype(np.float32)
    fit = fit_chip(patch, chip, np.array(start, dtype=np.float64), of_pixels)
    assert fit is not None
    return fit


def shown_under(patch: FloatImage, at: Array) -> Array:
    """What the patch shows under the chip's pixels without the outermost, at a position."""
    row, col = np.indices((INSIDE, INSIDE)) + 1.0
    place = np.stack([row + at[0], col + at[1]], axis=-1)
    return np.asarray(resample(spline_coefficients(patch), place), dtype=np.float64)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.3), (-0.55, 0.65), (0.97, 0.02)])
def test_the_score_is_the_correlation_of_chip_and_patch_at_the_position(
    shift: tuple[float, float],
) -> None:
    chip, patch = chip_and_patch(shift, 0.4)
    fit = fitted(patch, chip)
    under = shown_under(patch, fit.row_col)
    expected = np.corrcoef(under.ravel(), chip[1:-1, 1:-1].ravel().astype(np.float64))[0, 1]
    assert 0.8 < expected < 0.97
    assert fit.score == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("weighted", [False, True])
def test_squares_left_out_move_the_position_as_their_influence_and_leverage_state(
    weighted: bool,
) -> None:
    """Without a square the others decide: a linear fit without some observations, in closed form."""
    chip, patch = chip_and_patch((0.3, -0.4), 0.1)
    weight = np.ones((INSIDE, INSIDE))
    if weighted:
        weight = np.random.default_rng(1).uniform(0.3, 1.0, weight.shape)
    whole = fitted(patch, chip, weight)
    assert whole.influence.shape == (CELLS, CELLS, 2)
    np.testing.assert_allclose(whole.influence.sum(axis=(0, 1)), 0.0, atol=2e-3)
    np.testing.assert_allclose(whole.leverage.sum(axis=(0, 1)), np.eye(2), atol=1e-4)
    stated, happened = [], []
    for i in range(0, CELLS, 2):
        for j in range(0, CELLS, 2):
            rest = weight.copy()
            rest[CELL_PX * i : CELL_PX * (i + 2), CELL_PX * j : CELL_PX * (j + 2)] = 0.0
            influence = whole.influence[i : i + 2, j : j + 2].sum(axis=(0, 1))
            leverage = whole.leverage[i : i + 2, j : j + 2].sum(axis=(0, 1))
            stated.append(-np.linalg.solve(np.eye(2) - leverage, influence))
            happened.append(fitted(patch, chip, rest).row_col - whole.row_col)
    error = np.array(happened) - np.array(stated)
    assert (np.sqrt((error**2).mean(axis=0)) < 0.1 * np.sqrt(np.square(happened).mean(axis=0))).all()


def test_rows_and_columns_of_chip_and_patch_may_be_exchanged() -> None:
    chip, patch = chip_and_patch((0.3, -0.4), 0.3)
    weight = np.random.default_rng(1).uniform(0.3, 1.0, (INSIDE, INSIDE))
    plain = fitted(patch, chip, weight)
    turned = fitted(patch.T.copy(), chip.T.copy(), weight.T.copy())
    np.testing.assert_allclose(turned.row_col, plain.row_col[::-1], atol=1e-5)
    assert turned.score == pytest.approx(plain.score, abs=1e-6)
    influence = plain.influence.swapaxes(0, 1)[..., ::-1]
    np.testing.assert_allclose(turned.influence, influence, atol=1e-5)
    leverage = plain.leverage.swapaxes(0, 1)[..., ::-1, ::-1]
    np.testing.assert_allclose(turned.leverage, leverage, atol=1e-4)


def test_pixels_without_weight_do_not_count() -> None:
    chip, patch = chip_and_patch((0.3, -0.4), 0.0)
    weight = np.ones((INSIDE, INSIDE))
    weight[:, 20:] = 0.0
    other = patch.copy()
    other[:, MARGIN + 26 :] += 20.0 * texture(np.random.default_rng(2), PERIOD, 1.5)[:, MARGIN + 26 :]
    beside, over_all = fitted(other, chip, weight), fitted(other, chip)
    expected = [MARGIN + 0.3, MARGIN - 0.4]
    np.testing.assert_allclose(beside.row_col, expected, atol=a_hundredth_of_a_pixel)
    assert np.abs(over_all.row_col - expected).max() > a_hundredth_of_a_pixel


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_position_is_the_same_from_any_start_within_reach_and_none_beyond(
    axis: int, sign: float
) -> None:
    chip, patch = chip_and_patch((0.0, 0.0), 0.1)
    expected = fitted(patch, chip).row_col
    start = np.full(2, float(MARGIN))
    start[axis] += sign * (REACH_PX - 0.1)
    found = fitted(patch, chip, start=tuple(start))
    np.testing.assert_allclose(found.row_col, expected, atol=a_hundredth_of_a_pixel)
    start[axis] += sign * 0.2
    assert fit_chip(patch, chip, start) is None


@pytest.mark.parametrize(("turns", "inside_px"), [(0, 0.25), (1, 0.25), (2, 1.25), (3, 1.25)])
def test_a_chip_is_found_at_each_border_of_a_patch_and_not_beyond(turns: int, inside_px: float) -> None:
    for row in (inside_px, -0.25):
        chip, patch = chip_and_patch((row, 0.0), 0.0)
        at_border = patch[MARGIN:, MARGIN - 5 : MARGIN + SIDE + 5]
        left = at_border.shape[0] - SIDE
        place = np.array([(row, 5.0), (5.0, row), (left - row, 5.0), (5.0, left - row)][turns])
        turned = [np.ascontiguousarray(np.rot90(one, turns)) for one in (at_border, chip)]
        fit = fit_chip(turned[0], turned[1], np.maximum(np.rint(place), 0.0))
        assert (fit is not None) == (row > 0.0)
        if fit is not None:
            np.testing.assert_allclose(fit.row_col, place, atol=0.02)


def test_the_negative_of_a_chip_and_a_patch_without_contrast_are_not_fitted() -> None:
    chip, patch = chip_and_patch((0.0, 0.0), 0.0)
    start = np.full(2, float(MARGIN))
    assert fit_chip(patch, chip, start) is not None
    assert fit_chip(-patch, chip, start) is None
    assert fit_chip(np.full_like(patch, 500.0), chip, start) is None


@pytest.mark.parametrize("reach", [1, 2, 5])
def test_the_sum_over_windows_is_that_over_pairs_of_squares_with_weights_that_fall_to_zero(
    reach: int,
) -> None:
    influence = np.random.default_rng(0).normal(size=(7, 7, 2)) * [1.0, 3.0]
    covariance = np.zeros((2, 2))
    add_bartlett_sums(influence, reach, covariance)
    place = np.indices((7, 7)).reshape(2, 49)
    apart = np.abs(place[:, :, None] - place[:, None, :])
    weight = np.maximum(0.0, 1.0 - apart / reach).prod(axis=0)
    values = influence.reshape(49, 2)
    np.testing.assert_allclose(covariance, values.T @ weight @ values, rtol=1e-10)


def squares_of_noise(seed: int, side: int, smooth: int) -> Array:
    """Influences (side, side, 2): noise summed over squares of `smooth`, with a sum of zero."""
    noise = np.random.default_rng(seed).normal(size=(side + smooth - 1, side + smooth - 1, 2))
    windows = np.lib.stride_tricks.sliding_window_view(noise, (smooth, smooth), axis=(0, 1))
    total = windows.sum(axis=(-2, -1))
    return np.ascontiguousarray(total - total.mean(axis=(0, 1)))


@pytest.mark.parametrize(("smooth", "expected"), [(1, 0.0), (2, 0.5), (3, 2.0 / 3.0)])
def test_the_correlation_of_neighbouring_squares_is_that_of_their_noise(
    smooth: int, expected: float
) -> None:
    found = []
    for seed in range(40):
        influence = squares_of_noise(seed, 12, smooth)
        used, correlation = neighbour_correlation(influence)
        assert used == 144
        found.append(correlation)
    error = np.std(found) / np.sqrt(len(found))
    # The zero sum takes a little more from noise that is smooth, for which the figure stands in.
    assert np.mean(found) == pytest.approx(expected, abs=4.0 * error + 0.03 * (smooth - 1))


def test_squares_that_are_not_used_have_no_neighbours() -> None:
    influence = squares_of_noise(0, 12, 1)
    influence[::2, ::2] = influence[1::2, 1::2] = 0.0
    assert neighbour_correlation(influence) == (72, 0.0)
    influence = np.zeros((4, 4, 2))
    influence[1, 1], influence[1, 2] = [1.0, 2.0], [-1.0, -2.0]
    used, correlation = neighbour_correlation(influence)
    assert used == 2
    assert correlation == pytest.approx(-1.0 + 1.0 / 2.0)


def test_what_each_half_of_a_chip_shares_is_not_averaged_out() -> None:
    """The two halves of a chip say the opposite, with a gap between them or without."""
    halves = np.zeros((24, 24, 2))
    halves[:, :12], halves[:, 12:] = 0.01, -0.01
    apart = halves.copy()
    apart[:, 11:13] = 0.0
    for influence in (halves, apart):
        sigma = np.sqrt(covariance_from_influence(influence)[0, 0])
        assert sigma > 10.0 * np.sqrt(np.square(influence[..., 0]).sum())


def test_influences_that_are_independent_state_the_sigma_of_their_sum() -> None:
    stated = [covariance_from_influence(squares_of_noise(seed, 24, 1)) for seed in range(40)]
    np.testing.assert_allclose(np.mean(stated, axis=0) / 24.0**2, np.eye(2), atol=0.15)


def test_a_chip_without_residuals_has_no_sigma() -> None:
    np.testing.assert_array_equal(covariance_from_influence(np.zeros((6, 6, 2))), np.zeros((2, 2)))
