"""What residuals tell of errors that points share, against errors of a known share and length."""

import numpy as np
import pytest

from amers.services.misfit.affine_fit import FREE, AffineFit
from amers.services.misfit.shared_errors import SharedErrors, likeliest_shared_errors

LENGTHS = 0.05, 0.1, 0.2
"""Sides of the image, over which errors may be correlated."""
SIGMA_PX = 0.5
DRAWS = 12


def told(
    rng: np.random.Generator, count: int, share: float, length: float, times: float = 1.0
) -> SharedErrors:
    """Of points all over an image whose errors are some times as large as stated."""
    t = rng.uniform(-1.0, 1.0, (count, 2))
    position = (t + 1.0) / 2.0
    distance = np.linalg.norm(position[:, None] - position[None], axis=2)
    correlation = (1.0 - share) * np.eye(count) + share * np.exp(-distance / length)
    error = times * SIGMA_PX * np.linalg.cholesky(correlation) @ rng.normal(size=(count, 2))
    fit = AffineFit(t, error, np.full((count, 2), SIGMA_PX**2), np.zeros((count, 0)), np.zeros((2, 0)))
    return likeliest_shared_errors(
        fit,
        np.ones(count, dtype=np.bool_),
        FREE["affine"],
        np.inf,
        position=position,
        overlapping=np.eye(count),
    )


@pytest.mark.monte_carlo
@pytest.mark.parametrize(("share", "length"), [(0.65, 0.1), (0.9, 0.2), (0.4, 0.05)])
def test_the_share_and_the_length_of_common_errors_are_found(share: float, length: float) -> None:
    rng = np.random.default_rng([21, round(100 * share)])
    scenes = [told(rng, 150, share, length) for _ in range(DRAWS)]
    parts = np.mean([one.correlated / one.factor for one in scenes], axis=0)
    assert parts.sum() == pytest.approx(share, abs=0.1)
    assert parts[LENGTHS.index(length)] > 0.55 * parts.sum()
    assert np.mean([one.clear_share for one in scenes]) == pytest.approx(share, abs=0.15)


@pytest.mark.monte_carlo
def test_independent_errors_of_many_points_are_seen_to_be_so() -> None:
    rng = np.random.default_rng(22)
    scenes = [told(rng, 150, 0.0, 0.1) for _ in range(DRAWS)]
    assert np.mean([one.correlated.sum() for one in scenes]) < 0.08


@pytest.mark.monte_carlo
@pytest.mark.parametrize("share", [0.0, 0.65])
def test_few_points_make_nothing_clear_and_leave_open_what_is_shared(share: float) -> None:
    """What neighbours share counts in the covariance although it may as well be nothing."""
    rng = np.random.default_rng(23)
    scenes = [told(rng, 12, share, 0.1) for _ in range(DRAWS)]
    assert sum(one.clear_share == 0.0 for one in scenes) >= 10
    assert 0.2 < np.mean([one.correlated.sum() / one.factor for one in scenes]) < 0.6


@pytest.mark.monte_carlo
def test_the_factor_is_the_variance_of_errors_that_are_three_times_as_large_as_stated() -> None:
    rng = np.random.default_rng(24)
    scenes = [told(rng, 200, 0.0, 0.1, times=3.0) for _ in range(DRAWS)]
    assert np.mean([one.factor for one in scenes]) == pytest.approx(9.0, rel=0.04)


def test_normal_errors_within_the_stated_sigmas_have_the_factor_one() -> None:
    rng = np.random.default_rng(25)
    scenes = [told(rng, 200, 0.0, 0.1, times=0.5) for _ in range(3)]
    assert all(one.factor == pytest.approx(1.0, abs=1e-3) for one in scenes)


def test_residuals_are_clipped_at_a_number_of_their_own_sigmas() -> None:
    rng = np.random.default_rng(3)
    sigma = rng.uniform(0.2, 3.0, (20, 2))
    misfit = 100.0 * rng.choice([-1.0, 1.0], (20, 2))
    t, parameters = rng.uniform(-1.0, 1.0, (20, 2)), rng.normal(size=(2, 3))
    fit = AffineFit(t, misfit, sigma**2, np.zeros((20, 0)), np.zeros((2, 0)))
    residual = fit.clipped(parameters, 2.5).misfit - fit.design @ parameters.T
    np.testing.assert_allclose(residual, 2.5 * sigma * np.sign(misfit))
