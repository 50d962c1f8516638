"""The frame of a block: known from the models of its images, weaker in height, weaker within a pass."""

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from functools import cache

import numpy as np
import pytest

from amers.services.adjustment.bundle import BlockAdjustment, adjust_block
from amers.services.adjustment.parameters import image_parameters
from amers.services.geodesy import move_metres
from amers.services.production.image_passes import image_passes
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from amers.services.simulation.view import ViewGeometry
from amers.services.types import Acquisition, Array, Observations
from tests.services.simulated import GSD_M, ring_of_geometries, world
from tests.services.ties import difference_m

pytestmark = pytest.mark.thorough

SIGMA_M = 3.0
SHAPE = (4000, 4000)
ring_m = (1.34, 1.34, 5.01)
pair_m = (3.39, 2.43, 13.46)
one_image_m = 3.0
tie_sigma_px = 0.05
a_percent = 0.01
draws = 60
three_days = timedelta(days=3)
a_minute = timedelta(minutes=1)


@cache
def ground() -> Array:
    """Points (60, 3) around the middle of the images; the first is the middle."""
    rng = np.random.default_rng(5)
    lon_lat = world().centre_lon_lat
    centre = np.append(lon_lat, world().height_m(lon_lat[None, :]))
    spread = rng.uniform([-1500.0, -1500.0, -30.0], [1500.0, 1500.0, 30.0], (60, 3))
    spread[0] = 0.0
    return move_metres(np.tile(centre, (60, 1)), spread)


@cache
def geometries(count: int) -> tuple[ViewGeometry, ...]:
    return tuple(ring_of_geometries(5, shape=SHAPE)[:count])


def observed(count: int, rng: np.random.Generator) -> Observations:
    """Positions of the points in images without error, with the noise of tie points."""
    n = len(ground())
    seen = np.stack([g.rpc.project(ground()) for g in geometries(count)], axis=1).reshape(-1, 2)
    return Observations(
        np.repeat(np.arange(n), count),
        np.tile(np.arange(count), n),
        seen + rng.normal(0.0, tie_sigma_px, seen.shape),
        np.full(n * count, tie_sigma_px),
    )


def adjusted(
    errors_px: Array, rng: np.random.Generator, acquisitions: Sequence[Acquisition] = ()
) -> BlockAdjustment:
    """The block of images (n,) delivered with shifts (n, 2)."""
    count = len(errors_px)
    images = [
        image_parameters(f"image_{k}", shifted(g.rpc, e), SHAPE, shift_px=SIGMA_M / GSD_M, slope_px=0.5)
        for k, (g, e) in enumerate(zip(geometries(count), errors_px, strict=True))
    ]
    return adjust_block(images, observed(count, rng), passes=image_passes(acquisitions))


def shifted(model: SensorModel, shift_px: Array) -> SensorModel:
    frame = no_correction(SHAPE)
    parameters = np.column_stack([shift_px, np.zeros((2, 2))])
    return CorrectedModel(model, ImageCorrection(parameters, frame.centre, frame.half_size))


def acquired(count: int, every: timedelta, sensor: str = "satellite") -> list[Acquisition]:
    start = datetime(2024, 6, 1, 10, 30, tzinfo=UTC)
    return [Acquisition(f"image_{k}", sensor, start + k * every) for k in range(count)]


def frame_covariance_m2(acquisitions: Sequence[Acquisition]) -> Array:
    count = len(acquisitions)
    adjustment = adjusted(np.zeros((count, 2)), np.random.default_rng(6), acquisitions)
    return adjustment.frames[0].covariance_m2


def frame_sigmas_m(acquisitions: Sequence[Acquisition]) -> Array:
    return np.sqrt(np.diagonal(frame_covariance_m2(acquisitions)))


def frame_errors_m(count: int, shared: bool) -> Array:
    """Translations (draws, 3) of the block, with errors of images alone or of their whole pass."""
    rng = np.random.default_rng(7)
    errors = np.empty((draws, 3))
    derivatives = [g.rpc.project_derivative(ground()[:1])[0, :, :2] for g in geometries(count)]
    for k in range(draws):
        error_m = rng.normal(0.0, SIGMA_M, (count, 2))
        if shared:
            error_m[:] = error_m[0]
        errors_px = np.einsum("nij,nj->ni", derivatives, error_m)
        found = adjusted(errors_px, rng).lon_lat_h
        errors[k] = np.nanmedian(difference_m(found, ground()), axis=0)  # NaN: deactivated points
    return errors


@pytest.mark.parametrize(("count", "expected_m"), [(5, ring_m), (2, pair_m)])
def test_the_height_of_the_frame_of_independent_images_is_weaker_than_its_position(
    count: int, expected_m: tuple[float, float, float]
) -> None:
    sigma_m = frame_sigmas_m(acquired(count, three_days))
    np.testing.assert_allclose(sigma_m, expected_m, rtol=a_percent)


@pytest.mark.monte_carlo
@pytest.mark.parametrize("count", [5, 2])
def test_errors_of_the_frame_are_as_large_as_stated(count: int) -> None:
    covariance = frame_covariance_m2(acquired(count, three_days))
    errors_m = frame_errors_m(count, shared=False)
    normalised = np.einsum("ki,ij,kj->k", errors_m, np.linalg.inv(covariance), errors_m) / 3.0
    # The mean of 60 draws of chi-square over three has a standard deviation of 0.11.
    assert 0.7 < normalised.mean() < 1.3


def test_images_of_one_pass_do_not_average_their_horizontal_errors() -> None:
    sigma_m = frame_sigmas_m(acquired(5, a_minute))
    np.testing.assert_allclose(sigma_m[:2], one_image_m, rtol=a_percent)
    np.testing.assert_allclose(sigma_m[2], ring_m[2], rtol=a_percent)


@pytest.mark.monte_carlo
@pytest.mark.parametrize("shared", [False, True])
def test_the_frame_of_a_pass_covers_errors_that_its_images_share_or_not(shared: bool) -> None:
    sigma_m = frame_sigmas_m(acquired(5, a_minute))
    mean_square = np.mean((frame_errors_m(5, shared) / sigma_m) ** 2, axis=0)
    assert (mean_square < 1.5).all()
    held = mean_square[:2] if shared else mean_square[2:]
    assert (held > 0.6).all()


def test_images_are_of_one_pass_unless_their_platforms_or_times_differ() -> None:
    apart = frame_sigmas_m(acquired(5, three_days))
    together = frame_sigmas_m(acquired(5, a_minute))
    unknown = [Acquisition(f"image_{k}") for k in range(5)]
    np.testing.assert_allclose(frame_sigmas_m(unknown), together)
    different = [acquired(5, a_minute, f"satellite {k}")[k] for k in range(5)]
    np.testing.assert_allclose(frame_sigmas_m(different), apart)
    two_passes = acquired(3, a_minute) + acquired(5, three_days)[3:]
    assert (apart[:2] < frame_sigmas_m(two_passes)[:2]).all()
    assert (frame_sigmas_m(two_passes)[:2] < together[:2]).all()
