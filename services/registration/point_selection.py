"""Selection of the points to search: points that the scene should show, well spread, the best first."""

import numpy as np

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.errors import CoverageError
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.matching.chip_extent import MIN_VISIBLE_SIDE
from amers.services.matching.predict import in_image, spread_over_image
from amers.services.registration.chip_selection import has_chip, visibility_probability
from amers.services.registration.context import Prediction
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.types import Array, ControlPoints, IntArray

MIN_RELATIVE_PROBABILITY = 0.5
"""Points whose probability of being shown is below this fraction of the best point's are tried only
where fewer others exist than are tried."""


def visible_points(scene: Scene, points: ControlPoints) -> IntArray:
    """Rows of the points that a scene may show within the largest error of its model, ascending.

    Raises:
        CoverageError: there is none.
    """
    if len(points) == 0:
        raise CoverageError("no control point lies in the footprint of the scene")
    margin_px = MAX_ERROR_SIGMAS * scene.sigma_m / scene_gsd_m(scene)
    predicted = scene.model.project(points.lon_lat_h)
    visible = np.flatnonzero(in_image(predicted, scene.image.shape, margin_px))
    if len(visible) == 0:
        raise CoverageError(
            f"none of the {len(points)} control points lies in the scene, "
            f"even with {margin_px:.0f} px of margin for its accuracy of {scene.sigma_m:g} m: state a "
            "larger `sigma_m` when the model may be further off"
        )
    return visible


def initial_prediction(scene: Scene, points: ControlPoints) -> Prediction:
    """Where the delivered model expects points (n,), and how precisely."""
    variance_m2 = scene.sigma_m**2 + points.covariance_m2[:, [0, 1], [0, 1]].max(axis=1)
    model = CorrectedModel(scene.model, no_correction(scene.image.shape))
    return Prediction(model, np.asarray(np.sqrt(variance_m2)))


def points_to_try(
    scene: Scene, points: ControlPoints, prediction: Prediction, max_points: int
) -> IntArray:
    """Rows of the points to search, ascending: all points, or the best of them when there are many.

    Args:
        scene: gives the size of the image.
        points: that the scene may show.
        prediction: of these points.
        max_points: largest number of points; 0 for all.
    """
    count = max_points or len(points)
    if len(points) <= count:
        return np.arange(len(points))
    finest_m = float(points.views.gsd_m.min())
    probability = visibility_probability(scene, points, prediction, finest_m, MIN_VISIBLE_SIDE)
    likely = np.flatnonzero(probability >= MIN_RELATIVE_PROBABILITY * probability.max())
    if len(likely) < count:
        return np.sort(np.argsort(-probability, kind="stable")[:count])
    variance_m2 = np.trace(points.covariance_m2, axis1=1, axis2=2)
    preference = points.saliency * points.health
    preference /= 1.0 + variance_m2 / max(float(np.median(variance_m2)), 1e-12)
    predicted = prediction.model.project(points.lon_lat_h)
    best = spread_over_image(
        predicted[likely], points.lon_lat_h[likely, 2], preference[likely], scene.image.shape, count
    )
    return np.sort(likely[best])


def points_expected(
    scene: Scene,
    points: ControlPoints,
    prediction: Prediction,
    gsd_m: float,
    *,
    count: int,
    cut_px: Array | float = 0.0,
) -> IntArray:
    """Rows of well-spread points of which a scene that may be far off is expected to show some whole.

    Args:
        scene: gives the size of the image.
        points: that the scene may show.
        prediction: of these points.
        gsd_m: ground sampling of the chips.
        count: number of points that the scene is expected to show.
        cut_px: (2,) lines and samples at each border of the scene that do not count.
    """
    probability = visibility_probability(scene, points, prediction, gsd_m, cut_px=cut_px)
    probability[~has_chip(points, gsd_m)] = 0.0
    rows = np.flatnonzero(probability > 0.0)
    line_sample = prediction.model.project(points.lon_lat_h[rows])
    preference = (points.saliency * points.health * probability)[rows]
    order = rows[
        spread_over_image(
            line_sample, points.lon_lat_h[rows, 2], preference, scene.image.shape, len(rows)
        )
    ]
    needed = int(np.searchsorted(np.cumsum(probability[order]), count)) + 1
    return np.sort(order[:needed])
