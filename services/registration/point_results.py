"""Results of the points that a scene could show: position and residual, or a reason."""

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.registration.search import Search
from amers.services.sensors.correction import CorrectedModel
from amers.services.types import Array, ControlPoints, Measures


def point_results(
    scene: Scene, points: ControlPoints, search: Search, adjustment: SceneAdjustment
) -> Measures:
    """One row for every visible point; the reason of a point that was not searched is "not_tried".

    Args:
        scene: as delivered.
        points: all n points that the scene may show.
        search: the last search of a part of them.
        adjustment: on this search.
    """
    n, rows, matches = len(points), search.rows, search.matches

    def scattered(values: Array, width: int = 0) -> Array:
        out = np.full((n, width) if width else n, np.nan)
        out[rows] = values
        return out

    model = CorrectedModel(scene.model, adjustment.correction)
    derivative = model.project_derivative(search.points.lon_lat_h)
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
        point_id=points.id,
        lon_lat_h=points.lon_lat_h,
        predicted=scene.model.project(points.lon_lat_h),
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
