"""The ground sampling of the chips to search with, and the probability that a scene shows them whole."""

import numpy as np
from scipy.special import ndtr

from amers.services.conventions import CHIP_CENTRE
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.registration.context import Prediction
from amers.services.types import Array, BoolArray, ControlPoints

_MAX_CHIP_TO_SCENE = 1.25
"""Chips other than the finest may be this many times coarser than the scene."""
_MIN_VISIBLE_SHARE = 0.8
"""Coarser chips must be visible for at least this share of the points that the finest chips serve."""
_MIN_SIGMA_PX = 1e-3
"""Smallest standard deviation of an expected position; it avoids a division by zero."""


def fine_gsd_m(scene: Scene, points: ControlPoints, prediction: Prediction) -> float:
    """Ground sampling of the chips for the fine searches: the coarsest without loss of detail.

    A larger chip shows more pixels of a coarse scene. Coarser chips must exist, and be shown whole, for
    nearly as many points as the finest chips.

    Args:
        scene: as delivered.
        points: those that may be tried.
        prediction: of these points by the delivered model.
    """

    def visible_count(gsd_m: float) -> float:
        probability = visibility_probability(scene, points, prediction, gsd_m)
        return float(probability[has_chip(points, gsd_m)].sum())

    finest_m, *coarser_m = (float(gsd_m) for gsd_m in np.unique(points.views.gsd_m))
    largest_m = _MAX_CHIP_TO_SCENE * scene_gsd_m(scene)
    min_count = _MIN_VISIBLE_SHARE * visible_count(finest_m)
    usable_m = [gsd_m for gsd_m in coarser_m if gsd_m <= largest_m and visible_count(gsd_m) >= min_count]
    return max([finest_m, *usable_m])


def visibility_probability(
    scene: Scene,
    points: ControlPoints,
    prediction: Prediction,
    gsd_m: float,
    share: float = 1.0,
    *,
    cut_px: Array | float = 0.0,
) -> Array:
    """Probability (n,) that the scene shows the chips of points, for normal errors of the prediction.

    Args:
        scene: gives the size of the image and the scale of its model.
        points: on the ground.
        prediction: of these points.
        gsd_m: ground sampling of the chips.
        share: of the side of the chips, round their points, that has to be shown.
        cut_px: (2,) lines and samples at each border of the scene that do not count.
    """
    line_sample = prediction.model.project(points.lon_lat_h)
    # Models have no position for ground far away from their image.
    placed = np.flatnonzero(np.isfinite(line_sample).all(axis=1))
    if not len(placed):
        return np.zeros(len(points))
    middle = points.lon_lat_h[placed[len(placed) // 2]][None]
    derivative = np.abs(scene.model.project_derivative(middle)[0, :, :2])
    reach_px = share * CHIP_CENTRE * gsd_m * derivative.sum(axis=1) + cut_px
    sigma_px = np.maximum(prediction.uncertainty_m / scene_gsd_m(scene), _MIN_SIGMA_PX)[:, None]
    last_px = np.array(scene.image.shape) - 1.0 - reach_px
    inside = ndtr((last_px - line_sample) / sigma_px) - ndtr((reach_px - line_sample) / sigma_px)
    return np.asarray(np.nan_to_num(np.maximum(inside, 0.0)).prod(axis=1))


def has_chip(points: ControlPoints, gsd_m: float) -> BoolArray:
    """Points (n,) that have a chip of a ground sampling."""
    count = np.concatenate([[0], np.cumsum(np.isclose(points.views.gsd_m, gsd_m))])
    return np.asarray(count[points.views.start[1:]] > count[points.views.start[:-1]])
