"""One search of the points through one model: what all the stages of a registration share."""

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from services.adjustment.image_correction import AdjustmentOptions, SceneAdjustment, adjust_scene
from services.errors import NoConsensus, NotEnoughPoints
from services.imagery.scene import Scene, scene_centre
from services.imagery.source import image_gsds_m
from services.matching.consensus import consensus_tolerance_px, robust_affine_inliers
from services.matching.control_points import PointMatches
from services.sensors.base import SensorModel
from services.sensors.correction import CorrectedModel
from services.types import Array, BoolArray, ControlPoints


@dataclass(frozen=True)
class SearchStage:
    """One search of the points through one model.

    Attributes:
        name: "coarse" or "fine".
        chip_gsd_m: ground sampling of the chips.
        search_radius_m: how far they were searched.
        tried, matched, agreeing: numbers of points: searched, found, and part of the consensus.
        move_m: how far the agreeing points lay from where they were expected, root mean square.
    """

    name: str
    chip_gsd_m: float
    search_radius_m: float
    tried: int
    matched: int
    agreeing: int
    move_m: float


def search_radius_px(uncertainty_m: Array, gsd_m: float, largest: int) -> int:
    """Search radius that holds three standard deviations of nearly all points, chip pixels."""
    return int(np.clip(np.ceil(3.0 * np.percentile(uncertainty_m, 95) / gsd_m) + 2, 4, largest))


def adjust_matches(
    scene: Scene,
    points: ControlPoints,
    matches: PointMatches,
    candidates: BoolArray,
    options: AdjustmentOptions,
) -> SceneAdjustment:
    """The correction of a scene from what was found of its points; see `adjust_scene`."""
    ground_to_px = scene.model.project_derivative(scene_centre(scene)[None, :])[0, :, :2]
    return adjust_scene(
        scene.model,
        scene.image.shape,
        points.lon_lat_h,
        matches.line_sample,
        matches.sigma_px,
        points.covariance_m2,
        options,
        candidates,
        ground_to_px @ matches.common_covariance_m2 @ ground_to_px.T,
    )


def select_inliers(
    model: SensorModel,
    points: ControlPoints,
    matches: PointMatches,
    radius_m: float,
    min_points: int,
) -> BoolArray:
    """Points whose measures fit one affine displacement, or an error that says why there are too few."""
    predicted = model.project(points.lon_lat_h)
    found = matches.reason == ""
    if found.sum() < min_points:
        raise NotEnoughPoints(
            int(found.sum()),
            min_points,
            f"{len(points)} tried within {radius_m:.1f} m, {reasons_in_words(matches.reason)}",
        )
    sigma_px = float(np.median(_point_sigma_px(model, points, matches)[found]))
    agreeing, scale = robust_affine_inliers(predicted, matches.line_sample - predicted, found, sigma_px)
    tolerance_px = consensus_tolerance_px(scale * sigma_px)
    if agreeing.sum() < min_points:
        raise NoConsensus(
            f"{int(found.sum())} points found of {len(points)} tried, but only {int(agreeing.sum())} "
            f"agree within {tolerance_px:.1f} px, {min_points} needed"
        )
    return agreeing


def _point_sigma_px(model: SensorModel, points: ControlPoints, matches: PointMatches) -> Array:
    """Standard deviation (n,) of the measures against the points' own positions, pixels."""
    derivative = model.project_derivative(points.lon_lat_h)
    covariance = derivative @ points.covariance_m2 @ derivative.transpose(0, 2, 1)
    return np.asarray(np.sqrt(matches.sigma_px**2 + np.trace(covariance, axis1=1, axis2=2) / 2.0))


def model_uncertainty_m(
    model: CorrectedModel, points: ControlPoints, adjustment: SceneAdjustment
) -> Array:
    """Standard deviation (n,) of where the points are expected after an adjustment, metres.

    What the residuals show beyond the stated sigmas is counted too: a point still to be found may be as
    far off as those that were.
    """
    line_sample = model.project(points.lon_lat_h)
    variance = np.diagonal(adjustment.covariance_at(line_sample), axis1=1, axis2=2)
    std_px = np.sqrt(variance.max(axis=1))
    residual_px = float(np.sqrt(np.mean(adjustment.residual_px[adjustment.active] ** 2)))
    gsd_m = image_gsds_m(model, points.lon_lat_h)
    return np.asarray(np.nan_to_num(np.hypot(std_px, residual_px) * gsd_m, nan=0.0))


def summarised(
    name: str, gsd_m: float, radius_px: int, matches: PointMatches, agreeing: BoolArray
) -> SearchStage:
    move_m = matches.displacement_m[agreeing]
    return SearchStage(
        name=name,
        chip_gsd_m=gsd_m,
        search_radius_m=radius_px * gsd_m,
        tried=len(matches.reason),
        matched=int((matches.reason == "").sum()),
        agreeing=int(agreeing.sum()),
        move_m=float(np.sqrt((move_m**2).sum(axis=1).mean())) if len(move_m) else math.nan,
    )


def reasons_in_words(reason: np.ndarray) -> str:
    """How many points were not found, and why: "22 low_score, 16 nodata"."""
    counted = Counter(str(r) for r in reason if r)
    return ", ".join(f"{count} {name}" for name, count in counted.most_common()) or "none rejected"
