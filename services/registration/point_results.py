"""What became of every point that a scene could show: found or not, where, and why not."""

import numpy as np

from services.adjustment.image_correction import SceneAdjustment
from services.imagery.scene import Scene
from services.matching.control_points import PointMatches
from services.sensors.correction import CorrectedModel
from services.types import Array, ControlPoints, IntArray, Measures


def point_results(
    scene: Scene,
    points: ControlPoints,
    rows_of: tuple[IntArray, IntArray],
    matches: PointMatches,
    adjustment: SceneAdjustment,
) -> Measures:
    """One row for every visible point; those that were not tried say so.

    Args:
        scene: as delivered.
        points: control points.
        rows_of: of the points that the scene may show, and of those that were tried; ascending.
        matches: of the points tried.
        adjustment: of the points tried.
    """
    visible, chosen = rows_of
    n = len(visible)
    rows = np.searchsorted(visible, chosen)

    def scattered(values: Array, width: int = 0) -> Array:
        out = np.full((n, width) if width else n, np.nan)
        out[rows] = values
        return out

    derivative = CorrectedModel(scene.model, adjustment.correction).project_derivative(
        points.lon_lat_h[chosen]
    )
    residual_m = np.asarray(
        np.linalg.solve(derivative[:, :, :2], adjustment.residual_px[:, :, None])[:, :, 0], np.float64
    )
    matched = np.zeros(n, dtype=bool)
    matched[rows] = matches.reason == ""
    active = np.zeros(n, dtype=bool)
    active[rows] = adjustment.active
    reason = np.full(n, "not_tried", dtype="<U16")
    reason[rows] = np.where(
        adjustment.active, "", np.where(matches.reason == "", "deactivated", matches.reason)
    )
    views = np.zeros(n, dtype=np.int64)
    views[rows] = matches.views
    by_gradient = np.zeros(n, dtype=bool)
    by_gradient[rows] = matches.by_gradient
    return Measures(
        point_id=points.id[visible],
        lon_lat_h=points.lon_lat_h[visible],
        predicted=scene.model.project(points.lon_lat_h[visible]),
        line_sample=scattered(matches.line_sample, 2),
        sigma_px=scattered(matches.sigma_px),
        score=scattered(matches.score),
        views=views,
        by_gradient=by_gradient,
        residual_px=scattered(adjustment.residual_px, 2),
        residual_m=scattered(residual_m, 2),
        matched=matched,
        active=active,
        reason=reason,
    )
