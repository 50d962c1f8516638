"""An RPC fits a smooth model within a hundredth of a pixel, and its stated error is honest otherwise."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from amers.services.errors import CoverageError
from amers.services.sensors import rpc_fit
from amers.services.sensors.correction import (
    CorrectedModel,
    ImageCorrection,
    no_correction,
)
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.rpc import check_rpc, cubic_terms
from amers.services.sensors.rpc_fit import fit_rpc, fit_to_ground
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import Array

HEIGHTS_M = (50.0, 850.0)
a_hundredth_of_a_pixel = 0.01
a_thousandth_of_a_pixel = 0.001


def a_pushbroom(shape: tuple[int, int], jitter_px: float = 0.0, lon: float = 5.4) -> PushbroomModel:
    """A pushbroom with an incidence of 25 degrees."""
    target = np.array([lon, 43.6, 300.0])
    return pushbroom_over(target, shape, 0.5, (25.0, 110.0), HEIGHTS_M, jitter_px=jitter_px)


def error_px(model, fitted, shape: tuple[int, int]) -> np.ndarray:
    """Distance between two models at random positions and heights, pixels."""
    rng = np.random.default_rng(6)
    image = rng.uniform(0.0, 1.0, (3000, 2)) * (np.array(shape) - 1.0)
    ground = model.locate(image, rng.uniform(*HEIGHTS_M, len(image)))
    return np.linalg.norm(fitted.project(ground) - image, axis=1)


@pytest.mark.parametrize("shape", [(300, 400), (3000, 3000), (20_000, 20_000)])
def test_an_rpc_fits_a_pushbroom_within_a_thousandth_of_a_pixel(shape: tuple[int, int]) -> None:
    model = a_pushbroom(shape)
    fit = fit_rpc(model, shape, HEIGHTS_M)
    check_rpc(fit.model, "the fit")
    assert fit.max_error_px < a_thousandth_of_a_pixel
    assert error_px(model, fit.model, shape).max() < a_thousandth_of_a_pixel


def test_the_range_of_heights_is_that_of_the_fit() -> None:
    fit = fit_rpc(a_pushbroom((300, 400)), (300, 400), HEIGHTS_M)
    assert fit.model.height_range_m == pytest.approx(HEIGHTS_M)


class OfHeights:
    """A pushbroom that has no ground beyond its heights."""

    def __init__(self, base: PushbroomModel) -> None:
        self.base = base
        self.height_range_m = HEIGHTS_M
        self.project = base.project
        self.project_derivative = base.project_derivative
        self.line_of_sight = base.line_of_sight

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        ground = self.base.locate(line_sample, height_m)
        beyond = (height_m < HEIGHTS_M[0] - 1e-6) | (height_m > HEIGHTS_M[1] + 1e-6)
        return np.where(beyond[:, None], np.nan, ground)


def test_no_ground_is_needed_beyond_the_heights_of_the_fit() -> None:
    shape = (300, 400)
    assert fit_rpc(OfHeights(a_pushbroom(shape)), shape, HEIGHTS_M).max_error_px < 0.001


def test_an_rpc_is_fitted_across_the_antimeridian() -> None:
    shape = (2000, 2000)
    assert fit_rpc(a_pushbroom(shape, lon=180.0), shape, HEIGHTS_M).max_error_px < 0.001


def test_the_error_of_a_bad_fit_is_reported_in_full() -> None:
    shape = (40_000, 2000)
    model = a_pushbroom(shape, jitter_px=3.0)
    fit = fit_rpc(model, shape, HEIGHTS_M)
    actual_px = error_px(model, fit.model, shape)
    assert fit.max_error_px > 0.5
    assert fit.rms_error_px == pytest.approx(np.sqrt((actual_px**2).mean()), rel=0.2)
    assert fit.max_error_px >= 0.8 * actual_px.max()


def test_of_fits_that_are_all_too_far_off_the_closest_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """None is close enough; each damping alone gives one, and all together the best of those."""
    shape = (20_000, 2000)
    model = fit_rpc(a_pushbroom(shape), shape, HEIGHTS_M).model
    shaken = a_pushbroom(shape, jitter_px=3.0)
    monkeypatch.setattr(rpc_fit, "CLOSE_ENOUGH_PX", 0.0)
    monkeypatch.setattr(rpc_fit, "_GRIDS", ((6, 6, 4), (9, 9, 4)))
    ridges = rpc_fit.RIDGES
    together_px = fit_to_ground(model).max_error_px, fit_rpc(shaken, shape, HEIGHTS_M).max_error_px
    alone_px = []
    for ridge in ridges:
        monkeypatch.setattr(rpc_fit, "RIDGES", (ridge,))
        alone_px.append(
            (fit_to_ground(model).max_error_px, fit_rpc(shaken, shape, HEIGHTS_M).max_error_px)
        )
    nearest_px = np.min(alone_px, axis=0)
    assert together_px[0] == nearest_px[0] < np.max(alone_px, axis=0)[0]
    assert together_px[1] <= nearest_px[1]


def test_a_full_affine_is_refitted_within_a_hundredth_of_a_pixel() -> None:
    shape = (5000, 4000)
    rpc = fit_rpc(a_pushbroom(shape), shape, HEIGHTS_M).model
    affine = ImageCorrection(np.array([[40.0, 3.0, -2.0], [-25.0, 1.5, 4.0]]), *_frame(shape))
    corrected = CorrectedModel(rpc, affine)
    fit = fit_rpc(corrected, shape, HEIGHTS_M)
    assert fit.max_error_px < a_hundredth_of_a_pixel
    assert error_px(corrected, fit.model, shape).max() < a_hundredth_of_a_pixel


@dataclass
class CountingModel:
    """A sensor model that counts the positions it located for every grid."""

    base: CorrectedModel
    located: list[int] = field(default_factory=list)

    def locate(self, line_sample: np.ndarray, height_m: np.ndarray) -> np.ndarray:
        self.located.append(len(line_sample))
        return self.base.locate(line_sample, height_m)


def test_an_affine_is_refitted_on_few_points_and_a_jitter_on_more() -> None:
    shape = (40_000, 2000)
    affine = ImageCorrection(np.array([[9.0, 1.0, -2.0], [5.0, 1.5, 4.0]]), *_frame(shape))
    points_of_fits = {}
    for jitter_px in (0.0, 3.0):
        rpc = fit_rpc(a_pushbroom(shape), shape, HEIGHTS_M).model
        base = rpc if jitter_px == 0.0 else a_pushbroom(shape, jitter_px)
        model = CountingModel(CorrectedModel(base, affine))
        fit_rpc(model, shape, HEIGHTS_M)
        check_points = max(model.located)
        points_of_fits[jitter_px] = [n for n in model.located if n < check_points]
    assert points_of_fits == {0.0: [256], 3.0: [256, 2048]}


def _frame(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    plain = no_correction(shape)
    return plain.centre, plain.half_size


def test_a_model_that_does_not_cover_the_heights_is_refused_with_numbers() -> None:
    with pytest.raises(CoverageError, match=r"only \d+ of 9583 positions"):
        fit_rpc(a_pushbroom((300, 400)), (300, 400), (-6.4e6, 100.0))


@pytest.mark.parametrize("lon", [5.4, 180.0])
def test_an_rpc_is_inverted_within_a_hundredth_of_a_pixel(lon: float) -> None:
    shape = (3000, 4000)
    model = fit_rpc(a_pushbroom(shape, lon=lon), shape, HEIGHTS_M).model
    fit = fit_to_ground(model)
    rng = np.random.default_rng(3)
    normalised = rng.uniform(-0.95, 0.95, (500, 3))
    terms = cubic_terms(normalised)
    side = [terms @ fit.lon_num / (terms @ fit.lon_den), terms @ fit.lat_num / (terms @ fit.lat_den)]
    ground = model.ground_offset + np.column_stack([*side, normalised[:, 2]]) * model.ground_scale
    expected = model.image_offset + normalised[:, [1, 0]] * model.image_scale
    assert np.abs(model.project(ground) - expected).max() <= fit.max_error_px < a_hundredth_of_a_pixel
