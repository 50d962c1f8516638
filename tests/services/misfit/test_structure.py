"""The test of structure in residuals: exact for one shape, and no larger than stated for many."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as f_law

from amers.services.misfit.control_observations import ControlObservations, declared_fit
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.structure import Family, Residuals, probability_of_structure, structures
from amers.services.types import Array
from tests.services.quality.test_figures import ObliqueModel

SHAPE = (4000.0, 3000.0)
COUNT = 45


def independent(rng: np.random.Generator) -> Residuals:
    """Normal errors whose sigmas differ, and a part of which neighbours share as it is stated."""
    place = rng.random((COUNT, 2)) * SHAPE
    apart = np.linalg.norm(place[:, None] - place[None], axis=2)
    sigma = rng.uniform(0.3, 1.0, (2, COUNT))
    correlation = 0.7 * np.eye(COUNT) + 0.3 * np.exp(-apart / 400.0)
    covariance = sigma[:, :, None] * correlation * sigma[:, None, :]
    misfit = np.stack([np.linalg.cholesky(one) @ rng.normal(size=COUNT) for one in covariance], axis=1)
    design = np.column_stack([np.ones(COUNT), place / SHAPE])
    height_m = rng.normal(0.0, 50.0, COUNT)
    return Residuals(place, height_m, np.zeros(2), misfit, covariance, design, 60.0)


def generalised(residuals: Residuals, columns: Array) -> float:
    """Sum of the whitened squares of line and sample that a design with further columns leaves."""
    total = 0.0
    design = np.column_stack([residuals.design, columns])
    for covariance, misfit in zip(residuals.covariance, residuals.misfit.T, strict=True):
        inverse = np.linalg.inv(covariance)
        parameters = np.linalg.solve(design.T @ inverse @ design, design.T @ inverse @ misfit)
        left = misfit - design @ parameters
        total += float(left @ inverse @ left)
    return total


@pytest.mark.parametrize("columns", [1, 2])
def test_what_a_shape_explains_is_what_a_larger_adjustment_leaves_less(columns: int) -> None:
    rng = np.random.default_rng(71)
    residuals = independent(rng)
    shapes = rng.normal(size=(3, COUNT, columns))
    gain, _ = residuals.gains(shapes)
    before = generalised(residuals, np.empty((COUNT, 0)))
    after = np.array([generalised(residuals, shape) for shape in shapes])
    np.testing.assert_allclose(gain, before - after, rtol=1e-6)
    freedom = 2.0 * (COUNT - 3 - columns)
    ratio = (before - after) / (2.0 * columns) / (after / freedom)
    expected = f_law.sf(ratio, 2 * columns, freedom)
    np.testing.assert_allclose(residuals.chance(gain, columns), expected, rtol=1e-6)


@pytest.mark.monte_carlo
def test_the_chance_of_one_shape_is_even_over_independent_errors() -> None:
    rng = np.random.default_rng(72)
    chances = np.array([structures(independent(rng), ("height",))[0].chance for _ in range(300)])
    for limit in (0.1, 0.5, 0.9):
        assert np.mean(chances < limit) == pytest.approx(limit, abs=0.08)


@pytest.mark.monte_carlo
@pytest.mark.parametrize("family", ["lines", "steps", "samples", "image"])
def test_the_best_of_many_shapes_is_charged_for_all_of_them(family: Family) -> None:
    rng = np.random.default_rng(73)
    chances = [structures(independent(rng), (family,))[0].chance for _ in range(150)]
    assert 0.02 < np.mean([one < 0.2 for one in chances]) < 0.25
    assert np.mean([one < 0.01 for one in chances]) < 0.03


@pytest.mark.parametrize("family", ["lines", "steps", "samples", "seams", "image", "height"])
def test_a_structure_is_the_same_wherever_points_lie_and_however_large_the_image(family: Family) -> None:
    """Lines counted from another one, twice the pixels, twice the chips."""
    residuals = independent(np.random.default_rng(77))
    start, times = np.array([9000.0, -700.0]), 2.0
    elsewhere = replace(
        residuals,
        line_sample=start + times * residuals.line_sample,
        chip_side_px=times * residuals.chip_side_px,
    )
    here, there = (structures(one, (family,))[0] for one in (residuals, elsewhere))
    assert there.chance == pytest.approx(here.chance, rel=1e-6)
    assert there.shape == here.shape
    np.testing.assert_allclose(there.size_px, here.size_px, rtol=1e-6)
    if here.shape == "step":
        assert there.at == pytest.approx(start[int(family == "seams")] + times * here.at)
    elif here.shape == "period":
        assert there.at == pytest.approx(times * here.at)


@pytest.mark.parametrize("beside", [1, 2, 3, 8])
def test_a_step_has_three_points_on_each_side(beside: int) -> None:
    residuals = independent(np.random.default_rng(74))
    line = np.sort(residuals.line_sample[:, 0])
    at = 0.5 * (line[-beside - 1] + line[-beside])
    behind = (residuals.line_sample[:, 0] > at)[:, None] * [40.0, 20.0]
    found = structures(replace(residuals, misfit=residuals.misfit + behind), ("steps",))[0]
    if beside < 3:
        assert found.at < at
    else:
        assert found.shape == "step"
        assert found.at == pytest.approx(at)
        np.testing.assert_allclose(found.size_px, behind.std(axis=0), rtol=0.05)
        largest_px = np.linalg.norm(behind - behind.mean(axis=0), axis=1).max()
        assert found.largest_px == pytest.approx(largest_px, rel=0.04)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("degree", "name"), [(2, "quadratic"), (3, "cubic")])
def test_a_bow_is_named_by_the_degree_that_explains_all_of_it(axis: int, degree: int, name: str) -> None:
    """A bend is a polynomial about the middle of the points: odd ones need no even one."""
    residuals = independent(np.random.default_rng(76))
    low, high = residuals.line_sample[:, axis].min(), residuals.line_sample[:, axis].max()
    unit = (residuals.line_sample[:, axis] - 0.5 * (low + high)) / (0.5 * (high - low))
    bow = np.outer(unit**degree, [30.0, -10.0])
    bent = replace(residuals, misfit=bow + 1e-3 * residuals.misfit)
    found = structures(bent, ("lines" if axis == 0 else "samples",))[0]
    assert found.shape == name
    beyond = bow - residuals.design @ np.linalg.lstsq(residuals.design, bow, rcond=None)[0]
    shape_px = bow.std(axis=0) if degree == 2 else (np.outer(unit**3 - 0.6 * unit, [30.0, -10.0])).std(0)
    np.testing.assert_allclose(found.size_px, shape_px, rtol=1e-3)
    assert found.largest_px > np.linalg.norm(beyond, axis=1).mean()


def test_no_period_is_looked_for_that_is_shorter_than_a_chip() -> None:
    residuals = independent(np.random.default_rng(75))
    phase = 2.0 * np.pi * residuals.line_sample[:, 0] / 150.0
    oscillating = replace(
        residuals, misfit=residuals.misfit + 8.0 * np.column_stack([np.sin(phase)] * 2)
    )
    seen, hidden = (
        structures(replace(oscillating, chip_side_px=side_px), ("lines",))[0]
        for side_px in (100.0, 300.0)
    )
    assert seen.chance < 1e-6 < hidden.chance
    assert seen.at == pytest.approx(150.0, rel=0.02)
    assert hidden.at > 299.0 or hidden.shape != "period"


def test_a_structure_of_a_chance_of_a_hundredth_is_as_likely_real_as_the_prior_lets() -> None:
    """1 / (-e p ln p) = 8: odds of 1 to 19 a priori become 8 to 19, and even ones 8 to 1."""
    assert probability_of_structure(0.01, 0.05) == pytest.approx(7.99 / (7.99 + 19.0), rel=1e-3)
    assert probability_of_structure(0.01, 0.5) == pytest.approx(7.99 / 8.99, rel=1e-3)
    assert probability_of_structure(0.5) == 0.0


@pytest.mark.parametrize(("times", "left"), [(0.5, 0.0), (4.0, 0.0), (-2.0, -2.0)])
def test_residuals_that_errors_of_heights_explain_are_no_structure(times: float, left: float) -> None:
    """Points too high by their error are displaced by it; against that direction nothing explains it."""
    told = independent(np.random.default_rng(79))
    covariance = np.array([-30.0, 20.0])
    slope = -covariance / told.height_m.var()
    misfit = 1e-4 * told.misfit + times * told.height_m[:, None] * slope
    found = structures(replace(told, height_pull=covariance, misfit=misfit), ("height",))[0]
    np.testing.assert_allclose(found.slope_px, left * slope, atol=1e-4)


def test_errors_of_heights_explain_no_more_than_points_can_be_worse_than_declared() -> None:
    told = independent(np.random.default_rng(79))
    covariance = np.array([-30.0, 20.0])
    slope = -covariance / told.height_m.var()
    misfit = 1e-4 * told.misfit + 30.0 * told.height_m[:, None] * slope
    found = structures(replace(told, height_pull=covariance, misfit=misfit), ("height",))[0]
    assert (0.5 * 30.0 * np.abs(slope) < np.abs(found.slope_px)).all()
    assert (np.abs(found.slope_px) < 25.0 * np.abs(slope)).all()


def test_errors_of_heights_go_with_displacements_as_the_covariances_of_points_state() -> None:
    """Of points that all state one covariance, in a view that each of its axes displaces otherwise."""
    rng, model = np.random.default_rng(80), ObliqueModel()
    root = rng.normal(size=(3, 3))
    error_m = rng.normal(size=(200_000, 3)) @ root.T
    shown_px = error_m @ np.array(model.per_metre).T
    place, stated_m2 = rng.random((9, 2)) * SHAPE, np.tile(root @ root.T, (9, 1, 1))
    observations = ControlObservations(
        model.locate(place, np.zeros(9)), place, np.full(9, 0.5), stated_m2
    )
    shape = int(SHAPE[0]), int(SHAPE[1])
    fit, _, of_points = declared_fit(model, shape, observations)
    measured = PlacedMeasures.of(model, shape, observations, fit=fit, of_points=of_points)
    pull = (shown_px * error_m[:, 2:]).mean(axis=0)
    np.testing.assert_allclose(measured.height_pull, pull, atol=0.02 * np.abs(pull).max())
    np.testing.assert_allclose(of_points[0], shown_px.var(axis=0), rtol=0.02)
    assert measured.points_px2 == pytest.approx(shown_px.var(axis=0).max(), rel=0.02)
