"""Figures of a qualification against simulated draws and other algebra, and criteria at their limits."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from amers.services.quality.criteria import at_least, at_most
from amers.services.quality.predicted import predict_accuracy
from amers.services.quality.qualification import unexplained_px
from amers.services.types import Array, Frame
from tests.services.conftest import METRE_DEG, FlatModel

DRAWS = 200_000
two_percent = 0.02


@dataclass(frozen=True)
class ObliqueModel(FlatModel):
    """A plane seen from the side: pixels of 0.5 m by 0.8 m, turned, and moved by heights."""

    per_metre: tuple[tuple[float, ...], ...] = ((-0.3, -1.2, 0.4), (1.9, -0.5, 0.9))

    def project(self, lon_lat_h: Array) -> Array:
        east_north = lon_lat_h[:, :2] / METRE_DEG
        return np.asarray(np.column_stack([east_north, lon_lat_h[:, 2]]) @ np.array(self.per_metre).T)

    def project_derivative(self, lon_lat_h: Array) -> Array:
        return np.broadcast_to(np.array(self.per_metre), (len(lon_lat_h), 2, 3))

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        j = np.array(self.per_metre)
        east_north = np.linalg.solve(j[:, :2], (line_sample - np.outer(height_m, j[:, 2])).T).T
        return np.column_stack([east_north * METRE_DEG, height_m])


def radius_of_ninety_percent(errors: Array) -> float:
    return float(np.quantile(np.hypot(*errors.T), 0.9))


@pytest.mark.monte_carlo
@pytest.mark.parametrize("seed", [0, 1])
def test_accuracy_in_metres_is_that_of_errors_drawn_in_the_image_and_in_the_frame(registered, seed):
    rng = np.random.default_rng(seed)
    scene = registered()
    factor = rng.normal(0.0, 0.3, (2, 2))
    shift_px2 = factor @ factor.T + 0.01 * np.eye(2)
    covariance = np.zeros((6, 6))
    covariance[np.ix_([0, 3], [0, 3])] = shift_px2
    adjustment = replace(scene.adjustment, covariance=covariance)
    factor = rng.normal(0.0, 0.5, (3, 3))
    frame_m2 = factor @ factor.T
    adjusted = replace(
        replace(scene, adjustment=adjustment).adjusted(), model=ObliqueModel(), frame=Frame(frame_m2)
    )
    result = predict_accuracy(adjusted, 3)
    j = np.array(ObliqueModel().per_metre)
    shift = rng.multivariate_normal(np.zeros(2), shift_px2, DRAWS)
    of_frame = rng.multivariate_normal(np.zeros(3), frame_m2, DRAWS) @ j.T
    to_ground = np.linalg.inv(j[:, :2]).T
    assert result.worst_px == pytest.approx(radius_of_ninety_percent(shift), rel=two_percent)
    relative_m = radius_of_ninety_percent(shift @ to_ground)
    on_the_earth_m = radius_of_ninety_percent((shift + of_frame) @ to_ground)
    for found, expected in (
        (result.worst_m, relative_m),
        (result.overall_m, relative_m),
        (result.on_the_earth_worst_m, on_the_earth_m),
        (result.on_the_earth_overall_m, on_the_earth_m),
    ):
        assert found == pytest.approx(expected, rel=two_percent)


def test_the_worst_place_of_a_drift_is_at_the_edge_and_all_places_hold_ninety_percent(registered):
    scene = registered()
    adjustment = replace(scene.adjustment, covariance=np.diag([0.01, 0.2, 0.0, 0.01, 0.0, 0.0]))
    result = predict_accuracy(replace(scene, adjustment=adjustment).adjusted(), 7)
    lines = result.ce90_px.max(axis=1)
    assert result.worst_px == lines.max() == max(lines[0], lines[-1])
    rng = np.random.default_rng(4)
    std_px = np.stack([result.std_line_px, result.std_sample_px], axis=-1).reshape(-1, 1, 2)
    error_px = np.hypot(*np.moveaxis(std_px * rng.normal(size=(49, 20_000, 2)), -1, 0))
    assert np.mean(error_px < result.overall_px) == pytest.approx(0.9, abs=0.002)
    assert np.median(result.ce90_px) < result.overall_px < 0.9 * result.worst_px
    assert result.overall_m < 0.9 * result.worst_m


def shown(measures, residual_px, line_sample):
    """Measures with other residuals at other places; all are active."""
    n = len(residual_px)
    return replace(
        measures,
        residual_px=residual_px,
        line_sample=line_sample,
        active=np.ones(n, bool),
        matched=np.ones(n, bool),
    )


@pytest.mark.parametrize("axis", [0, 1])
def test_what_points_explain_is_taken_off_the_worse_coordinate(registered, axis):
    """Errors of points of 0.8 px beside those of the scene, 0.6 px in one coordinate."""
    rng = np.random.default_rng(1)
    own, n = np.array([0.0, 0.0]), 20_000
    own[axis] = 0.6
    residual = rng.standard_normal((n, 2)) * np.hypot(0.8, own)
    measures = shown(registered().measures, residual, rng.uniform(0.0, 4000.0, (n, 2)))
    left = unexplained_px(measures, np.full(2, 0.8))
    assert left == pytest.approx(0.6, rel=0.07)
    assert unexplained_px(measures, np.zeros(2)) == pytest.approx(1.0, rel=two_percent)


def test_points_explain_no_more_than_what_separates_neighbours(registered):
    """A bend of 1 px beside independent errors of 0.7 px, of points that state 5 px."""
    rng = np.random.default_rng(2)
    place = rng.uniform(0.0, 4000.0, (20_000, 2))
    bend = np.sqrt(2.0) * np.sin(2.0 * np.pi * place / 4000.0)
    measures = shown(registered().measures, bend + 0.7 * rng.standard_normal(bend.shape), place)
    assert unexplained_px(measures, np.full(2, 5.0)) == pytest.approx(1.0, rel=0.03)


@pytest.mark.monte_carlo
@pytest.mark.parametrize("n", [10, 40])
def test_chance_alone_seldom_leaves_anything_unexplained(registered, n):
    rng = np.random.default_rng(n)
    measures, one = registered().measures, np.ones(2)
    left = []
    for _ in range(300):
        place = rng.uniform(0.0, 4000.0, (n, 2))
        left.append(unexplained_px(shown(measures, rng.standard_normal((n, 2)), place), one))
    # Two standard deviations of each of two variances, beside that of the neighbours.
    assert 0.0 < np.mean(np.array(left) > 0.0) < 0.4
    assert np.quantile(left, 0.9) < 0.9


@pytest.mark.parametrize("needed_for", ["good", "usable"])
def test_a_criterion_is_met_at_its_limit_and_not_beyond(needed_for):
    for value, least, most in ((2.0, True, True), (2.0 + 1e-9, True, False), (2.0 - 1e-9, False, True)):
        assert at_least("active_points", value, 2.0, needed_for).met == least
        assert at_most("displacement_px", value, 2.0, needed_for).met == most
    assert at_least("active_points", 2.0, 2.0, needed_for).comparison == "at least"
    assert at_most("displacement_px", 2.0, 2.0, needed_for).comparison == "at most"
    for criterion in (at_least, at_most):
        assert not criterion("active_points", np.nan, 2.0, needed_for).met
