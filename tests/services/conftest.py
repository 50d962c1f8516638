"""A small simulated registration with a known truth, made anew in each test."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.quality.stability import AdjustedScene
from amers.services.sensors.correction import CorrectedModel, ImageCorrection, no_correction
from amers.services.types import UNKNOWN_FRAME, Array, BoolArray, Frame, Measures

SHAPE = (4000, 5000)
GSD_M = 0.5
METRE_DEG = 1.0 / 111_320.0


@dataclass(frozen=True)
class FlatModel:
    """A vertical view of a plane at the equator, with pixels of 0.5 m and lines towards the south."""

    height_range_m: tuple[float, float] = (-100.0, 100.0)

    def project(self, lon_lat_h: Array) -> Array:
        east_m, north_m = lon_lat_h[:, 0] / METRE_DEG, lon_lat_h[:, 1] / METRE_DEG
        return np.column_stack([-north_m, east_m]) / GSD_M

    def project_derivative(self, lon_lat_h: Array) -> Array:
        one = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]) / GSD_M
        return np.broadcast_to(one, (len(lon_lat_h), 2, 3))

    def locate(self, line_sample: Array, height_m: Array) -> Array:
        metres = np.column_stack([line_sample[:, 1], -line_sample[:, 0]]) * GSD_M
        return np.column_stack([metres * METRE_DEG, height_m])

    def line_of_sight(self, line_sample: Array) -> tuple[Array, Array]:
        raise NotImplementedError("a vertical view of a plane has no orbit")


@dataclass(frozen=True)
class Registered:
    """Measures of a scene, their adjustment, and a function that repeats the adjustment."""

    measures: Measures
    adjustment: SceneAdjustment
    refit: Callable[[BoolArray], SceneAdjustment]
    truth: ImageCorrection
    shape: tuple[int, int] = SHAPE
    gsd_m: float = GSD_M
    frame: Frame = UNKNOWN_FRAME

    def adjusted(self, refit: Callable[[BoolArray], SceneAdjustment] | None = None) -> AdjustedScene:
        """The adjusted scene, with its own function that repeats the adjustment or another one."""
        model = CorrectedModel(FlatModel(), self.adjustment.correction)
        return AdjustedScene(
            model,
            self.measures,
            self.adjustment,
            self.shape,
            self.gsd_m,
            self.frame,
            refit or self.refit,
        )


def register(
    n: int = 60,
    noise_px: float = 0.2,
    lost: int = 8,
    wrong: int = 4,
    extent: float = 1.0,
    seed: int = 0,
    *,
    points_px: float = 0.0,
    stated_px: float | None = None,
    bend_px: float = 0.0,
    shared_px: float = 0.0,
) -> Registered:
    """A simulated registration on n visible points.

    Args:
        n: number of visible points; `lost` of them are not matched, `wrong` of them are mismatched.
        noise_px: noise of the measures.
        extent: share of each side of the image that has points.
        seed: seed of the random numbers.
        points_px: errors of the points, as the image shows them.
        stated_px: their stated standard deviation; by default the true one.
        bend_px: largest error of the model along the lines that no correction removes.
        shared_px: errors of the points that neighbours share, correlated over 0.2 of the image; no sigma
            states them.
    """
    rng = np.random.default_rng(seed)
    model, frame = FlatModel(), no_correction(SHAPE)
    truth = replace(frame, parameters=np.array([[12.0, 1.5, 0.0], [-7.0, 0.0, 0.0]]))
    predicted = rng.uniform(0.0, 1.0, (n, 2)) * (np.array(SHAPE) - 1.0) * extent
    lon_lat_h = model.locate(predicted, np.zeros(n))
    observed = truth.apply(predicted) + rng.normal(0.0, noise_px, (n, 2))
    observed += np.random.default_rng(seed + 1).normal(0.0, points_px, (n, 2))
    if shared_px:
        apart = cdist(predicted / SHAPE, predicted / SHAPE)
        smooth = np.linalg.cholesky(np.exp(-apart / 0.2) + 1e-9 * np.eye(n))
        observed += shared_px * smooth @ np.random.default_rng(seed + 2).normal(size=(n, 2))
    observed[:, 1] += bend_px * np.sin(2.0 * np.pi * predicted[:, 0] / SHAPE[0])
    observed[:lost] = np.nan
    observed[lost : lost + wrong] += rng.choice([-1.0, 1.0], (wrong, 2)) * rng.uniform(
        6.0, 15.0, (wrong, 2)
    )

    sigma_m = GSD_M * (points_px if stated_px is None else stated_px)

    def refit(usable: BoolArray, like: SceneAdjustment | None = None) -> SceneAdjustment:
        observations = ControlObservations(
            lon_lat_h, observed, np.full(n, noise_px), np.tile(sigma_m**2 * np.eye(3), (n, 1, 1)), usable
        )
        return adjust_scene(model, SHAPE, observations, AdjustmentOptions(order="drift"), like=like)

    matched = np.isfinite(observed).all(axis=1)
    adjustment = refit(matched)
    corrected = CorrectedModel(model, adjustment.correction)
    residual_px = observed - corrected.project(lon_lat_h)
    reason = np.where(adjustment.active, "", np.where(matched, "beyond 2.7 sigma", "score under 0.8"))
    reason = reason.astype("<U32")
    reason[: lost // 2] = np.where(matched[: lost // 2], reason[: lost // 2], "second peak too close")
    measures = Measures(
        point_id=np.arange(n),
        lon_lat_h=lon_lat_h,
        predicted=predicted,
        line_sample=observed,
        sigma_px=np.where(matched, noise_px, np.nan),
        score=np.where(matched, rng.uniform(0.8, 0.98, n), rng.uniform(0.1, 0.7, n)),
        views=np.full(n, 3),
        by_gradient=np.zeros(n, dtype=bool),
        residual_px=residual_px,
        residual_m=np.column_stack([residual_px[:, 1], -residual_px[:, 0]]) * GSD_M,
        matched=matched,
        active=adjustment.active,
        reason=reason,
    )
    return Registered(measures, adjustment, partial(refit, like=adjustment), truth)


Make = Callable[..., Registered]
"""Makes a registration."""


@pytest.fixture
def registered() -> Make:
    """A function that makes a registration; see `register`."""
    return register
