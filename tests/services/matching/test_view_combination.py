"""The sigma of a point that several views measure covers its error, for any number of views."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.matching.correlate import FOUND, Peak, rejected, sigma_per_coordinate
from amers.services.matching.least_squares import covariance_from_influence
from amers.services.matching.view_combination import (
    ViewCombination,
    combine_views,
    combined_sigmas_px,
    no_measure,
)
from amers.services.types import Array, IntArray

CELLS = 25
AGREEMENT_PX = 0.7
NOISE_PX = 0.05
NINETY_PERCENT = 2.0 * np.log(10.0)
"""Square of the radius of the 90 % region of the plane, in units of sigma."""


def noise(rng: np.random.Generator, sigma_px: float) -> Array:
    """Shifts (c, c, 2) of a position by the noise in the squares of a chip."""
    return sigma_px / CELLS * rng.standard_normal((CELLS, CELLS, 2))


def peaks_of_a_point(rng: np.random.Generator, views: int, tau_px: float) -> list[Peak]:
    """Views of a place at zero: noise of the scene, noise of each chip, an error of each view."""
    scene = noise(rng, NOISE_PX)
    peaks = []
    for _ in range(views):
        shifts = scene + noise(rng, NOISE_PX * rng.uniform(0.5, 1.5))
        residuals = shifts - shifts.mean(axis=(0, 1))
        row_col = shifts.sum(axis=(0, 1)) + tau_px * rng.standard_normal(2)
        sigma_px = sigma_per_coordinate(covariance_from_influence(residuals))
        leverage = np.broadcast_to(np.eye(2) / CELLS**2, (CELLS, CELLS, 2, 2)).astype(np.float32)
        peaks.append(Peak(row_col, 0.9, sigma_px, residuals, leverage, FOUND))
    return peaks


def combinations(views: IntArray, tau_px: float, seed: int) -> list[ViewCombination]:
    rng = np.random.default_rng(seed)
    return [combine_views(peaks_of_a_point(rng, int(k), tau_px), AGREEMENT_PX) for k in views]


def normalised_squares(points: list[ViewCombination]) -> Array:
    """Square of the distance from the truth in units of sigma (n,): 2 on average for honest sigmas."""
    error_px = np.array([point.row_col for point in points])
    return np.asarray((error_px**2).sum(axis=1) / combined_sigmas_px(points) ** 2)


@pytest.mark.parametrize("tau_px", [0.0, 0.05, 0.15])
@pytest.mark.parametrize("views", [1, 2, 3, 4, 6])
@pytest.mark.long
def test_ninety_percent_of_the_points_lie_in_their_region(views: int, tau_px: float) -> None:
    # Points of other numbers of views belong to the same search, as they do in a scene.
    counts = np.concatenate([np.full(400, views), np.tile([2, 3, 4], 60)])
    squares = normalised_squares(combinations(counts, tau_px, 1))[:400]
    assert 0.7 < squares.mean() / 2.0 < 1.5
    assert 0.85 < (squares < NINETY_PERCENT).mean() < 0.95


def test_the_sigma_of_a_single_view_grows_with_the_scatter_of_other_points() -> None:
    single = combinations(np.array([1]), 0.0, 2)
    calm, restless = (combinations(np.full(50, 3), tau_px, 3) for tau_px in (0.0, 0.2))
    alone_px, with_calm_px, with_restless_px = (
        float(combined_sigmas_px(single + others)[0]) for others in ([], calm, restless)
    )
    assert with_calm_px == pytest.approx(alone_px, rel=0.1)
    assert with_restless_px == pytest.approx(np.hypot(alone_px, 0.2), rel=0.15)


@pytest.mark.parametrize("share", [0.5, 0.9, 0.99])
def test_the_scatter_of_views_is_found_whatever_their_weights_are(share: float) -> None:
    """Two views of errors of their own alone: what is stated is the root mean square of their mean."""
    rng = np.random.default_rng(6)
    weight, tau_px = np.array([share, 1.0 - share]), 0.2
    views = tau_px * rng.standard_normal((4000, 2, 2))
    means = np.einsum("v,nvc->nc", weight, views)
    squares = ((views - means[:, None]) ** 2).sum(axis=(1, 2))
    lost = no_measure(2, "flat")
    points = [replace(lost, sigma_px=0.0, excess_px2=float(s), weight=weight) for s in squares]
    stated_px = combined_sigmas_px(points)
    assert stated_px[0] == pytest.approx(np.sqrt((means**2).mean()), rel=0.05)


def test_no_order_of_views_and_no_choice_of_axes_changes_a_measure() -> None:
    peaks = peaks_of_a_point(np.random.default_rng(7), 4, 0.1)
    swapped = [
        replace(
            peak,
            row_col=peak.row_col[::-1],
            influence=np.ascontiguousarray(peak.influence.transpose(1, 0, 2)[..., ::-1]),
            leverage=np.ascontiguousarray(peak.leverage.transpose(1, 0, 2, 3)[..., ::-1, ::-1]),
        )
        for peak in peaks
    ]
    plain, permuted, turned = (combine_views(p, 1.0) for p in (peaks, peaks[::-1], swapped))
    np.testing.assert_allclose(permuted.row_col, plain.row_col)
    np.testing.assert_allclose(permuted.weight[::-1], plain.weight)
    np.testing.assert_allclose(turned.row_col[::-1], plain.row_col)
    for other in (permuted, turned):
        assert other.sigma_px == pytest.approx(plain.sigma_px, rel=1e-6)
        assert other.excess_px2 == pytest.approx(plain.excess_px2, rel=1e-6)


def test_a_point_without_a_measure_has_no_sigma_and_does_not_count() -> None:
    points = combinations(np.full(5, 3), 0.1, 4)
    lost = combine_views([rejected("low_score", 0.3), rejected("flat")], AGREEMENT_PX)
    turned = combine_views([rejected("flat"), rejected("low_score", 0.3)], AGREEMENT_PX)
    assert lost.reason == turned.reason == "low_score"
    assert not lost.agreeing.any()
    sigma_px = combined_sigmas_px([*points, lost])
    assert np.isnan(sigma_px[-1])
    np.testing.assert_array_equal(sigma_px[:-1], combined_sigmas_px(points))


def test_a_measure_is_the_least_squares_solution_of_its_views() -> None:
    """One equation a view, divided by its sigma; the first is ten times as precise as the second."""
    peaks = peaks_of_a_point(np.random.default_rng(8), 3, 0.1)
    sigmas_px = np.array([0.02, 0.2, 0.1])
    peaks = [replace(peak, sigma_px=float(s)) for peak, s in zip(peaks, sigmas_px, strict=True)]
    shown = np.array([peak.row_col for peak in peaks])
    expected, *_ = np.linalg.lstsq(1.0 / sigmas_px[:, None], shown / sigmas_px[:, None], rcond=None)
    combined = combine_views(peaks, 1.0)
    np.testing.assert_allclose(combined.row_col, expected[0])
    assert combined.weight[0] == pytest.approx(100.0 * combined.weight[1])


@pytest.mark.parametrize("views", [1, 2, 3, 4, 5])
def test_more_than_half_of_the_views_agree_or_there_is_no_measure(views: int) -> None:
    peaks = peaks_of_a_point(np.random.default_rng(9), views, 0.0)
    for agreeing in range(1, views + 1):
        turned = 2.0 * np.pi * np.arange(views) / views
        away = 5.0 * np.column_stack([np.cos(turned), np.sin(turned)])
        away[:agreeing] = 0.0
        shown = [replace(p, row_col=p.row_col + by) for p, by in zip(peaks, away, strict=True)]
        combined = combine_views(shown, AGREEMENT_PX)
        if 2 * agreeing > views:
            assert combined.agreeing.tolist() == [True] * agreeing + [False] * (views - agreeing)
            assert combined.weight.sum() == pytest.approx(1.0)
        else:
            assert combined.reason == "views_disagree"
