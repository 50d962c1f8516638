"""Components and displacement of an image against the textbook: normal laws conditioned densely."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from services.adjustment.displacement_components import (
    MAX_CHANCE,
    Component,
    likeliest_components,
    unit_variance,
)
from services.adjustment.displacement_solution import by_affine, solve_displacement
from services.adjustment.structure import Residuals, structures
from services.sensors.correction import no_correction
from services.types import Array

SHAPE = (4000, 3000)
EXTENT_PX = 3500.0
CHIP_PX = 64.0
SIGMA_PX = np.array([0.5, 0.3])
A_PRIORI = np.array([[0.02, 0.5, 0.4], [0.01, 0.3, 0.6]])
"""Weights of the parameters of line and sample."""


def measures(seed: int, count: int = 90) -> Residuals:
    """Noise of points whose sigmas differ, and a part of which neighbours share."""
    rng = np.random.default_rng(seed)
    place = rng.random((count, 2)) * (np.array(SHAPE) - 1.0)
    apart = np.linalg.norm(place[:, None] - place[None], axis=2)
    own = rng.uniform(0.5, 2.0, count)
    covariance = (SIGMA_PX**2)[:, None, None] * (np.diag(own) + 0.2 * np.exp(-apart / 300.0))
    noise = np.stack([np.linalg.cholesky(one) @ rng.normal(size=count) for one in covariance], axis=1)
    design = by_affine(place, no_correction(SHAPE))
    return Residuals(place, np.zeros(count), np.zeros(2), noise, covariance, design, CHIP_PX)


def moved(residuals: Residuals, component: Component, seed: int) -> Residuals:
    """The residuals of an image that a component displaces by a draw of it."""
    rng, place = np.random.default_rng([1, seed]), residuals.line_sample
    root = np.linalg.cholesky(component.correlation(place, place) + 1e-9 * np.eye(len(place)))
    drawn = root @ rng.normal(size=(len(place), 2)) * np.sqrt(component.variance_px2)
    return replace(residuals, misfit=residuals.misfit + drawn)


def log_likelihood(residuals: Residuals, component: Component, variance_px2: Array) -> float:
    """Of contrasts that no affine correction changes, for the likeliest variance of unit weight."""
    contrasts = null_space(residuals.design.T).T
    correlation = component.correlation(residuals.line_sample, residuals.line_sample)
    laws = []
    for own, variance, misfit in zip(
        residuals.covariance, variance_px2, residuals.misfit.T, strict=True
    ):
        laws.append((contrasts @ misfit, contrasts @ (own + variance * correlation) @ contrasts.T))
    square = sum(float(shown @ np.linalg.solve(of, shown)) for shown, of in laws)
    unit = square / sum(len(shown) for shown, _ in laws)
    return sum(
        float(multivariate_normal(cov=unit * of, allow_singular=False).logpdf(shown))
        for shown, of in laws
    )


SMOOTH = Component("smooth", 2000.0, np.nan, np.array([1.0, 9.0]))
STEP = Component("step", 20.0, 2100.0, np.array([16.0, 4.0]))
"""Whose gap is narrower than that between points."""


@pytest.mark.parametrize(
    ("truth", "seed"), [(SMOOTH, 1), (SMOOTH, 4), (SMOOTH, 9), (STEP, 0), (STEP, 1), (STEP, 2)]
)
def test_no_other_variance_or_length_of_a_component_is_likelier(truth: Component, seed: int) -> None:
    residuals = moved(measures(seed), truth, seed)
    (component,), _ = likeliest_components(residuals, EXTENT_PX)
    assert component.kind == truth.kind
    most = log_likelihood(residuals, component, component.variance_px2)
    for ratio in ([2.0, 1.0], [0.5, 1.0], [1.0, 2.0], [1.0, 0.5]):
        assert log_likelihood(residuals, component, component.variance_px2 * ratio) < most
    if truth.kind == "smooth":
        for times in (0.4, 2.5):
            other = replace(component, length_px=component.length_px * times)
            assert log_likelihood(residuals, other, component.variance_px2) < most


def test_lines_and_samples_that_change_places_change_the_variances_of_a_component() -> None:
    residuals = moved(measures(3), SMOOTH, 3)
    exchanged = replace(
        residuals, misfit=residuals.misfit[:, ::-1], covariance=residuals.covariance[::-1]
    )
    (one,), _ = likeliest_components(residuals, EXTENT_PX)
    (other,), _ = likeliest_components(exchanged, EXTENT_PX)
    np.testing.assert_allclose(other.variance_px2, one.variance_px2[::-1])
    assert one.variance_px2[1] > one.variance_px2[0]


def test_an_image_in_other_pixels_moves_by_as_many_more_of_them() -> None:
    residuals = moved(measures(1), SMOOTH, 1)
    finer = replace(residuals, misfit=16.0 * residuals.misfit, covariance=16.0**2 * residuals.covariance)
    (one,), _ = likeliest_components(residuals, EXTENT_PX)
    (other,), _ = likeliest_components(finer, EXTENT_PX)
    assert other == replace(one, variance_px2=other.variance_px2)
    np.testing.assert_allclose(other.variance_px2, 16.0**2 * one.variance_px2)


@pytest.mark.parametrize("seed", range(3))
def test_a_step_is_followed_that_is_clear_although_it_may_be_at_any_line(seed: int) -> None:
    residuals = measures(seed)
    behind = (residuals.line_sample[:, 0] > 2000.0)[:, None] * [1.0, 0.5]
    unseen_px, followed_px = 0.0, 2.5
    for _ in range(6):
        size_px = 0.5 * (unseen_px + followed_px)
        stepped = replace(residuals, misfit=residuals.misfit + size_px * behind)
        components, _ = likeliest_components(stepped, EXTENT_PX)
        if components:
            followed_px, chance = size_px, structures(stepped, ("steps",))[0].chance
        else:
            unseen_px = size_px
    # Such evidence at one line in a hundred is a hundredth of that at the one line in question.
    assert 5e-6 < chance < 0.1 * MAX_CHANCE


def test_a_correction_is_the_conditional_law_of_what_moves_the_image() -> None:
    """Parameters and displacement together: one normal law of all unknowns, given the measures."""
    components = [
        Component("smooth", 700.0, np.nan, np.array([1.0, 4.0]), seen=0.9),
        Component("period", 2500.0, 800.0, np.array([0.5, 1.5]), seen=0.7),
        Component("smooth", 1500.0, np.nan, np.array([0.7, 0.2]), seen=0.95, along="samples"),
    ]
    residuals = measures(4)
    for number, one in enumerate(components):
        residuals = moved(residuals, one, number)
    solution = solve_displacement(residuals, components, A_PRIORI, SHAPE)
    grid = solution.displacement
    # At nodes, between which the displacement is interpolated.
    rng = np.random.default_rng(5)
    places = np.column_stack([rng.choice(grid.line, 50), rng.choice(grid.sample, 50)])
    t = by_affine(places, no_correction(SHAPE))
    for k in range(2):
        prior = np.diag(1.0 / A_PRIORI[k])
        of_measures = residuals.covariance[k] + residuals.design @ prior @ residuals.design.T
        between, own = t @ prior @ residuals.design.T, t @ prior @ t.T
        for one in components:
            variance = one.variance_px2[k]
            of_measures += variance * one.correlation(residuals.line_sample, residuals.line_sample)
            between += variance / one.seen * one.correlation(places, residuals.line_sample)
            own += variance / one.seen**2 * one.correlation(places, places)
        gain = np.linalg.solve(of_measures, between.T).T
        expected = gain @ residuals.misfit[:, k]
        found = t @ solution.parameters[k] + grid.at(places)[:, k]
        np.testing.assert_allclose(found, expected, atol=1e-6)
        variance_px2 = ((t @ solution.covariance[k]) * t).sum(axis=1) + grid.variance_at(places)[:, k]
        np.testing.assert_allclose(variance_px2, np.diagonal(own - gain @ between.T), atol=1e-6)


@pytest.mark.monte_carlo
def test_errors_that_neighbours_share_in_all_directions_are_no_motion_of_lines_or_samples() -> None:
    """Over a fifth of the image: most of these draws look like bows or steps along an axis."""
    bent = 0
    for seed in range(10):
        residuals = measures(seed, 120)
        place = residuals.line_sample
        apart = np.linalg.norm(place[:, None] - place[None], axis=2)
        root = np.linalg.cholesky(np.exp(-apart / (0.2 * EXTENT_PX)) + 1e-9 * np.eye(120))
        shared = 1.5 * root @ np.random.default_rng([8, seed]).normal(size=(120, 2))
        patchy = replace(residuals, misfit=residuals.misfit + shared)
        bent += bool(likeliest_components(patchy, EXTENT_PX)[0])
    assert bent <= 1


@pytest.mark.monte_carlo
def test_the_variance_of_unit_weight_is_one_of_few_points_as_well() -> None:
    assert np.mean([unit_variance(measures(seed, 15)) for seed in range(300)]) == pytest.approx(
        1.0, abs=0.05
    )
