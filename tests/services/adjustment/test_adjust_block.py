"""Tie points alone bring the images of a block together, with an honest covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2, f

from amers.services.adjustment.block_problem import BlockOptions
from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.intersection import intersect
from amers.services.adjustment.parameters import image_parameters
from amers.services.errors import NoConvergence, NotEnoughPoints
from amers.services.misfit.affine_fit import ORDERS, Order
from amers.services.sensors.correction import CorrectedModel
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.simulation.view import ViewGeometry
from amers.services.types import Array, Observations
from tests.services.simulated import ring_of_geometries
from tests.services.ties import Ties, difference_m, make_ties, whitened_square

NOISE_PX = 0.2
PRIOR_PX = 4.0
TRIALS = 40
a_centimetre = 0.01
a_millipixel = 1e-3
a_tenth_of_a_pixel = 0.1


@pytest.fixture(scope="module")
def five() -> list[ViewGeometry]:
    return ring_of_geometries(5)


@dataclass(frozen=True)
class Trial:
    """One block: its ties and shifts, and its adjustment."""

    ties: Ties
    shift_px: Array
    block: BlockAdjustment

    @property
    def found_px(self) -> Array:
        """(n, 2) shifts."""
        return np.array([model.correction.parameters[:, 0] for model in self.block.models])  # type: ignore[attr-defined]


def adjusted(
    geometries: Sequence[ViewGeometry],
    observations: Observations,
    prior_px: Array | None = None,
    options: BlockOptions | None = None,
) -> BlockAdjustment:
    prior_px = np.full(len(geometries), PRIOR_PX) if prior_px is None else prior_px
    images = [
        image_parameters(g.plan.image_id, g.rpc, g.plan.shape, shift_px=float(sigma_px), order="shift")
        for g, sigma_px in zip(geometries, prior_px, strict=True)
    ]
    return adjust_block(images, observations, options=options or BlockOptions())


def tried(
    geometries: Sequence[ViewGeometry], seed: int, blunders: float = 0.05, noise_px: float = NOISE_PX
) -> Trial:
    """Images shifted by what their priors allow; points seen by most of them."""
    rng = np.random.default_rng(seed)
    shift_px = rng.normal(0.0, PRIOR_PX, (len(geometries), 2))
    ties = make_ties(geometries, rng, 300, noise_px, blunders, shift_px, 0.8)
    return Trial(ties, shift_px, adjusted(geometries, ties.observations))


@pytest.fixture(scope="module")
def trials(five: list[ViewGeometry]) -> list[Trial]:
    return [tried(five, seed) for seed in range(TRIALS)]


def full_covariance(block: BlockAdjustment) -> Array:
    """Of all shifts; every two images have points in common."""
    n = len(block.models)
    blocks = np.zeros((n, n, 2, 2))
    pairs = block.accuracy.pairs
    first = np.repeat(np.arange(n), np.diff(pairs.start))
    blocks[first, pairs.other] = block.accuracy.covariance()
    blocks[pairs.other, first] = block.accuracy.covariance().transpose(0, 2, 1)
    return blocks.transpose(0, 2, 1, 3).reshape(2 * n, 2 * n)


def point_errors(trial: Trial) -> tuple[Array, Array]:
    """Errors (p, 3) of the points against their common translation, and their covariances."""
    rays = np.bincount(trial.ties.observations.point[trial.block.active], minlength=300)
    held = (rays >= 3) & np.isfinite(trial.block.lon_lat_h[:, 0])
    error_m = difference_m(trial.block.lon_lat_h[held], trial.ties.lon_lat_h[held])
    return error_m - np.median(error_m, axis=0), trial.block.point_covariance_m2[held]


@pytest.mark.monte_carlo
def test_shifts_are_recovered_within_their_stated_covariance(trials: list[Trial]) -> None:
    squares = []
    for trial in trials:
        error = (trial.found_px - trial.shift_px).ravel()
        squares.append(error @ np.linalg.solve(full_covariance(trial.block), error) / len(error))
    # Robust weights discard a little information, and blunders increase the scale: 0.76 on average.
    assert 0.6 < np.mean(squares) < 1.3


def test_shifts_that_tie_points_determine_are_found_to_a_tenth_of_a_pixel(
    five: list[ViewGeometry], trials: list[Trial]
) -> None:
    gauge = np.concatenate([_per_metre(g) for g in five])
    across = np.eye(10) - gauge @ np.linalg.pinv(gauge)
    error_px = [across @ (t.found_px - t.shift_px).ravel() for t in trials]
    assert np.abs(error_px).max() < a_tenth_of_a_pixel
    assert np.std([t.shift_px for t in trials]) > 3.0


def _per_metre(geometry: ViewGeometry) -> Array:
    """(2, 3) how the middle of the image moves with the ground."""
    middle = (np.array([geometry.plan.shape]) - 1.0) / 2.0
    return geometry.rpc.project_derivative(geometry.rpc.locate(middle, np.array([180.0])))[0]


def test_the_block_moves_as_a_whole_by_what_the_priors_say(five: list[ViewGeometry]) -> None:
    rng = np.random.default_rng(0)
    shift_px = rng.normal(0.0, PRIOR_PX, (5, 2))
    ties = make_ties(five, rng, 300, NOISE_PX, 0.0, shift_px)
    prior_px = np.array([1.0, 2.0, 4.0, 8.0, 4.0])
    block = adjusted(five, ties.observations, prior_px)
    found = np.array([model.correction.parameters[:, 0] for model in block.models])  # type: ignore[attr-defined]
    gauge = np.concatenate([_per_metre(g) for g in five])
    # No translation of the ground lowers the weighted squares of the shifts.
    weight = np.repeat(prior_px, 2) ** -2.0
    better_m = np.linalg.solve(gauge.T @ (gauge * weight[:, None]), gauge.T @ (weight * found.ravel()))
    assert np.abs(better_m).max() < 2.0 * a_centimetre


@pytest.mark.parametrize("noise_px", [0.05, 0.2, 0.8])
def test_the_position_of_the_block_is_as_precise_as_the_priors_whatever_the_noise(
    five: list[ViewGeometry], noise_px: float
) -> None:
    ties = make_ties(five, np.random.default_rng(4), 300, noise_px)
    stated = replace(ties.observations, sigma_px=np.full(len(ties.observations), NOISE_PX))
    block = adjusted(five, stated)
    gauge = np.concatenate([_per_metre(g) for g in five])
    to_ground = np.linalg.pinv(gauge)
    found_m = np.sqrt(np.diag(to_ground @ full_covariance(block) @ to_ground.T))
    expected_m = PRIOR_PX * np.sqrt(np.diag(np.linalg.inv(gauge.T @ gauge)))
    np.testing.assert_allclose(found_m, expected_m, rtol=0.05)


def test_an_image_with_an_exact_model_fixes_the_block(five: list[ViewGeometry]) -> None:
    rng = np.random.default_rng(1)
    shift_px = np.zeros((5, 2))
    shift_px[2:] = rng.normal(0.0, PRIOR_PX, (3, 2))
    ties = make_ties(five, rng, 300, NOISE_PX, 0.0, shift_px)
    prior_px = np.array([1e-3, 1e-3, 50.0, 50.0, 50.0])
    block = adjusted(five, ties.observations, prior_px)
    found = np.array([model.correction.parameters[:, 0] for model in block.models])  # type: ignore[attr-defined]
    np.testing.assert_allclose(found, shift_px, atol=a_tenth_of_a_pixel)
    error_m = difference_m(block.lon_lat_h, ties.lon_lat_h)
    assert np.abs(error_m.mean(axis=0)).max() < 10.0 * a_centimetre


def test_without_noise_rays_meet_and_the_ground_moves_in_one_piece(five: list[ViewGeometry]) -> None:
    rng = np.random.default_rng(2)
    shift_px = rng.normal(0.0, PRIOR_PX, (5, 2))
    ties = make_ties(five, rng, 300, 0.0, 0.0, shift_px)
    exact = replace(ties.observations, sigma_px=np.full(len(ties.observations), NOISE_PX))
    block = adjusted(five, exact)
    assert np.abs(block.residual_px).max() < 10.0 * a_millipixel
    error_m = difference_m(block.lon_lat_h, ties.lon_lat_h)
    assert np.abs(error_m.mean(axis=0)).max() > 0.5
    assert (error_m - error_m.mean(axis=0)).std(axis=0).max() < 2.0 * a_centimetre


def test_points_are_as_good_as_they_say_but_for_the_frame(trials: list[Trial]) -> None:
    error_m, covariance = (np.concatenate(part) for part in zip(*map(point_errors, trials), strict=True))
    square = whitened_square(error_m, covariance)
    # Mean square of three normal errors: their median is 0.79.
    assert 0.75 * 0.79 < np.median(square) < 1.1 * 0.79
    assert np.mean(square > 4.0) < 0.01


def test_points_in_a_vague_frame_have_a_covariance_that_rounding_does_not_spoil() -> None:
    pair = ring_of_geometries(2)
    ties = make_ties(pair, np.random.default_rng(5), 300, NOISE_PX, 0.0).observations
    turned = replace(ties, image=1 - ties.image)
    order = np.lexsort((turned.image, turned.point))
    one = adjusted(pair, ties, np.full(2, 1000.0))
    other = adjusted(pair[::-1], turned.take(order), np.full(2, 1000.0))
    assert one.frames[0].sigma_up_m > 1000.0
    found = np.isfinite(one.lon_lat_h[:, 0])
    assert (np.linalg.eigvalsh(one.point_covariance_m2[found]) > 0.0).all()
    np.testing.assert_allclose(
        one.point_covariance_m2[found], other.point_covariance_m2[found], rtol=1e-3, atol=1e-4
    )


def test_a_few_large_residuals_do_not_make_the_precision_of_all(five: list[ViewGeometry]) -> None:
    rng = np.random.default_rng(6)
    ties = make_ties(five, rng, 300, NOISE_PX, 0.0)
    clean = adjusted(five, ties.observations)
    # One of twenty is out by what the tolerance lets pass.
    some = rng.random(len(ties.observations)) < 0.05
    off_px = np.where(some[:, None], rng.choice([-2.5, 2.5], (len(some), 2)) * NOISE_PX, 0.0)
    longer = replace(ties.observations, line_sample=ties.observations.line_sample + off_px)
    assert adjusted(five, longer).sigma_px < 1.15 * clean.sigma_px


def test_without_blunders_points_are_exactly_as_good_as_they_say(five: list[ViewGeometry]) -> None:
    trial = tried(five, 100, blunders=0.0)
    error_m, covariance = point_errors(trial)
    assert whitened_square(error_m, covariance).mean() == pytest.approx(1.0, abs=0.15)
    assert trial.block.sigma_px == pytest.approx(1.0, abs=0.08)
    assert trial.block.active.mean() > 0.99


@pytest.mark.parametrize("noise_px", [0.05, 0.2, 0.9])
def test_the_scale_of_the_residuals_is_the_noise(five: list[ViewGeometry], noise_px: float) -> None:
    trial = tried(five, 101, noise_px=noise_px)
    stated = replace(trial.ties.observations, sigma_px=np.full(len(trial.ties.observations), NOISE_PX))
    block = adjusted(five, stated)
    assert block.sigma_px * NOISE_PX == pytest.approx(noise_px, rel=0.15)


def test_points_are_as_good_as_they_say_whatever_observations_state(five: list[ViewGeometry]) -> None:
    """Sigmas that are all too small by the same factor are made good; the points and theirs stay."""
    ties = make_ties(five, np.random.default_rng(7), 300, 3.0 * NOISE_PX)
    true, small = (
        adjusted(five, replace(ties.observations, sigma_px=np.full(len(ties.observations), sigma_px)))
        for sigma_px in (3.0 * NOISE_PX, NOISE_PX)
    )
    held = np.isfinite(true.lon_lat_h[:, 0]) & np.isfinite(small.lon_lat_h[:, 0])
    apart_m = difference_m(small.lon_lat_h[held], true.lon_lat_h[held])
    error_m = difference_m(small.lon_lat_h[held], ties.lon_lat_h[held])
    square = whitened_square(error_m - np.median(error_m, axis=0), small.point_covariance_m2[held])
    assert held.sum() > 250
    assert np.abs(apart_m).max() < a_centimetre
    assert square.mean() == pytest.approx(1.0, abs=0.2)
    np.testing.assert_allclose(
        small.point_covariance_m2[held], true.point_covariance_m2[held], rtol=0.02, atol=1e-3
    )


def test_no_order_of_the_images_changes_the_block(five: list[ViewGeometry]) -> None:
    rng = np.random.default_rng(8)
    shift_px = rng.normal(0.0, PRIOR_PX, (5, 2))
    ties = make_ties(five, rng, 300, NOISE_PX, 0.0, shift_px, 0.8).observations
    order = np.array([3, 0, 4, 1, 2])
    renamed = replace(ties, image=np.argsort(order)[ties.image])
    one = adjusted(five, ties)
    other = adjusted([five[i] for i in order], renamed.take(np.lexsort((renamed.image, renamed.point))))
    held = np.isfinite(one.lon_lat_h[:, 0])
    assert np.abs(difference_m(other.lon_lat_h[held], one.lon_lat_h[held])).max() < a_centimetre
    np.testing.assert_allclose(
        other.point_covariance_m2[held], one.point_covariance_m2[held], rtol=1e-3, atol=1e-4
    )


def test_a_block_across_180_degrees_is_that_of_any_other_place(five: list[ViewGeometry]) -> None:
    ties = make_ties(five, np.random.default_rng(9), 200, NOISE_PX)
    east_deg = 180.0 - ties.lon_lat_h[:, 0].mean()
    moved = [
        replace(one, rpc=replace(one.rpc, ground_offset=one.rpc.ground_offset + [east_deg, 0.0, 0.0]))
        for one in five
    ]
    here, there = (adjusted(of, ties.observations) for of in (five, moved))
    assert np.nanmin(there.lon_lat_h[:, 0]) < -179.9
    assert np.nanmax(there.lon_lat_h[:, 0]) > 179.9
    assert np.nanmax(np.abs(there.lon_lat_h[:, 0])) <= 180.0
    back = there.lon_lat_h - [east_deg, 0.0, 0.0]
    back[:, 0] = (back[:, 0] + 180.0) % 360.0 - 180.0
    assert np.nanmax(np.abs(difference_m(back, here.lon_lat_h))) < a_centimetre


def test_residuals_are_pixels_between_what_is_seen_and_where_the_models_show_the_points(
    trials: list[Trial],
) -> None:
    block, seen = trials[0].block, trials[0].ties.observations
    rows = np.flatnonzero(np.isfinite(block.lon_lat_h[seen.point, 0]))
    shown = np.array(
        [
            block.models[seen.image[row]].project(block.lon_lat_h[seen.point[row]][None, :])[0]
            for row in rows
        ]
    )
    np.testing.assert_allclose(
        block.residual_px[rows], seen.line_sample[rows] - shown, atol=a_millipixel
    )


def test_the_share_that_observations_tell_of_a_parameter_is_what_they_take_off_its_prior(
    five: list[ViewGeometry],
) -> None:
    slope_px = 0.2
    images = [
        image_parameters(g.plan.image_id, g.rpc, g.plan.shape, shift_px=PRIOR_PX, slope_px=slope_px)
        for g in five
    ]
    ties = make_ties(five, np.random.default_rng(10), 20, NOISE_PX)
    block = adjust_block(images, ties.observations)
    prior_px = np.tile([PRIOR_PX, slope_px * block.slope_factor, slope_px * block.slope_factor], 2)
    variance = block.accuracy.variance().reshape(5, 6)
    np.testing.assert_allclose(block.determined, 1.0 - variance / prior_px**2, atol=0.01)
    slopes = block.determined[:, [1, 2, 4, 5]]
    assert 0.05 < slopes.min() < slopes.max() < 0.95


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("displaced", [False, True])
def test_parameters_show_the_ground_where_the_corrected_model_does(
    five: list[ViewGeometry], order: Order, displaced: bool
) -> None:
    """And its derivatives are those of differences, in pixels at the edge of the image."""
    view, rng = five[0], np.random.default_rng(12)
    nodes = [np.linspace(0.0, size - 1.0, 5) for size in view.plan.shape]
    moved = rng.normal(0.0, 3.0, (5, 5, 2)) if displaced else np.zeros((5, 5, 2))
    grid = DisplacementGrid(nodes[0], nodes[1], moved, np.zeros_like(moved))
    image = image_parameters(
        "one", view.rpc, view.plan.shape, shift_px=4.0, slope_px=1.0, order=order, displacement=grid
    )
    ground = view.rpc.locate(rng.uniform(0.0, 1.0, (30, 2)) * view.plan.shape, np.full(30, 180.0))
    values = rng.normal(0.0, image.sigma)
    shown = image.computed(values, ground)
    np.testing.assert_allclose(
        shown.line_sample, image.corrected(values).project(ground), atol=a_millipixel
    )
    for k in range(len(values)):
        step = np.where(np.arange(len(values)) == k, 0.5, 0.0)
        after, before = (image.corrected(values + sign * step).project(ground) for sign in (1.0, -1.0))
        np.testing.assert_allclose(shown.by_parameters[:, :, k], after - before, atol=a_millipixel)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_drifts_that_few_images_show_have_the_regions_of_few_squares(count: int) -> None:
    """The variance that nine of ten draws of Fisher's law need, not the mean of two or three squares."""
    slope_px, drift_px, stated_count = 0.2, 0.8, 0.3
    geometries, rng = ring_of_geometries(count), np.random.default_rng(2)
    images = [
        image_parameters(g.plan.image_id, g.rpc, g.plan.shape, shift_px=PRIOR_PX, slope_px=slope_px)
        for g in geometries
    ]
    ties = make_ties(geometries, rng, 100, NOISE_PX).observations
    half = np.array(geometries[0].plan.shape) / 2.0
    drift = rng.normal(0.0, drift_px, (count, 2, 2))
    moved_px = np.einsum("mij,mj->mi", drift[ties.image], ties.line_sample / half - 1.0)
    block = adjust_block(images, replace(ties, line_sample=ties.line_sample + moved_px))
    slopes = [1, 2, 4, 5]
    shown = stated_count + float(block.determined[:, slopes].sum())
    mean_square = (stated_count + float((block.values[:, slopes] ** 2).sum()) / slope_px**2) / shown
    region = 2.0 * f.ppf(0.9, 2, shown) / chi2.ppf(0.9, 2)
    assert block.slope_factor**2 == pytest.approx(mean_square * region, rel=0.06)
    assert region > (3.0 if count == 2 else 1.1)


