"""A correction has the precision it states and the right order, even with a few blunders."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from amers.services.errors import NotEnoughPoints, UndeterminedCorrection
from amers.services.misfit.affine_fit import FREE, AffineFit, Order
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.misfit.shared_errors import offset_sigma_px, overlap_correlation
from amers.services.sensors.correction import ImageCorrection, no_correction
from amers.services.types import Array, BoolArray
from tests.services.conftest import GSD_M, SHAPE, FlatModel

DEFAULTS = AdjustmentOptions()
NOISE_PX = 0.2
TRIALS = 200
a_millipixel = 1e-3

TRUTH: dict[Order, Array] = {
    "shift": np.array([[12.0, 0.0, 0.0], [-7.0, 0.0, 0.0]]),
    "drift": np.array([[12.0, 1.5, 0.0], [-7.0, 0.0, -2.0]]),
    "affine": np.array([[12.0, 1.5, 2.0], [-7.0, -1.0, -2.0]]),
}


@dataclass(frozen=True)
class Seen:
    """Points seen in an image whose model is wrong by a known correction."""

    lon_lat_h: Array
    line_sample: Array
    sigma_px: Array
    covariance_m2: Array
    truth: ImageCorrection

    def observed(self, **more: Any) -> ControlObservations:
        return ControlObservations(
            self.lon_lat_h, self.line_sample, self.sigma_px, self.covariance_m2, **more
        )

    def adjust(
        self, options: AdjustmentOptions = DEFAULTS, usable: BoolArray | None = None
    ) -> SceneAdjustment:
        return adjust_scene(FlatModel(), SHAPE, self.observed(usable=usable), options)


def seen(parameters: Array, rng: np.random.Generator, n: int = 40, noise_px: float = NOISE_PX) -> Seen:
    model, frame = FlatModel(), no_correction(SHAPE)
    truth = replace(frame, parameters=parameters)
    predicted = rng.uniform(0.0, 1.0, (n, 2)) * (np.array(SHAPE) - 1.0)
    line_sample = truth.apply(predicted) + rng.normal(0.0, 1.0, (n, 2)) * noise_px
    ground = model.locate(predicted, np.zeros(n))
    return Seen(ground, line_sample, np.full(n, noise_px), np.zeros((n, 3, 3)), truth)


def with_blunders(points: Seen, count: int, rng: np.random.Generator, size_px: float = 5.0) -> Seen:
    """The first `count` points are seen `size_px` to four times that away, in any direction."""
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    length = rng.uniform(size_px, 4.0 * size_px, count)
    line_sample = points.line_sample.copy()
    line_sample[:count] += length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return replace(points, line_sample=line_sample)


def normalised_square(result: SceneAdjustment, truth: Array) -> float:
    """Mean square of the errors of the free parameters, whitened by their covariance."""
    free = np.flatnonzero(np.diag(result.covariance) > 0.0)
    error = (result.correction.parameters - truth).ravel()[free]
    return float(error @ np.linalg.solve(result.covariance[np.ix_(free, free)], error) / len(free))


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("order", ["shift", "drift", "affine"])
def test_a_correction_is_recovered_within_its_stated_covariance(order: Order) -> None:
    rng = np.random.default_rng(0)
    options = AdjustmentOptions(order=order)
    squares = [
        normalised_square(seen(TRUTH[order], rng).adjust(options), TRUTH[order]) for _ in range(TRIALS)
    ]
    assert 0.75 < np.mean(squares) < 1.25


def test_without_noise_the_correction_is_exact() -> None:
    for order, parameters in TRUTH.items():
        points = seen(parameters, np.random.default_rng(0), noise_px=0.0)
        points = replace(points, sigma_px=np.full(40, NOISE_PX))
        result = points.adjust(AdjustmentOptions(order=order))
        np.testing.assert_allclose(result.correction.parameters, parameters, atol=a_millipixel)
        np.testing.assert_allclose(result.residual_px, 0.0, atol=a_millipixel)
        assert result.active.all()


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("order", ["shift", "drift", "affine"])
def test_the_order_is_that_of_the_truth_and_its_covariance_is_honest(order: Order) -> None:
    rng = np.random.default_rng(2)
    result = [seen(TRUTH[order], rng).adjust() for _ in range(TRIALS // 2)]
    right = [f for f in result if f.order == order]
    assert len(right) >= 0.9 * len(result)
    # Errors that 40 points might share, and here do not, are in the covariance: 0.72.
    assert 0.7 < np.mean([normalised_square(f, TRUTH[order]) for f in right]) < 1.25


def test_every_order_that_was_tried_is_reported_with_its_validation() -> None:
    result = seen(TRUTH["affine"], np.random.default_rng(0)).adjust()
    validation = dict(result.validation_px)
    assert list(validation) == ["shift", "drift", "affine"]
    assert validation["affine"] < validation["drift"] < validation["shift"]
    # Four fifths of the nearest: a normal law in two dimensions leaves 0.77 of its rms of sqrt(2) sigma.
    assert validation["affine"] == pytest.approx(0.77 * np.sqrt(2.0) * NOISE_PX, rel=0.25)


def test_points_in_a_corner_carry_a_shift_only() -> None:
    rng = np.random.default_rng(0)
    points = seen(TRUTH["shift"], rng, 40)
    corner = FlatModel().project(points.lon_lat_h) / 10.0
    crowded = replace(
        points,
        lon_lat_h=FlatModel().locate(corner, np.zeros(40)),
        line_sample=points.truth.apply(corner) + rng.normal(0.0, NOISE_PX, (40, 2)),
    )
    assert [order for order, _ in crowded.adjust().validation_px] == ["shift"]


def test_few_points_do_not_carry_an_affine() -> None:
    result = seen(TRUTH["affine"], np.random.default_rng(0), n=10).adjust()
    assert [order for order, _ in result.validation_px] == ["shift", "drift"]


@pytest.mark.parametrize("order", ["shift", "drift", "affine"])
@pytest.mark.long
def test_three_points_in_ten_may_be_wrong(order: Order) -> None:
    rng = np.random.default_rng(4)
    squares, kept_wrong, lost_right = [], 0, 0
    for _ in range(TRIALS // 4):
        result = with_blunders(seen(TRUTH[order], rng), 12, rng).adjust(AdjustmentOptions(order=order))
        squares.append(normalised_square(result, TRUTH[order]))
        kept_wrong += int(result.active[:12].sum())
        lost_right += int((~result.active[12:]).sum())
    assert np.mean(squares) < 1.4
    assert kept_wrong == 0
    assert lost_right < 0.02 * 28 * TRIALS / 4


@pytest.mark.long
def test_two_points_in_ten_may_be_wrong_when_the_order_is_chosen_too() -> None:
    rng = np.random.default_rng(5)
    result = [with_blunders(seen(TRUTH["affine"], rng), 8, rng).adjust() for _ in range(TRIALS // 4)]
    assert all(f.order == "affine" for f in result)
    assert not any(f.active[:8].any() for f in result)
    assert np.mean([normalised_square(f, TRUTH["affine"]) for f in result]) < 1.4


def test_a_measure_that_left_still_has_its_residual() -> None:
    rng = np.random.default_rng(6)
    points = with_blunders(seen(TRUTH["shift"], rng), 3, rng)
    result = points.adjust(AdjustmentOptions(order="shift"))
    expected = points.line_sample - result.correction.apply(FlatModel().project(points.lon_lat_h))
    np.testing.assert_allclose(result.residual_px, expected, atol=a_millipixel)
    assert np.hypot(*result.residual_px[:3].T).min() > 4.0


def test_measures_without_a_position_and_those_held_out_are_not_used() -> None:
    rng = np.random.default_rng(7)
    points = seen(TRUTH["shift"], rng)
    line_sample = points.line_sample.copy()
    line_sample[:5] = np.nan
    line_sample[30:] += 50.0
    result = replace(points, line_sample=line_sample).adjust(usable=np.arange(40) < 30)
    assert not result.active[:5].any()
    assert not result.active[30:].any()
    np.testing.assert_allclose(result.correction.parameters[:, 0], [12.0, -7.0], atol=3.0 * NOISE_PX)


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_sigmas_that_were_too_small_are_made_good() -> None:
    rng = np.random.default_rng(8)
    squares = []
    for _ in range(TRIALS):
        points = seen(TRUTH["shift"], rng)
        result = replace(points, sigma_px=points.sigma_px / 4.0).adjust(AdjustmentOptions(order="shift"))
        squares.append(normalised_square(result, TRUTH["shift"]))
        assert result.sigma0 == pytest.approx(4.0, rel=0.5)
    assert 0.75 < np.mean(squares) < 1.4


def test_sigmas_that_were_too_large_are_not_made_smaller() -> None:
    points = seen(TRUTH["shift"], np.random.default_rng(9))
    stated = points.adjust(AdjustmentOptions(order="shift"))
    wide = replace(points, sigma_px=points.sigma_px * 4.0).adjust(AdjustmentOptions(order="shift"))
    assert wide.sigma0 < 0.4
    stated_variance = (4.0 * NOISE_PX) ** 2 / 40.0
    variance = np.diag(wide.covariance)[[0, 3]]
    # Errors that neighbours may share are at most as large as the residuals, and add little here.
    assert (variance > 0.99 * stated_variance).all()
    assert (variance < 1.1 * stated_variance).all()
    np.testing.assert_allclose(
        wide.correction.parameters, stated.correction.parameters, atol=0.1 * NOISE_PX
    )


def test_a_mark_within_what_it_states_stays_beside_points_that_are_better_than_they_state() -> None:
    """It is off by two of its standard deviations, which are eight of what points scatter by."""
    points, first = seen(TRUTH["shift"], np.random.default_rng(30), 60), np.arange(60) == 0
    off = replace(points, line_sample=points.line_sample + first[:, None] * [0.0, 8.0 * NOISE_PX])
    for is_mark in (True, False):
        wide = replace(off, sigma_px=4.0 * off.sigma_px).observed(stated=first & is_mark)
        result = adjust_scene(FlatModel(), SHAPE, wide, AdjustmentOptions(order="shift"))
        assert result.active[0] == is_mark


@pytest.mark.parametrize("tolerance", [1.5, 2.7])
def test_honest_sigmas_have_unit_weight_whatever_the_tolerance(tolerance: float) -> None:
    """A tolerance keeps the smaller residuals: within 1.5 sigma, they have 0.74 of their sigma."""
    points = seen(TRUTH["shift"], np.random.default_rng(24), n=400)
    result = points.adjust(AdjustmentOptions(order="shift", tolerance=tolerance))
    assert result.sigma0 == pytest.approx(1.0, rel=0.06)


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_imprecise_points_weigh_little() -> None:
    rng = np.random.default_rng(10)
    sigma_m = np.where(np.arange(40) < 20, 5.0, 0.05)
    squares, errors = [], []
    for _ in range(TRIALS):
        points = seen(TRUTH["shift"], rng)
        moved_m = rng.normal(0.0, 1.0, (40, 2)) * sigma_m[:, None]
        line_sample = points.line_sample + np.column_stack([-moved_m[:, 1], moved_m[:, 0]]) / GSD_M
        covariance = sigma_m[:, None, None] ** 2 * np.diag([1.0, 1.0, 0.0])
        result = replace(points, line_sample=line_sample, covariance_m2=covariance).adjust(
            AdjustmentOptions(order="shift")
        )
        squares.append(normalised_square(result, TRUTH["shift"]))
        errors.append(result.correction.parameters[:, 0] - [12.0, -7.0])
    assert 0.75 < np.mean(squares) < 1.3
    good_only_px = np.hypot(NOISE_PX, 0.05 / GSD_M) / np.sqrt(20.0)
    assert np.std(errors) < 1.2 * good_only_px


def test_a_point_s_covariance_is_seen_along_its_own_direction() -> None:
    rng = np.random.default_rng(11)
    points = seen(TRUTH["shift"], rng)
    line_sample = points.line_sample + rng.normal(0.0, 2.0, (40, 1)) / GSD_M * [0.0, 1.0]
    east_only = np.tile(np.diag([4.0, 0.0, 0.0]), (40, 1, 1))
    moved = replace(points, line_sample=line_sample, covariance_m2=east_only)
    result = moved.adjust(AdjustmentOptions(order="shift"))
    std_px = np.sqrt(np.diag(result.covariance)[[0, 3]])
    expected = np.array([NOISE_PX, np.hypot(NOISE_PX, 2.0 / GSD_M)]) / np.sqrt(result.active.sum())
    assert result.active.sum() >= 38
    np.testing.assert_allclose(std_px[1] / std_px[0], expected[1] / expected[0], rtol=0.01)
    # What may be wrong with the stated sigmas, and with their independence, only adds.
    assert (std_px >= expected).all()
    assert (std_px < 1.3 * expected).all()


@pytest.mark.parametrize(("usable", "minimum"), [(0, 4), (3, 4), (5, 6)])
def test_too_few_measures_are_refused_with_their_numbers(usable: int, minimum: int) -> None:
    points = seen(TRUTH["shift"], np.random.default_rng(12), n=20)
    line_sample = points.line_sample.copy()
    line_sample[usable:] = np.nan
    with pytest.raises(
        NotEnoughPoints, match=rf"^{usable} usable points found, {minimum} needed"
    ) as caught:
        replace(points, line_sample=line_sample).adjust(AdjustmentOptions(min_points=minimum))
    assert (caught.value.found, caught.value.needed) == (usable, minimum)


def test_the_order_of_the_points_does_not_matter() -> None:
    rng = np.random.default_rng(14)
    points = with_blunders(seen(TRUTH["shift"], rng), 6, rng)
    order = rng.permutation(40)
    shuffled = Seen(
        *(getattr(points, f)[order] for f in ("lon_lat_h", "line_sample", "sigma_px", "covariance_m2")),
        points.truth,
    )
    first, other = points.adjust(), shuffled.adjust()
    np.testing.assert_allclose(
        other.correction.parameters, first.correction.parameters, atol=a_millipixel
    )
    np.testing.assert_array_equal(other.active, first.active[order])


def test_what_could_not_be_tested_stays_uncertain():
    """Points on a tenth of the image tell little of drift and skew; elsewhere these may be unseen."""
    rng = np.random.default_rng(8)
    points = seen(np.array([[3.0, 1.0, 0.0], [-2.0, 0.0, 1.0]]), rng, 400)
    near = (points.line_sample < np.array(SHAPE) * 0.3).all(axis=1)
    result = points.adjust(usable=near)
    assert result.order != "affine"
    corners = np.array([[0.0, 0.0], np.array(SHAPE) - 1.0])
    error = result.correction.apply(corners) - points.truth.apply(corners)
    std = np.sqrt(np.diagonal(result.covariance_at(corners), axis1=1, axis2=2))
    assert (np.abs(error) < 3.0 * std).all()
    # What the measures alone would tell of the far corner: a plane through them, carried there. What is
    # expected of drift and skew beforehand makes it surer by at most its own information.
    seen_at = (points.line_sample[near] - result.correction.centre) / result.correction.half_size
    plane = np.column_stack([np.ones(len(seen_at)), seen_at])
    far = np.array([1.0, 1.0, 1.0])
    expected = np.diag([0.0, 1.0, 1.0]) / DEFAULTS.prior_slope_sigma_px**2
    predicted_variance = far @ np.linalg.inv(plane.T @ plane / NOISE_PX**2 + expected) @ far
    assert std[1].min() > 0.99 * np.sqrt(predicted_variance)
    assert std[0].max() < 0.5 * std[1].min()


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_a_drift_too_small_to_be_seen_is_in_the_stated_accuracy():
    """Points of several pixels hide a drift of 1 px; the stated covariance includes it all the same."""
    rng = np.random.default_rng(15)
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]) * (np.array(SHAPE) - 1.0)
    squares, orders = [], []
    for _ in range(TRIALS):
        slopes = rng.normal(0.0, DEFAULTS.prior_slope_sigma_px, (2, 2))
        points = seen(np.column_stack([[3.0, -2.0], slopes]), rng, 80, noise_px=4.0)
        result = points.adjust()
        error = result.correction.apply(corners) - points.truth.apply(corners)
        weighted = np.linalg.solve(result.covariance_at(corners), error[:, :, None])[:, :, 0]
        squares.append((weighted * error).sum() / error.size)
        orders.append(result.order)
    assert orders.count("shift") > TRIALS / 2
    assert np.mean(squares) == pytest.approx(1.0, abs=0.2)


SEAMS_PX = np.array([[0.5, -0.4], [-0.6, 0.3], [0.2, 0.5], [-0.1, -0.4]])


def seam(line_sample: Array) -> Array:
    """Detectors out of place, which no affine follows."""
    return np.asarray(SEAMS_PX[np.clip(line_sample[:, 1] / SHAPE[1] * 4, 0, 3).astype(int)])


def patches(line_sample: Array) -> Array:
    """What neighbours share in all directions."""
    line, sample = (2.0 * np.pi * line_sample / np.array(SHAPE)).T
    return 0.5 * np.column_stack(
        [
            np.sin(2.0 * line + 1.0) * np.cos(2.0 * sample),
            np.cos(2.0 * line) * np.sin(2.0 * sample + 2.0),
        ]
    )


def displaced(
    displacement: Callable[[Array], Array], of_points_px: float
) -> list[tuple[SceneAdjustment, float]]:
    """Adjustments of displaced scenes on points of a stated accuracy, and their normalised errors."""
    rng = np.random.default_rng(16)
    places = rng.uniform(0.0, 1.0, (200, 2)) * (np.array(SHAPE) - 1.0)
    out = []
    for _ in range(TRIALS // 10):
        points = seen(TRUTH["shift"], rng, n=120, noise_px=0.05)
        moved = points.line_sample + displacement(points.line_sample)
        variance = np.tile((of_points_px * GSD_M) ** 2 * np.eye(3), (120, 1, 1))
        result = replace(points, line_sample=moved, covariance_m2=variance).adjust()
        error = result.correction.apply(places) - points.truth.apply(places) - displacement(places)
        weighted = np.linalg.solve(result.covariance_at(places), error[:, :, None])[:, :, 0]
        out.append((result, float((weighted * error).sum() / error.size)))
    return out


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize(("of_points_px", "least"), [(0.0, 0.7), (2.0, 0.0)])
def test_what_parts_of_the_image_are_off_by_is_in_the_accuracy_of_every_place(
    of_points_px: float, least: float
) -> None:
    """No points err along the samples of an image that they were not made from.

    The parts are followed. Points that state 2 px and err by none make the accuracy stated too large.
    """
    results = displaced(seam, of_points_px)
    assert all(any(one.along == "samples" for one in result.components) for result, _ in results)
    assert least < np.mean([square for _, square in results]) < 1.5


@pytest.mark.long
def test_points_that_may_err_explain_what_neighbours_share() -> None:
    local_px = [result.local_sigma_px for result, _ in displaced(patches, 2.0)]
    assert np.max(local_px) < 0.1


@pytest.mark.long
def test_independent_errors_are_no_errors_of_parts_of_the_image() -> None:
    rng = np.random.default_rng(17)
    local_px = [seen(TRUTH["affine"], rng, n=120).adjust().local_sigma_px for _ in range(TRIALS // 10)]
    assert np.median(local_px) < 0.2 * NOISE_PX


@pytest.mark.long
def test_a_third_of_blunders_does_not_hide_the_order():
    rng = np.random.default_rng(9)
    orders = [
        with_blunders(seen(TRUTH["affine"], rng), 12, rng).adjust().order for _ in range(TRIALS // 4)
    ]
    assert orders.count("affine") >= 0.9 * len(orders)


def test_measures_less_sharp_than_others_stay_where_their_points_are_better_than_declared() -> None:
    rng = np.random.default_rng(8)
    sigma_px = rng.choice([0.01, 0.2], 200)
    points = seen(TRUTH["shift"], rng, n=200, noise_px=0.0)
    noise_px = sigma_px[:, None] * rng.normal(size=(200, 2))
    points = replace(
        points,
        line_sample=points.line_sample + noise_px,
        sigma_px=sigma_px,
        covariance_m2=np.tile((3.0 * GSD_M) ** 2 * np.eye(3), (200, 1, 1)),
    )
    result = points.adjust()
    assert result.active.mean() > 0.95
    assert np.abs(result.correction.parameters[:, 0] - TRUTH["shift"][:, 0]).max() < 5.0 * a_millipixel
    # What is declared of points is not made smaller by how well they fit.
    assert result.covariance[0, 0] > 3.0**2 / 200


def test_wrong_measures_still_leave_where_points_are_better_than_declared() -> None:
    rng = np.random.default_rng(9)
    points = with_blunders(seen(TRUTH["shift"], rng, n=200, noise_px=0.05), 40, rng, size_px=0.5)
    declared = np.tile((3.0 * GSD_M) ** 2 * np.eye(3), (200, 1, 1))
    result = replace(points, covariance_m2=declared).adjust()
    assert not result.active[:40].any()
    assert result.active[40:].mean() > 0.95


@pytest.mark.parametrize("drift_px", [2.0, 10.0])
def test_a_drift_does_not_cost_good_points_where_most_lie_together(drift_px: float) -> None:
    for trial in range(20):
        rng = np.random.default_rng([16, trial])
        points = seen(np.array([[3.0, drift_px, 0.0], [-2.0, 0.0, drift_px]]), rng, 30)
        predicted = FlatModel().project(points.lon_lat_h)
        predicted[:21] = np.array([3400.0, 4200.0]) + 0.1 * (predicted[:21] - predicted.mean(axis=0))
        line_sample = points.truth.apply(predicted) + rng.normal(0.0, NOISE_PX, (30, 2))
        ground = FlatModel().locate(predicted, np.zeros(30))
        result = replace(points, lon_lat_h=ground, line_sample=line_sample).adjust()
        assert result.active.sum() >= 27


@pytest.mark.parametrize("samples", [1.0, 0.5], ids=["through the middle", "beside the middle"])
def test_a_user_s_order_is_refused_where_points_on_a_line_leave_it_open(samples: float) -> None:
    rng = np.random.default_rng(17)
    points = seen(TRUTH["shift"], rng, 20)
    predicted = np.linspace(0.1, 0.9, 20)[:, None] * np.array(SHAPE) * [1.0, samples]
    line_sample = points.truth.apply(predicted) + rng.normal(0.0, NOISE_PX, (20, 2))
    ground = FlatModel().locate(predicted, np.zeros(20))
    on_a_line = replace(points, lon_lat_h=ground, line_sample=line_sample)
    with pytest.raises(UndeterminedCorrection, match=r"20 points lie on a line.*give the order 'shift'"):
        on_a_line.adjust(AdjustmentOptions(order="affine"))
    assert on_a_line.adjust(AdjustmentOptions(order="drift")).order == "drift"
    # Left to the adjustment, what no point determines is uncertain, away from the line.
    beside = np.array([[0.0, SHAPE[1] - 1.0]])
    assert np.diagonal(on_a_line.adjust().covariance_at(beside)[0]).min() > 0.5


def test_a_repetition_expects_drifts_as_large_as_the_whole_does() -> None:
    """Points in the middle tell little of drift and skew: the corners are as uncertain as expected."""
    points = seen(TRUTH["shift"], np.random.default_rng(25), 60)
    middle = (np.abs(points.line_sample / np.array(SHAPE) - 0.5) < 0.2).all(axis=1)
    observations = points.observed(usable=middle)
    alone = adjust_scene(FlatModel(), SHAPE, observations)
    corner = np.zeros((1, 2))

    def repeated_std_px(slope_px: float) -> float:
        like = replace(alone, slope_px=slope_px, left_open=())
        result = adjust_scene(FlatModel(), SHAPE, observations, like=like)
        return float(np.sqrt(result.covariance_at(corner)[0, 0, 0]))

    assert repeated_std_px(0.01) < 0.5 * repeated_std_px(1.0)


def test_the_covariance_of_a_place_is_that_of_where_the_delivered_model_puts_it() -> None:
    rng = np.random.default_rng(18)
    points = seen(np.array([[400.0, 0.0, 0.0], [-300.0, 0.0, 0.0]]), rng)
    result = points.adjust(AdjustmentOptions(order="affine"))
    moved = np.array([[400.0, -300.0]])
    place = np.array([[100.0, 4000.0]])
    t = (place - result.correction.centre) / result.correction.half_size
    design = np.kron(np.eye(2), np.concatenate([[1.0], t[0]]))
    expected = design @ result.covariance @ design.T + np.diag(result.local_sigma_px**2)
    np.testing.assert_allclose(result.covariance_at(place + moved)[0], expected, rtol=0.01)


def blocks_apart(apart_px: float, rng: np.random.Generator, n: int = 100) -> tuple[Seen, np.ndarray]:
    """Points of two blocks, the left and the right half of an image, that differ by an offset."""
    points = seen(TRUTH["shift"], rng, n)
    block = (FlatModel().project(points.lon_lat_h)[:, 1] > SHAPE[1] / 2.0).astype(np.int64)
    moved = points.line_sample + apart_px * (block[:, None] - 0.5)
    return replace(points, line_sample=moved), block


def corner_std_px(points: Seen, block: np.ndarray | None, frame_m2: Array | None = None) -> float:
    observations = points.observed(block=block, frame_covariance_m2=frame_m2)
    result = adjust_scene(FlatModel(), SHAPE, observations)
    corner = np.array([1.0, -1.0, -1.0, 0.0, 0.0, 0.0])
    return float(np.sqrt(corner @ result.covariance @ corner))


def test_offsets_of_blocks_grow_with_the_residuals_of_their_points() -> None:
    """Chance is that of the noise which the residuals show, not of the sigmas that are stated."""
    rng = np.random.default_rng(26)
    member = np.eye(3)[rng.integers(0, 3, 60)]
    misfit = rng.normal(0.0, 1.0, (60, 2)) + member @ rng.normal(0.0, 0.8, (3, 2))

    def apart_px(times: float) -> float:
        fit = AffineFit(
            np.zeros((60, 2)), times * misfit, np.ones((60, 2)), member, np.full((2, 3), 1000.0)
        )
        everywhere, unstated = np.ones(60, dtype=bool), np.full((2, 3), np.nan)
        _, apart = offset_sigma_px(
            fit, everywhere, FREE["shift"], np.inf, unit=times, stated_px=unstated
        )
        return apart

    assert apart_px(1.0) > 0.2
    assert apart_px(4.0) == pytest.approx(4.0 * apart_px(1.0), rel=1e-3)


@pytest.mark.parametrize("blocks", [2, 5])
def test_blocks_are_seen_to_be_as_far_apart_as_they_were_put(blocks: int) -> None:
    """Their mean takes a part of each offset: of two blocks one is free."""
    rng = np.random.default_rng(28)
    member, true_px, noise_px, draws = np.eye(blocks)[np.arange(10 * blocks) % blocks], 0.8, 0.01, 300
    unstated, everywhere = np.full((2, blocks), np.nan), np.ones(len(member), dtype=bool)
    apart_px2 = []
    for _ in range(draws):
        misfit = rng.normal(0.0, noise_px, (len(member), 2))
        misfit += member @ rng.normal(0.0, true_px, (blocks, 2))
        fit = AffineFit(
            np.zeros_like(misfit),
            misfit,
            np.full_like(misfit, noise_px**2),
            member,
            np.full((2, blocks), 1000.0),
        )
        _, apart = offset_sigma_px(fit, everywhere, FREE["shift"], np.inf, unit=1.0, stated_px=unstated)
        apart_px2.append(apart**2)
    relative_sigma = np.sqrt(2.0 / (2.0 * (blocks - 1) * draws))
    assert np.mean(apart_px2) == pytest.approx(true_px**2, rel=3.0 * relative_sigma)


def test_blocks_that_disagree_do_not_pretend_to_agree() -> None:
    points, block = blocks_apart(0.8, np.random.default_rng(19))
    assert corner_std_px(points, None) < 0.2
    assert corner_std_px(points, block) > 0.3


def test_blocks_that_agree_cost_little_whatever_their_frames_state() -> None:
    points, block = blocks_apart(0.0, np.random.default_rng(20))
    alone = corner_std_px(points, None)
    for frame_m in (np.nan, 0.1, 76.0):
        frames = np.tile(frame_m**2 * np.eye(3), (2, 1, 1))
        assert corner_std_px(points, block, frames) < alone + 0.1


def test_points_of_a_second_block_do_not_look_wrong() -> None:
    points, block = blocks_apart(4.0, np.random.default_rng(21))
    observations = points.observed(block=block)
    assert adjust_scene(FlatModel(), SHAPE, observations).active.mean() > 0.9


def test_chips_that_overlap_do_not_count_twice() -> None:
    """Ten times the same chip tells no more than one."""
    rng = np.random.default_rng(22)
    points = seen(TRUTH["shift"], rng, 12)
    rows = np.repeat(np.arange(12), 10)
    ten_times = replace(
        points,
        lon_lat_h=points.lon_lat_h[rows],
        line_sample=points.line_sample[rows],
        sigma_px=points.sigma_px[rows],
        covariance_m2=points.covariance_m2[rows],
    )

    def variance(of: Seen, side_px: float) -> float:
        observations = of.observed(chip_side_px=side_px)
        shift_only = AdjustmentOptions(order="shift")
        return float(adjust_scene(FlatModel(), SHAPE, observations, shift_only).covariance[0, 0])

    assert variance(ten_times, 100.0) > 0.9 * NOISE_PX**2 / 12.0
    assert variance(ten_times, 0.0) < 0.5 * variance(ten_times, 100.0)
    assert variance(points, 100.0) < 2.0 * NOISE_PX**2 / 12.0


def test_overlapping_chips_share_noise_over_the_area_of_one_of_them() -> None:
    """Summed over all places of a second chip, the shared part is one chip, which holds no direction."""
    side_px, step_px = 40.0, 0.5
    away = np.arange(0.0, 2.0 * side_px, step_px)
    place = np.array([[0.6, 0.8]]) * away[:, None]
    shared = overlap_correlation(place, side_px, np.ones(len(away)))[0]
    area_px2 = float((shared * 2.0 * np.pi * away).sum() * step_px)
    assert area_px2 == pytest.approx(side_px**2, rel=0.01)


def test_measures_of_which_little_is_their_own_share_as_little_with_others() -> None:
    """The variance of a sum of measures is never below 0, and no order of them changes it."""
    rng = np.random.default_rng(23)
    place, own = rng.uniform(0.0, 100.0, (30, 2)), rng.uniform(0.05, 1.0, 30)
    alone = overlap_correlation(place, 40.0, np.ones(30)) - np.eye(30)
    shared = overlap_correlation(place, 40.0, own) - np.eye(30)
    assert shared.max() > 0.3
    np.testing.assert_allclose(shared, np.diag(own) ** 0.5 @ alone @ np.diag(own) ** 0.5, atol=1e-12)


@pytest.mark.parametrize("shift_px", [0.0, 12_000.0])
def test_a_deformation_of_points_is_in_the_accuracy_however_far_off_models_are(shift_px: float) -> None:
    parameters = np.array([[shift_px, 0.5, 0.0], [-shift_px, 0.0, 0.5]])
    points = seen(parameters, np.random.default_rng(9))
    plain = points.observed()
    deformation_px2 = np.array([[0.4, 0.1], [0.1, 0.2]])
    deformed = replace(plain, deformation_px2=deformation_px2)
    without, with_it = (
        adjust_scene(FlatModel(), SHAPE, one, AdjustmentOptions()) for one in (plain, deformed)
    )
    line, sample = np.array(SHAPE) - 1.0
    places = np.array([[line / 2, sample / 2], [0.0, 0.0], [line, 0.0], [line, sample]])
    added = with_it.covariance_at(places) - without.covariance_at(places)
    assert added[0] == pytest.approx(0.5 * deformation_px2, abs=0.01)
    for corner in added[1:]:
        assert corner == pytest.approx(2.5 * deformation_px2, abs=0.05)
