"""Which points of a scene are tried: those it should show, well spread, the best first."""

import numpy as np

from services.errors import CoverageError
from services.imagery.scene import Scene, scene_gsd_m
from services.matching.chip_extent import MIN_VISIBLE_SIDE
from services.matching.predict import in_image, spread_over_image
from services.registration.chip_selection import chance_of_being_shown
from services.sensors.base import SensorModel
from services.types import Array, ControlPoints, IntArray

WORTH_TRYING = 0.5
"""Where there are more points than are tried, those are left out whose chip the scene shows, as far as
it is needed, with a chance less than this share of the best one's."""


def visible_points(scene: Scene, points: ControlPoints) -> IntArray:
    """Rows of the points that a scene may show, its model being as wrong as it may be; ascending.

    Raises:
        CoverageError: there is none.
    """
    if len(points) == 0:
        raise CoverageError("no control point lies in the footprint of the scene")
    margin_px = 3.0 * scene.sigma_m / scene_gsd_m(scene)
    predicted = scene.model.project(points.lon_lat_h)
    visible = np.flatnonzero(in_image(predicted, scene.image.shape, margin_px))
    if len(visible) == 0:
        raise CoverageError(
            f"none of the {len(points)} control points lies in the scene, "
            f"even with {margin_px:.0f} px of margin for its accuracy of {scene.sigma_m:g} m"
        )
    return visible


def start_uncertainty_m(scene: Scene, points: ControlPoints) -> Array:
    """Standard deviation (n,) of where the delivered model expects the points, metres."""
    return np.asarray(np.sqrt(scene.sigma_m**2 + points.covariance_m2[:, [0, 1], [0, 1]].max(axis=1)))


def points_to_try(
    scene: Scene, model: SensorModel, points: ControlPoints, uncertainty_m: Array, count: int
) -> IntArray:
    """Rows of the points to search, ascending: all, or when they are many the best that should be shown.

    Args:
        scene: for its size.
        model: of the scene, as far as it is known.
        points: that the scene may show.
        uncertainty_m: (n,) standard deviation of where the model expects them.
        count: how many at most; 0 for all.
    """
    count = count or len(points)
    if len(points) <= count:
        return np.arange(len(points))
    predicted = model.project(points.lon_lat_h)
    finest_m = float(points.views.gsd_m.min())
    chance = chance_of_being_shown(scene, points, predicted, finest_m, uncertainty_m, MIN_VISIBLE_SIDE)
    likely = np.flatnonzero(chance >= WORTH_TRYING * chance.max())
    spread_m2 = np.trace(points.covariance_m2, axis1=1, axis2=2)
    preference = points.saliency * points.health
    preference /= 1.0 + spread_m2 / max(float(np.median(spread_m2)), 1e-12)
    best = spread_over_image(
        predicted[likely], points.lon_lat_h[likely, 2], preference[likely], scene.image.shape, count
    )
    return np.sort(likely[best])
