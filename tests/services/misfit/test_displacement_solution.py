"""Components and displacement of an image against the textbook: normal laws conditioned densely."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.stats import multivariate_normal

from amers.services.misfit.affine_fit import AffineFit
from amers.services.misfit.displacement_components import (
    MAX_CHANCE,
    Component,
    likeliest_components,
    unit_variance,
    with_components,
)
from amers.services.misfit.displacement_solution import agreeing_with, by_affine, solve_displacement
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.scene_solution import AgreeingMeasures
from amers.services.misfit.shared_errors import SharedErrors
from amers.services.misfit.structure import Residuals, structures
from amers.services.sensors.correction import no_correction
from amers.services.types import Array, BoolArray

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
ACROSS = Component("smooth", 2500.0, np.nan, np.array([25.0, 1.0]), along="samples")


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


@pytest.mark.parametrize("seed", [1, 3, 7, 11])
def test_beside_another_component_no_other_variance_or_length_of_one_is_likelier(seed: int) -> None:
    """The one that is found first looks small beside what nobody follows yet."""
    residuals = moved(moved(measures(seed), SMOOTH, seed), ACROSS, seed + 100)
    components, _ = likeliest_components(residuals, EXTENT_PX)
    assert {one.along for one in components} == {"lines", "samples"}
    for k, one in enumerate(components):
        beside = with_components(residuals, components[:k] + components[k + 1 :])
        most = log_likelihood(beside, one, one.variance_px2)
        for ratio in ([2.0, 1.0], [0.5, 1.0], [1.0, 2.0], [1.0, 0.5]):
            assert log_likelihood(beside, one, one.variance_px2 * ratio) <= most


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


def test_affine_parameters_displace_places_as_a_correction_of_them_does() -> None:
    """A constant in the middle of the image, and what is added to it at its last line and sample."""
    rng = np.random.default_rng(11)
    places = rng.uniform(-0.5, 1.5, (40, 2)) * SHAPE
    correction = replace(no_correction(SHAPE), parameters=rng.normal(0.0, 5.0, (2, 3)))
    moved_px = by_affine(places, no_correction(SHAPE)) @ correction.parameters.T
    np.testing.assert_allclose(places + moved_px, correction.apply(places), atol=1e-9)


def some_wrong(seed: int) -> tuple[Residuals, BoolArray]:
    """Measures of an image that moves smoothly, and which (n,) of them lie off by 12 to 20 sigmas."""
    residuals = moved(measures(seed), SMOOTH, seed)
    rng = np.random.default_rng([3, seed])
    wrong = np.arange(len(residuals.misfit)) < 8
    off_px = SIGMA_PX * rng.choice([-1.0, 1.0], (8, 2)) * rng.uniform(12.0, 20.0, (8, 2))
    misfit = residuals.misfit.copy()
    misfit[wrong] += off_px
    return replace(residuals, misfit=misfit), wrong


@pytest.mark.parametrize("times", [0.1, 1.0, 10.0])
def test_the_measures_that_disagree_are_the_same_whatever_all_sigmas_state(times: float) -> None:
    residuals, wrong = some_wrong(5)
    stated = replace(residuals, covariance=times**2 * residuals.covariance)
    agrees = agreeing_with(stated, (SMOOTH.scaled(times**2),), np.zeros((2, 3)), 4.0)
    np.testing.assert_array_equal(agrees, ~wrong)


@pytest.mark.parametrize("off_px", [[0.0, 0.0], [900.0, -1300.0], [-900.0, 1300.0]])
@pytest.mark.parametrize("reach", [0.4, 1.2])
def test_a_displacement_covers_the_points_and_the_image_wherever_the_model_expects_it(
    off_px: list[float], reach: float
) -> None:
    """Points may lie beyond the borders of the image, or on a part of it."""
    residuals, last = measures(6), np.array(SHAPE) - 1.0
    middle = 0.5 * last
    shown = middle + reach * (residuals.line_sample - middle)
    expected = replace(residuals, line_sample=shown - off_px, misfit=residuals.misfit + off_px)
    components = (SMOOTH, replace(SMOOTH, along="samples"))
    grid = solve_displacement(expected, components, A_PRIORI, SHAPE).displacement
    for axis, nodes in enumerate((grid.line, grid.sample)):
        corners = np.array([0.0, last[axis]]) - off_px[axis]
        places = np.concatenate([corners, expected.line_sample[:, axis]])
        own_px = np.abs(residuals.misfit[:, axis]).max()
        # Where the model is right, it expects the image at its own pixels.
        assert nodes[0] <= places.min() + own_px
        assert nodes[-1] >= places.max() - own_px
        assert nodes[0] >= min(places.min(), 0.0) - own_px
        assert nodes[-1] <= max(places.max(), last[axis]) + own_px


@pytest.mark.parametrize("times", [0.2, 5.0])
def test_what_measures_state_scales_the_accuracy_of_a_motion_and_leaves_the_motion(times: float) -> None:
    """A component is as large as the residuals show it, in the units of what is stated."""
    residuals = moved(measures(8), SMOOTH, 8)
    n, frame = len(residuals.misfit), no_correction(SHAPE)
    t = (residuals.line_sample - frame.centre) / frame.half_size
    variance = np.diagonal(residuals.covariance, 0, 1, 2).T
    fit = AffineFit(t, residuals.misfit, variance, np.zeros((n, 0)), np.zeros((2, 0)))
    measured = PlacedMeasures(
        residuals.line_sample, np.zeros(n), np.zeros(2), 0.0, np.eye(n), CHIP_PX, SHAPE, scanned=True
    )
    independent = SharedErrors(1.0, np.zeros(3), 0.0)
    as_shown, stated = (
        AgreeingMeasures(
            measured, fit, fit.scaled(scale), np.ones(n, dtype=np.bool_), independent, 4.0
        ).displaced(np.zeros((2, 3)), (SMOOTH,))
        for scale in (1.0, times**2)
    )
    places = np.random.default_rng(9).random((50, 2)) * (np.array(SHAPE) - 1.0)
    np.testing.assert_allclose(stated.parameters, as_shown.parameters, atol=1e-6)
    np.testing.assert_allclose(stated.covariance, times**2 * as_shown.covariance, rtol=1e-6, atol=1e-9)
    assert as_shown.displacement is not None
    assert stated.displacement is not None
    np.testing.assert_allclose(
        stated.displacement.at(places), as_shown.displacement.at(places), atol=1e-6
    )
    assert stated.sigma0 == pytest.approx(as_shown.sigma0 / times, rel=1e-6)


def test_measures_given_twice_are_judged_as_if_given_once() -> None:
    """Two chips that are the same share all their errors, so their covariance cannot be inverted."""
    residuals, wrong = some_wrong(5)
    given = np.concatenate([np.arange(len(wrong)), np.flatnonzero(~wrong)[:6]])
    twice = replace(
        residuals,
        line_sample=residuals.line_sample[given],
        height_m=residuals.height_m[given],
        misfit=residuals.misfit[given],
        covariance=residuals.covariance[:, given[:, None], given],
        design=residuals.design[given],
    )
    agrees = agreeing_with(twice, (SMOOTH,), np.zeros((2, 3)), 4.0)
    np.testing.assert_array_equal(agrees, ~wrong[given])
