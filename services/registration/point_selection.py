"""Selection of the points to search: points that the scene should show, well spread, the best first."""

import numpy as np

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.errors import CoverageError, OtherGround
from amers.services.geodesy import ecef_from_lon_lat_h
from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m
from amers.services.matching.chip_extent import MIN_VISIBLE_SIDE
from amers.services.matching.predict import in_image, spread_over_image
from amers.services.registration.chip_selection import has_chip, visibility_probability
from amers.services.registration.context import Prediction
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.types import Array, ControlPoints, IntArray

MIN_RELATIVE_PROBABILITY = 0.5
"""Points whose probability of being shown is below this fraction of the best point's are tried only
where fewer others exist than are tried."""


_OTHER_GROUND_M = 5000.0
"""Distance from a scene, beyond half its diagonal, from which on points are those of other ground:
errors of models up to it are searched."""


def visible_points(scene: Scene, points: ControlPoints) -> IntArray:
    """Rows of the points that a scene may show within the largest error of its model, ascending.

    Raises:
        CoverageError: there is none.
        OtherGround: they lie farther away than any error of a model that is searched.
    """
    if len(points) == 0:
        raise CoverageError("no control point lies in the footprint of the scene")
    margin_px = MAX_ERROR_SIGMAS * scene.sigma_m / scene_gsd_m(scene)
    predicted = scene.model.project(points.lon_lat_h)
    visible = np.flatnonzero(in_image(predicted, scene.image.shape, margin_px))
    if len(visible) == 0:
        raise _none_visible(scene, points)
    return visible


def _none_visible(scene: Scene, points: ControlPoints) -> CoverageError:
    """Why a scene shows no point: how far the nearest lies, and what that means."""
    centre = scene_centre(scene)
    places = ecef_from_lon_lat_h(np.vstack([centre, points.lon_lat_h]))
    # Through the Earth: within 1 % up to 3,000 km.
    away_m = np.linalg.norm(places[1:] - places[0], axis=1)
    beyond_m = float(away_m.min()) - np.hypot(*scene.image.shape) * scene_gsd_m(scene) / 2.0
    none = f"none of the {len(points)} control points lies in the scene"
    if beyond_m <= _OTHER_GROUND_M:
        return CoverageError(
            f"{none}, whose model is taken to be accurate to {scene.sigma_m:g} m: the nearest is "
            f"{away_m.min():.0f} m from its middle; state a larger `sigma_m` when the model may be "
            "further off"
        )
    lon, lat = points.lon_lat_h[int(np.argmin(away_m)), :2].tolist()
    return OtherGround(
        f"{none}: the scene lies at {_degrees(*centre[:2].tolist())}, the nearest point at "
        f"{_degrees(lon, lat)}, {away_m.min() / 1000.0:,.0f} km away; give points of its ground, or the "
        "model of this image"
    )


def _degrees(lon: float, lat: float) -> str:
    """A position as people write it."""
    north, east = "N" if lat >= 0.0 else "S", "E" if lon >= 0.0 else "W"
    return f"{abs(lat):.2f} {north}, {abs(lon):.2f} {east}"


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
    """Rows of the best points of which a scene that may be far off is expected to show some whole.

    The best are salient, healthy and likely to be shown, all three together.

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
    preference = (points.saliency * points.health * probability)[rows]
    order = rows[np.argsort(-preference, kind="stable")]
    needed = int(np.searchsorted(np.cumsum(probability[order]), count)) + 1
    return np.sort(order[:needed])