def test_the_observations_that_leave_are_the_wrong_ones(trials: list[Trial]) -> None:
    wrong = np.concatenate([t.ties.wrong for t in trials])
    active = np.concatenate([t.block.active for t in trials])
    points = np.concatenate([1000 * k + t.ties.observations.point for k, t in enumerate(trials)])
    touched = np.isin(points, points[wrong])
    assert active[wrong].mean() < 0.02  # those along their epipolar line, or small
    assert (~active[~touched]).mean() < 0.002


def test_active_observations_hold_their_points_with_two_rays_at_least(trials: list[Trial]) -> None:
    for trial in trials[:10]:
        rays = np.bincount(trial.ties.observations.point[trial.block.active])
        assert set(rays[rays > 0]).isdisjoint({1})


def test_a_pair_meets_across_its_rays_and_keeps_its_parallax_as_the_priors_say() -> None:
    pair = ring_of_geometries(2)
    rng = np.random.default_rng(3)
    shift_px = rng.normal(0.0, PRIOR_PX, (2, 2))
    ties = make_ties(pair, rng, 400, NOISE_PX, 0.05, shift_px)
    block = adjusted(pair, ties.observations)
    found = np.array([model.correction.parameters[:, 0] for model in block.models])  # type: ignore[attr-defined]
    gauge = np.concatenate([_per_metre(g) for g in pair])
    across = np.eye(4) - gauge @ np.linalg.pinv(gauge)
    assert np.abs(across @ (found - shift_px).ravel()).max() < a_tenth_of_a_pixel
    better_m = np.linalg.lstsq(gauge, found.ravel(), rcond=None)[0]
    assert np.abs(better_m).max() < 2.0 * a_centimetre
    assert 0.9 < block.sigma_px < 1.4
    error = (found - shift_px).ravel()
    assert error @ np.linalg.solve(full_covariance(block), error) / 4.0 < 4.0
    assert np.sqrt(block.accuracy.variance()).min() > 0.3 * PRIOR_PX


