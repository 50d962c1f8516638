"""The outline of an image on the ground."""

import numpy as np

from amers.services.geodesy import continuous
from amers.services.imagery.scene import Scene, image_border
from amers.services.lines_of_sight import intersect_terrain
from amers.services.terrain import Terrain
from amers.services.types import Array


def image_outline(scene: Scene, terrain: Terrain) -> Array:
    """Where the outer edge of an image meets the ground.

    Args:
        scene: the image with its model.
        terrain: the ground; beside it, the edge is taken at the middle of its heights.

    Returns:
        (m, 2) lon, lat in degrees, not closed, in continuous longitudes.
    """
    border = image_border(scene.image.shape)
    middle_m = np.full(len(border), sum(terrain.range_m()) / 2.0)
    edge = scene.model.locate(border, middle_m)[:, :2]
    on_ground = intersect_terrain(scene.model, border, terrain)[:, :2]
    met = np.isfinite(on_ground).all(axis=1)
    edge[met] = on_ground[met]
    return continuous(edge)
