"""Selection of image pairs to match, by their common ground and viewing directions."""

from collections.abc import Sequence

import numpy as np
import shapely

from amers.services.geodesy import ecef_from_east_north_up
from amers.services.imagery.scene import Scene, scene_centre, scene_footprint
from amers.services.matching.predict import rank_in_group
from amers.services.types import Array, BoolArray, IntArray

PARTNERS = 8
"""Images that every image is matched with, when as many overlap it."""
_MIN_OVERLAP = 0.02
"""Smallest overlap of a pair, relative to the smaller of the two."""
_ALIKE_DEG = 25.0
"""Angle between two views at which half as many details look alike."""


def image_pairs(scenes: Sequence[Scene], passes: Sequence[BoolArray]) -> IntArray:
    """The pairs of images to match, (k, 2), the smaller row first, in ascending order.

    Every image has up to eight partners of its own choice: the best of every pass, then the second best
    of every pass, and so on, so that the passes are tied to each other. Those that overlap most and look
    in similar directions are the best.

    Args:
        scenes: the images.
        passes: masks (n,) of images of one pass.
    """
    outlines, directions = _grounds(scenes)
    tree = shapely.STRtree(outlines)
    one, other = tree.query(outlines, predicate="intersects")
    one, other = one[one != other], other[one != other]
    share = shapely.area(shapely.intersection(outlines[one], outlines[other])) / np.minimum(
        shapely.area(outlines[one]), shapely.area(outlines[other])
    )
    enough = share >= _MIN_OVERLAP
    one, other, share = one[enough], other[enough], share[enough]
    cosine = np.clip((directions[one] * directions[other]).sum(axis=1), -1.0, 1.0)
    angle_deg = np.degrees(np.arccos(cosine))
    merit = share * 0.5 ** (angle_deg / _ALIKE_DEG)
    of_pass = np.arange(len(scenes))
    for number, members in enumerate(passes):
        of_pass[members] = len(scenes) + number
    rank_in_pass = rank_in_group(one * (2 * len(scenes)) + of_pass[other], merit)
    chosen = rank_in_group(one, merit - 2.0 * rank_in_pass) < PARTNERS
    pairs = np.sort(np.column_stack([one[chosen], other[chosen]]), axis=1)
    return np.unique(pairs, axis=0).astype(np.int64)


def _grounds(scenes: Sequence[Scene]) -> tuple[Array, Array]:
    """Outlines (n,) of the ground with continuous longitudes, and directions (n, 3) of sight."""
    outlines = [scene_footprint(scene) for scene in scenes]
    reference = outlines[0][0, 0]
    for outline in outlines:
        outline[:, 0] -= 360.0 * np.round((outline[:, 0].mean() - reference) / 360.0)
    directions = []
    for scene in scenes:
        centre = (np.array(scene.image.shape, dtype=np.float64) - 1.0) / 2.0
        _, sight = scene.model.line_of_sight(centre[None, :])
        directions.append(sight[0] @ ecef_from_east_north_up(scene_centre(scene)))
    return np.array([shapely.Polygon(outline) for outline in outlines]), np.array(directions)
