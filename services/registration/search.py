"""One search of points through one model, and the adjustment on what it found: used by all stages."""

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from services.adjustment.image_correction import (
    AdjustmentOptions,
    ControlObservations,
    SceneAdjustment,
    adjust_scene,
)
from services.conventions import MAX_ERROR_SIGMAS
from services.errors import NoConsensus, NotEnoughPoints
from services.imagery.scene import Scene, scene_centre
from services.imagery.source import image_gsds_m
from services.matching.consensus import Consensus, consensus_tolerance_px, robust_affine_inliers
from services.matching.control_points import PointMatches
from services.registration.context import Prediction
from services.sensors.base import SensorModel
from services.sensors.correction import CorrectedModel
from services.types import Array, BoolArray, ControlPoints, IntArray

FIRST_TOLERANCE_PX = 3.0
"""Displacements of a first search agree within this many pixels of the chips that are searched."""


@dataclass(frozen=True)
class SearchStage:
    """Summary of one search of the points through one model.

    Attributes:
        name: "coarse" or "fine" on control points, "reference" on a reference image.
        chip_gsd_m: ground sampling of the chips that were searched.
        search_radius_m: search radius on the ground.
        tried, matched, inliers: numbers of points searched, found, and in agreement with each other.
        displacement_rms_m: distance of the inliers from their expected positions, root mean square.
    """

    name: str
    chip_gsd_m: float
    search_radius_m: float
    tried: int
    matched: int
    inliers: int
    displacement_rms_m: float


@dataclass(frozen=True)
class Search:
    """One search of points through one model.

    Attributes:
        points: the k points that were tried.
        rows: (k,) their rows among all visible points of the registration, ascending.
        matches: of the points tried.
        inliers: (k,) points that agree on one displacement of the image.
        stage: summary of the search.
    """

    points: ControlPoints
    rows: IntArray
    matches: PointMatches
    inliers: BoolArray
    stage: SearchStage


def search_radius_px(uncertainty_m: Array, gsd_m: float, largest: int) -> int:
    """Search radius that holds the largest expected error of nearly all points, pixels of the chips."""
    reach = MAX_ERROR_SIGMAS * np.percentile(uncertainty_m, 95) / gsd_m
    return int(np.clip(np.ceil(reach) + 2, 4, largest))


def adjust_search(
    scene: Scene,
    search: Search,
    options: AdjustmentOptions,
    *,
    usable: BoolArray | None = None,
    min_points: int | None = None,
) -> SceneAdjustment:
    """The correction of a scene from the matches of a search; see `adjust_scene`.

    Args:
        scene: as delivered.
        search: of the points.
        options: of the adjustment.
        usable: (k,) matches that may be used; the inliers when None.
        min_points: smallest number of active measures; that of the options when None.
    """
    matches = search.matches
    ground_to_px = scene.model.project_derivative(scene_centre(scene)[None, :])[0, :, :2]
    observations = ControlObservations(
        lon_lat_h=search.points.lon_lat_h,
        line_sample=matches.line_sample,
        sigma_px=matches.sigma_px,
        covariance_m2=search.points.covariance_m2,
        usable=search.inliers if usable is None else usable,
        common_covariance_px2=ground_to_px @ matches.common_covariance_m2 @ ground_to_px.T,
    )
    return adjust_scene(scene.model, scene.image.shape, observations, options, min_points=min_points)


