"""Points on a part of an image leave open how the rest of it is bent, and the accuracy says so."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from amers.services.misfit.bends import bends
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.misfit.structure import Residuals
from amers.services.quality.normal_law import normal_ce90
from amers.services.types import Array
from tests.services.conftest import FlatModel
from tests.services.misfit.test_displacement_components import (
    SHAPE,
    WRONG,
    both,
    bow,
    draw,
    still,
    trial,
)

ON_SAMPLES = 1.0, 0.6
"""Points on three fifths of the samples."""
BENT = {
    "smile of 1.5 px": (bow(1.5, axis=1), ON_SAMPLES),
    "smile of 2.5 px": (bow(2.5, axis=1), ON_SAMPLES),
    "smile of 4 px": (bow(4.0, axis=1), ON_SAMPLES),
    "bow of 2 px": (bow(2.0), (0.6, 1.0)),
    "distortion of 2 px": (bow(2.0, axis=1, degree=3), ON_SAMPLES),
    "both of 1.5 px": (both(bow(1.5), bow(1.5, axis=1)), (0.7, 0.7)),
}


def corners_px(adjustment: SceneAdjustment) -> Array:
    """CE90 (2, 2) at the corners of the image, by line and sample."""
    last = np.array(SHAPE) - 1.0
    corners = np.array([[line, sample] for line in (0.0, last[0]) for sample in (0.0, last[1])])
    return normal_ce90(adjustment.covariance_at(corners)).reshape(2, 2)


@pytest.mark.monte_carlo
@pytest.mark.parametrize("name", list(BENT))
def test_bends_beyond_the_points_are_within_what_is_stated(name: str) -> None:
    motion, reach = BENT[name]
    trials = [trial(motion, seed, count=40, reach=reach) for seed in range(12)]
    assert sum(one.ratio > WRONG for one in trials) <= 2
    assert 0.6 < np.mean([one.normalised for one in trials]) < 1.8


@pytest.mark.monte_carlo
def test_a_bend_that_is_half_seen_makes_the_image_less_accurate_where_no_points_reach() -> None:
    trials = [trial(bow(2.5, axis=1), seed, count=40, reach=ON_SAMPLES) for seed in range(12)]
    before, beyond = np.mean([corners_px(one.adjustment) for one in trials], axis=(0, 1))
    assert beyond > 2.5 * before


@pytest.mark.monte_carlo
def test_straight_images_with_points_on_a_part_stay_usable() -> None:
    trials = [trial(still, seed, count=40, reach=ON_SAMPLES) for seed in range(24)]
    assert 0.5 < np.mean([one.normalised for one in trials]) < 1.0
    usable_px = 3.0
    assert sum(corners_px(one.adjustment).max() < usable_px for one in trials) >= 20


@pytest.mark.monte_carlo
def test_points_all_over_a_straight_image_leave_its_correction_as_good_as_an_affine_one() -> None:
    trials = [trial(still, seed, count=100) for seed in range(24)]
    bent = [one for one in trials if one.adjustment.left_open]
    assert len(bent) < 12
    assert 0.7 < np.mean([one.normalised for one in trials]) < 1.2
    for one in bent:
        grid = one.adjustment.correction.displacement
        assert grid is not None
        assert np.abs(grid.displacement_px).max() < 0.5


def test_bends_are_left_open_in_pixels_whatever_the_sigmas_state() -> None:
    observations, _ = draw(still, np.random.default_rng(2), count=40, reach=ON_SAMPLES)
    too_small = replace(observations, sigma_px=observations.sigma_px / 4.0)
    honest, understated = (adjust_scene(FlatModel(), SHAPE, one) for one in (observations, too_small))
    assert honest.left_open
    assert understated.left_open
    assert corners_px(understated)[:, 1] == pytest.approx(corners_px(honest)[:, 1], rel=0.2)


def test_a_repetition_leaves_open_the_bends_that_the_whole_does() -> None:
    observations, _ = draw(still, np.random.default_rng(2), count=40, reach=ON_SAMPLES)
    whole = adjust_scene(FlatModel(), SHAPE, observations)
    part = replace(observations, usable=np.arange(40) % 5 > 0)
    repeated = adjust_scene(FlatModel(), SHAPE, part, like=whole)
    assert whole.left_open
    assert (corners_px(repeated)[:, 1] > 0.9 * corners_px(whole)[:, 1]).all()


def test_no_bend_is_left_open_where_the_user_gives_an_order() -> None:
    observations, _ = draw(still, np.random.default_rng(2), count=40, reach=ON_SAMPLES)
    given = adjust_scene(FlatModel(), SHAPE, observations, AdjustmentOptions(order="affine"))
    assert given.left_open == ()
    assert given.correction.displacement is None


def residuals(place: Array, misfit: Array, sigma_px: float) -> Residuals:
    """Residuals of points (n, 2) beside an affine correction, independent of each other."""
    n = len(place)
    t = (place - (np.array(SHAPE) - 1.0) / 2.0) / (np.array(SHAPE) / 2.0)
    covariance = np.tile(sigma_px**2 * np.eye(n), (2, 1, 1))
    design = np.column_stack([np.ones(n), t])
    return Residuals(place, np.zeros(n), np.zeros(2), misfit, covariance, design, 64.0)


def parabola(place: Array, size_px: float) -> Array:
    """A displacement (n, 2) of the samples by a Legendre polynomial of second degree."""
    unit = 2.0 * place[:, 1] / (SHAPE[1] - 1.0) - 1.0
    return size_px * np.column_stack([np.zeros(len(place)), 1.5 * unit**2 - 0.5])


def variance_px2(size_px: float, sigma_px: float, reach: float) -> float:
    """Variance left to a bend of the samples along the samples, by points (n, 2) without noise."""
    place = np.random.default_rng(2).random((60, 2)) * [1.0, reach] * (np.array(SHAPE) - 1.0)
    expected = np.array([[0.0, 1.0, 1.0]] * 2)
    found = bends(residuals(place, parabola(place, size_px), sigma_px), expected, SHAPE)
    return next(
        float(one.variance_px2[1]) for one in found if one.along == "samples" and one.kind == "quadratic"
    )


def test_points_that_tell_nothing_of_a_bend_leave_what_is_expected() -> None:
    """As likely straight as bent by a coefficient of 1 px: a mean square of 0.5 px^2."""
    assert variance_px2(0.0, 1.0, 0.01) == pytest.approx(0.5, rel=0.05)


def test_a_bend_that_points_show_clearly_is_left_its_size() -> None:
    assert variance_px2(3.0, 0.05, 0.7) == pytest.approx(9.0, rel=0.1)


@pytest.mark.parametrize(
    ("reach", "sigma_px", "left_open"),
    [(0.1, 0.3, True), (0.1, 3.0, False), (0.4, 0.5, True), (0.4, 10.0, False)],
)
def test_bends_matter_beside_what_an_affine_correction_leaves_uncertain(
    reach: float, sigma_px: float, left_open: bool
) -> None:
    """A bend of a pixel at the points is nothing where the shift and the skew are uncertain by more."""
    place = np.random.default_rng(2).random((60, 2)) * [1.0, reach] * (np.array(SHAPE) - 1.0)
    shown = residuals(place, np.zeros((60, 2)), sigma_px)
    assert bool(bends(shown, np.zeros((2, 3)), SHAPE)) is left_open


def test_bends_of_samples_are_those_of_lines_when_the_axes_are_swapped() -> None:
    rng = np.random.default_rng(5)
    place = rng.random((40, 2)) * [1.0, 0.5] * (np.array(SHAPE) - 1.0)
    misfit = parabola(place, 2.0) + rng.normal(0.0, 0.3, (40, 2))
    as_it_is = bends(residuals(place, misfit, 0.3), np.zeros((2, 3)), SHAPE)
    told = residuals(place, misfit, 0.3)
    design = told.design[:, [0, 2, 1]]
    turned = Residuals(
        place[:, ::-1], told.height_m, told.height_pull, misfit[:, ::-1], told.covariance, design, 64.0
    )
    swapped = bends(turned, np.zeros((2, 3)), SHAPE[::-1])
    other = {"lines": "samples", "samples": "lines"}
    assert len(as_it_is) == len(swapped) > 0
    for one in as_it_is:
        (same,) = [s for s in swapped if s.kind == one.kind and s.along == other[one.along]]
        assert same.variance_px2 == pytest.approx(one.variance_px2[::-1], rel=1e-6)


def test_bends_do_not_change_when_all_sigmas_and_displacements_do_so_together() -> None:
    """Only the size that is expected is in pixels; larger bends have the variance that they show."""
    assert variance_px2(60.0, 1.0, 0.7) == pytest.approx(100.0 * variance_px2(6.0, 0.1, 0.7), rel=0.05)


def test_bends_are_the_same_however_far_the_model_is_off() -> None:
    rng = np.random.default_rng(6)
    place = rng.random((40, 2)) * [1.0, 0.6] * (np.array(SHAPE) - 1.0)
    misfit, off = parabola(place, 2.0) + rng.normal(0.0, 0.3, (40, 2)), np.array([1900.0, -1500.0])
    found, of_far = (
        bends(residuals(at, moved, 0.3), np.zeros((2, 3)), SHAPE)
        for at, moved in ((place, misfit), (place - off, misfit + off))
    )
    assert len(found) == len(of_far) > 0
    for one, other in zip(found, of_far, strict=True):
        assert other.variance_px2 == pytest.approx(one.variance_px2, rel=1e-6)


@pytest.mark.parametrize(("size_px", "sigma_px"), [(0.0, 0.3), (1.0, 0.3), (4.0, 0.8)])
def test_what_is_left_of_a_bend_is_its_mean_square_bent_or_not(size_px: float, sigma_px: float) -> None:
    """A bend is as likely absent as normal of 1 px, or of what exceeds three sigmas of its estimate."""
    rng = np.random.default_rng([31, round(size_px)])
    place = rng.random((30, 2)) * [1.0, 0.6] * (np.array(SHAPE) - 1.0)
    unit = 2.0 * place[:, 1] / (SHAPE[1] - 1.0) - 1.0
    bend = 1.5 * unit**2 - 0.5
    misfit = sigma_px * rng.normal(size=(30, 2)) + size_px * bend[:, None]
    # The image lies where its points are seen.
    misfit -= np.median(misfit, axis=0)
    shown = residuals(place, misfit, sigma_px)
    left_open = bends(shown, np.full((2, 3), 1e-9), SHAPE)
    quadratic = next(one for one in left_open if (one.kind, one.along) == ("quadratic", "samples"))
    both_columns = np.column_stack([shown.design, bend])
    variance = sigma_px**2 * np.linalg.inv(both_columns.T @ both_columns)[3, 3]
    for k in range(2):
        estimate = np.linalg.lstsq(both_columns, misfit[:, k], rcond=None)[0][3]
        expected = max(1.0, estimate**2 - 9.0 * variance)
        coefficient = np.linspace(-30.0, 30.0, 60_001)
        bent = 0.5 * norm.pdf(coefficient, 0.0, np.sqrt(expected))
        likelihood = norm.pdf(estimate, coefficient, np.sqrt(variance))
        straight = 0.5 * norm.pdf(estimate, 0.0, np.sqrt(variance))
        step = coefficient[1] - coefficient[0]
        total = (bent * likelihood).sum() * step + straight
        mean_square = (coefficient**2 * bent * likelihood).sum() * step / total
        share = quadratic.variance_px2[k] / (quadratic.variance_px2[k] + variance)
        assert (share * estimate) ** 2 + share * variance == pytest.approx(mean_square, rel=1e-3)
