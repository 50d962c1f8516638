"""Which chips a scene is searched with: those it should show whole."""

import numpy as np
from scipy.special import ndtr

from services.conventions import CHIP_CENTRE
from services.imagery.scene import Scene, scene_gsd_m
from services.types import Array, BoolArray, ControlPoints

_CHIPS_TO_SCENE = 1.25
"""How much coarser than the scene chips may be that are not the finest."""
_NEARLY_AS_MANY = 0.8
_SURE_PX = 1e-3
"""A place known better than this is known."""


def fine_gsd_m(scene: Scene, points: ControlPoints, uncertainty_m: Array) -> float:
    """Ground sampling of the chips to measure on: the coarsest that blur nothing the scene shows.

    In larger chips a coarse scene shows more of its pixels. They have to be there, and shown whole, for
    nearly as many points as the finest are.

    Args:
        scene: as delivered.
        points: those to be tried.
        uncertainty_m: (n,) standard deviation of where the model of the scene expects them.
    """
    line_sample = scene.model.project(points.lon_lat_h)

    def shown(gsd_m: float) -> float:
        chance = chance_of_being_shown(scene, points, line_sample, gsd_m, uncertainty_m)
        return float(chance[has_chip(points, gsd_m)].sum())

    finest_m, *coarser_m = (float(gsd_m) for gsd_m in np.unique(points.views.gsd_m))
    largest_m = _CHIPS_TO_SCENE * scene_gsd_m(scene)
    enough = _NEARLY_AS_MANY * shown(finest_m)
    usable_m = [gsd_m for gsd_m in coarser_m if gsd_m <= largest_m and shown(gsd_m) >= enough]
    return max([finest_m, *usable_m])


def chance_of_being_shown(
    scene: Scene,
    points: ControlPoints,
    line_sample: Array,
    gsd_m: float,
    uncertainty_m: Array,
    share: float = 1.0,
) -> Array:
    """Chance (n,) that the scene shows the chips of points, its error being normal.

    Args:
        scene: where it is does not count, only its size.
        points: on the ground.
        line_sample: (n, 2) where they are expected.
        gsd_m: ground sampling of the chips.
        uncertainty_m: (n,) standard deviation of that.
        share: of the side of the chips, round their points, that has to be shown.
    """
    middle = points.lon_lat_h[len(points) // 2 : len(points) // 2 + 1]
    derivative = np.abs(scene.model.project_derivative(middle)[0, :, :2])
    reach_px = share * CHIP_CENTRE * gsd_m * derivative.sum(axis=1)
    sigma_px = np.maximum(uncertainty_m / scene_gsd_m(scene), _SURE_PX)[:, None]
    room_px = np.array(scene.image.shape) - 1.0 - reach_px
    inside = ndtr((room_px - line_sample) / sigma_px) - ndtr((reach_px - line_sample) / sigma_px)
    return np.asarray(np.nan_to_num(np.maximum(inside, 0.0)).prod(axis=1))


def has_chip(points: ControlPoints, gsd_m: float) -> BoolArray:
    """Which points (n,) have a chip of a ground sampling."""
    count = np.concatenate([[0], np.cumsum(np.isclose(points.views.gsd_m, gsd_m))])
    return np.asarray(count[points.views.start[1:]] > count[points.views.start[:-1]])
