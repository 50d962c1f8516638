"""The scale of a block against simulated least squares, and control of several sources."""

import numpy as np
import pytest

from amers.services.adjustment.block_scale import low_scale, magnitude, posterior_scale, robust_scale
from amers.services.adjustment.control_ground import ControlGround, joined_ground
from amers.services.types import Frame, IntArray
from tests.services.adjustment.grounds import ground_of

RAYS, POINTS, SHARED = 3, 30, 24
NOISE = 1.5


def squared_residuals(rng: np.random.Generator) -> np.ndarray:
    """Of two coordinates a ray, after a fit of three unknowns a point and some that all points share."""
    rows = 2 * RAYS
    design = rng.normal(size=(POINTS * rows, SHARED + 3 * POINTS))
    for point in range(POINTS):
        others = np.ones(POINTS * rows, dtype=bool)
        others[point * rows : (point + 1) * rows] = False
        design[others, SHARED + 3 * point : SHARED + 3 * point + 3] = 0.0
    basis = np.linalg.qr(design)[0]
    error = NOISE * rng.normal(size=len(design))
    residual = error - basis @ (basis.T @ error)
    return np.asarray((residual.reshape(-1, 2) ** 2).sum(axis=1))


def test_the_scale_is_that_of_the_noise_whatever_the_points_share() -> None:
    """Of 180 values, the points take 90, and what they share 24: without it the scale is 0.86 of it."""
    rng = np.random.default_rng(5)
    point, coordinates = np.repeat(np.arange(POINTS), RAYS), np.full(POINTS, 3.0)
    scales = [
        posterior_scale(squared_residuals(rng), point, coordinates, float(SHARED)) for _ in range(60)
    ]
    assert np.mean(scales) == pytest.approx(NOISE, rel=0.04)


def control(point: IntArray, *frames: Frame) -> ControlGround:
    """Points that come from some sources in turn."""
    return ground_of(point, np.zeros((len(point), 3)), np.eye(3), *frames)


def test_points_of_joined_control_keep_their_frames() -> None:
    sigmas_m = [1.0, 2.0, 3.0, 4.0]
    first, second, third, fourth = (Frame.from_sigmas(one, one) for one in sigmas_m)
    parts = [control(np.arange(4), first, second), control(np.arange(4, 7), third)]
    parts.append(control(np.arange(7, 9), fourth))
    joined = joined_ground(parts)
    known_to_m = [joined.frames[source].sigma_m for source in joined.source]
    np.testing.assert_allclose(known_to_m, [1.0, 2.0, 1.0, 2.0, 3.0, 3.0, 3.0, 4.0, 4.0])
    np.testing.assert_array_equal(joined.point, np.arange(9))


def test_what_the_points_of_a_block_share_is_an_error_of_its_frame_as_control() -> None:
    frame = Frame(np.diag([4.0, 4.0, 9.0]), np.diag([1.0, 2.0, 3.0]))
    (as_control,) = control(np.arange(3), frame).frame_covariances()
    np.testing.assert_allclose(as_control, np.diag([5.0, 6.0, 12.0]))


def residuals_of_rays(rng: np.random.Generator, rays: int, points: int, wrong: float) -> np.ndarray:
    """Squared residuals (n,) of points that are intersected from rays, a share of which is 30 off."""
    squares = []
    for _ in range(points):
        basis = np.linalg.qr(rng.normal(size=(2 * rays, 3)))[0]
        error = NOISE * rng.normal(size=2 * rays)
        error += np.repeat(rng.random(rays) < wrong, 2) * rng.uniform(-30.0, 30.0, 2 * rays)
        squares.append(((error - basis @ (basis.T @ error)).reshape(-1, 2) ** 2).sum(axis=1))
    return np.concatenate(squares)


@pytest.mark.parametrize(("rays", "tolerance"), [(3, 0.25), (6, 0.12)])
def test_both_first_scales_are_that_of_noise_where_nothing_is_wrong(rays: int, tolerance: float) -> None:
    """Three rays share their six values unevenly, of which three are left."""
    rng = np.random.default_rng([6, rays])
    point, coordinates = np.repeat(np.arange(600), rays), np.full(600, 3.0)
    square = residuals_of_rays(rng, rays, 600, 0.0)
    assert low_scale(square, point, coordinates) == pytest.approx(NOISE, rel=tolerance)
    assert robust_scale(square, point, coordinates) == pytest.approx(NOISE, rel=0.04)


@pytest.mark.parametrize("times", [0.4, 1.0, 3.0])
def test_residuals_times_as_large_have_a_scale_times_as_large(times: float) -> None:
    """Observations may be better than they state, down to six tenths here."""
    rng = np.random.default_rng(9)
    point, coordinates = np.repeat(np.arange(400), 5), np.full(400, 3.0)
    square = residuals_of_rays(rng, 5, 400, 0.05)
    larger = times**2 * square
    assert low_scale(larger, point, coordinates) == pytest.approx(
        times * low_scale(square, point, coordinates)
    )
    assert robust_scale(larger, point, coordinates) == pytest.approx(
        times * robust_scale(square, point, coordinates), rel=5e-3
    )
    assert posterior_scale(larger, point, coordinates, 0.0) == pytest.approx(
        times * posterior_scale(square, point, coordinates, 0.0), rel=5e-3
    )


def test_a_tenth_of_wrong_rays_makes_no_first_scale_twice_as_large() -> None:
    rng = np.random.default_rng(7)
    point, coordinates = np.repeat(np.arange(600), 6), np.full(600, 3.0)
    square = residuals_of_rays(rng, 6, 600, 0.1)
    for scale in (low_scale(square, point, coordinates), robust_scale(square, point, coordinates)):
        assert NOISE < scale < 2.0 * NOISE


def test_the_scale_of_few_long_residuals_is_that_of_the_others() -> None:
    """A tenth of the points has residuals that are ten times as long: they count as long ones do."""
    rng = np.random.default_rng(8)
    point, coordinates = np.repeat(np.arange(600), 4), np.full(600, 3.0)
    square = residuals_of_rays(rng, 4, 600, 0.0)
    clean = posterior_scale(square, point, coordinates, 0.0)
    assert clean == pytest.approx(NOISE, rel=0.04)
    square[point < 60] *= 100.0
    assert clean < posterior_scale(square, point, coordinates, 0.0) < 1.3 * clean


def test_residuals_of_points_with_few_and_many_rays_are_of_one_size() -> None:
    rng = np.random.default_rng(9)
    sizes = []
    for rays in (2, 3, 8):
        point, coordinates = np.repeat(np.arange(800), rays), np.full(800, 3.0)
        square = residuals_of_rays(rng, rays, 800, 0.0)
        size = magnitude(square, point, np.ones(len(point), dtype=np.bool_), coordinates)
        sizes.append(np.sqrt(np.mean(size**2) / 2.0))
    np.testing.assert_allclose(sizes, np.sqrt(0.5) * NOISE, rtol=0.06)