def test_corrected_models_are_those_the_points_refer_to(trials: list[Trial]) -> None:
    trial = trials[0]
    used = trial.ties.observations.take(trial.block.active)
    again = intersect(trial.block.models, used, 300)
    both = np.isfinite(again.lon_lat_h[:, 0])
    error_m = difference_m(again.lon_lat_h[both], trial.block.lon_lat_h[both])
    assert np.abs(error_m).max() < a_centimetre
    np.testing.assert_allclose(
        again.residual_px, trial.block.residual_px[trial.block.active], atol=a_millipixel
    )


def test_too_few_tie_points_are_refused_with_their_numbers(five: list[ViewGeometry]) -> None:
    ties = make_ties(five, np.random.default_rng(0), 5, NOISE_PX)
    with pytest.raises(NotEnoughPoints, match=r"^5 usable points found, 6 needed: tie points between 5"):
        adjusted(five, ties.observations)
    nothing = ties.observations.take(np.zeros(len(ties.observations), dtype=bool))
    with pytest.raises(NotEnoughPoints, match=r"^0 usable points"):
        adjusted(five, nothing)


def test_a_block_that_does_not_settle_says_so(five: list[ViewGeometry]) -> None:
    ties = make_ties(five, np.random.default_rng(0), 50, NOISE_PX, 0.05, np.full((5, 2), 3.0))
    with pytest.raises(NoConvergence, match="after 1 iterations"):
        adjusted(five, ties.observations, options=BlockOptions(max_iterations=1))