def select_inliers(
    model: SensorModel,
    points: ControlPoints,
    matches: PointMatches,
    radius_m: float,
    min_points: int,
) -> BoolArray:
    """Points (k,) whose matches agree on one affine displacement.

    Args:
        model: that predicted the points.
        points: those that were tried.
        matches: of these points.
        radius_m: search radius, for the message.
        min_points: smallest number of inliers.

    Raises:
        NotEnoughPoints: fewer points were found than are needed.
        NoConsensus: fewer of the points found agree than are needed.
    """
    predicted = model.project(points.lon_lat_h)
    matched = matches.reason == ""
    if matched.sum() < min_points:
        raise NotEnoughPoints(
            int(matched.sum()),
            min_points,
            f"{len(points)} tried within {radius_m:.1f} m, {format_reasons(matches.reason)}",
        )
    sigma_px = float(np.median(_point_sigma_px(model, points, matches)[matched]))
    displacement_px = matches.line_sample - predicted
    inliers, scale = robust_affine_inliers(predicted, displacement_px, matched, sigma_px)
    tolerance_px = consensus_tolerance_px(scale * sigma_px)
    if inliers.sum() < min_points:
        raise NoConsensus(
            f"{int(matched.sum())} points found of {len(points)} tried, but only {int(inliers.sum())} "
            f"agree within {tolerance_px:.1f} px, {min_points} needed: check that the points show the "
            "ground of the scene, or state a larger sigma_m when the model may be further off"
        )
    return inliers


def _point_sigma_px(model: SensorModel, points: ControlPoints, matches: PointMatches) -> Array:
    """Standard deviation (k,) of the measures against the points' own positions, pixels."""
    derivative = model.project_derivative(points.lon_lat_h)
    covariance = derivative @ points.covariance_m2 @ derivative.transpose(0, 2, 1)
    return np.asarray(np.sqrt(matches.sigma_px**2 + np.trace(covariance, axis1=1, axis2=2) / 2.0))


def predict(scene: Scene, points: ControlPoints, adjustment: SceneAdjustment) -> Prediction:
    """Where an adjusted scene shows points (n,), and how precisely.

    The uncertainty includes what the residuals show beyond the stated sigmas: a point still to be found
    may be as far off as the points found.
    """
    model = CorrectedModel(scene.model, adjustment.correction)
    line_sample = model.project(points.lon_lat_h)
    variance = np.diagonal(adjustment.covariance_at(line_sample), axis1=1, axis2=2)
    std_px = np.sqrt(variance.max(axis=1))
    residual_px = float(np.sqrt(np.mean(adjustment.residual_px[adjustment.active] ** 2)))
    gsd_m = image_gsds_m(model, points.lon_lat_h)
    uncertainty_m = np.nan_to_num(np.hypot(std_px, residual_px) * gsd_m, nan=0.0)
    return Prediction(model, np.asarray(uncertainty_m))


def summarise(
    name: str, gsd_m: float, radius_px: int, matches: PointMatches, inliers: BoolArray
) -> SearchStage:
    """The summary of a search with chips of a ground sampling."""
    displacement_m = matches.displacement_m[inliers]
    rms_m = float(np.sqrt((displacement_m**2).sum(axis=1).mean())) if len(displacement_m) else math.nan
    return SearchStage(
        name=name,
        chip_gsd_m=gsd_m,
        search_radius_m=radius_px * gsd_m,
        tried=len(matches.reason),
        matched=int((matches.reason == "").sum()),
        inliers=int(inliers.sum()),
        displacement_rms_m=rms_m,
    )


def format_reasons(reason: np.ndarray) -> str:
    """Numbers of points that were not found, by reason: "22 low_score, 16 nodata"."""
    counted = Counter(str(r) for r in reason if r)
    return ", ".join(f"{count} {name}" for name, count in counted.most_common()) or "none rejected"


def format_consensus(
    matches: PointMatches, consensus: Consensus, gsd_m: float, radius_px: int, noun: str
) -> str:
    """The numbers of a first search whose matches do not agree, for a message.

    Args:
        matches: of the search.
        consensus: of their displacements.
        gsd_m: ground sampling of the chips that were searched.
        radius_px: search radius.
        noun: what was searched: "points" or "places".
    """
    return (
        f"{len(matches.reason)} {noun} tried within {radius_px * gsd_m:.0f} m, "
        f"{int((matches.reason == '').sum())} found, {int(consensus.inliers.sum())} of them within "
        f"{FIRST_TOLERANCE_PX * gsd_m:g} m of each other (expected by chance: "
        f"{consensus.false_alarms:.2g} such groups); {format_reasons(matches.reason)}; when the model "
        "may be further off, state a larger sigma_m"
    )