class UpTo(CorrectedModel):
    """A model that is not valid above 200 m."""

    def project(self, lon_lat_h: Array) -> Array:
        return np.where(lon_lat_h[:, 2:] > 200.0, np.nan, super().project(lon_lat_h))


def test_points_at_the_limit_of_some_models_stop_no_block(five: list[ViewGeometry]) -> None:
    """All rays may meet above the limit, and those that are valid there below it."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0.1, 0.9, (200, 2)) * five[0].plan.shape
    height_m = np.where(np.arange(200) < 100, 150.0, rng.uniform(199.7, 200.0, 200))
    truth = five[0].rpc.locate(image, height_m)
    positions = np.stack([geometry.rpc.project(truth) for geometry in five], axis=1).reshape(-1, 2)
    observations = Observations(
        np.repeat(np.arange(200), 5),
        np.tile(np.arange(5), 200),
        positions + rng.normal(0.0, NOISE_PX, positions.shape),
        np.full(1000, NOISE_PX),
    )
    images = [
        image_parameters(g.plan.image_id, g.rpc, g.plan.shape, shift_px=PRIOR_PX, order="shift")
        for g in five
    ]
    limited = [replace(image, model=UpTo(image.model, image.zero)) for image in images[:2]]
    block = adjust_block(limited + images[2:], observations)
    assert np.isfinite(block.lon_lat_h[:, 0]).all()
