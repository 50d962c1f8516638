"""Where points should be in a scene, which of them to try, and with which of their views."""

import numpy as np

from services.types import Array, BoolArray, ControlPoints, IntArray


def inside(line_sample: Array, shape: tuple[int, int], margin_px: Array | float = 0.0) -> BoolArray:
    """Which positions (n, 2) lie in an image grown by a margin; NaN positions do not."""
    size = np.array(shape)
    margin = np.broadcast_to(margin_px, (len(line_sample),))[:, None]
    return np.asarray(
        ((line_sample >= -0.5 - margin) & (line_sample <= size - 0.5 + margin)).all(axis=1)
    )


def spread_over_image(
    line_sample: Array, preference: Array, shape: tuple[int, int], count: int
) -> IntArray:
    """A well-distributed choice of points.

    The image is cut into about `count` / 2 square cells; the best point of every cell comes first, then
    the second best of every cell, and so on.

    Args:
        line_sample: (n, 2) positions.
        preference: (n,) larger is better.
        shape: lines and samples of the image.
        count: how many to choose at most.

    Returns:
        Rows of the chosen points, best first.
    """
    if len(line_sample) <= count:
        return np.argsort(-preference, kind="stable")
    side = np.sqrt(shape[0] * shape[1] / max(1.0, count / 2.0))
    cell = np.floor(line_sample / side).astype(np.int64)
    key = cell[:, 0] * 1_000_003 + cell[:, 1]
    return np.lexsort((-preference, rank_in_group(key, preference)))[:count]


def rank_in_group(group: IntArray, preference: Array) -> IntArray:
    """How many members of its own group come before each, the larger preference first: (n,) from 0."""
    order = np.lexsort((-preference, group))
    first = np.concatenate([[True], group[order][1:] != group[order][:-1]])
    start = np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - start
    return rank


def choose_views(
    points: ControlPoints, row: int, gsd_m: float, incidence_deg: float, azimuth_deg: float, count: int
) -> IntArray:
    """The views of one point, at one ground sampling, that look most like the scene.

    Args:
        points: the points.
        row: the point.
        gsd_m: ground sampling of the chips wanted.
        incidence_deg, azimuth_deg: direction from the ground to the scene's sensor.
        count: how many views at most.

    Returns:
        Numbers of the views within the point, nearest direction first.
    """
    views = points.views
    rows = np.arange(views.start[row], views.start[row + 1])
    rows = rows[np.isclose(views.gsd_m[rows], gsd_m)]
    difference = (
        _unit(views.incidence_deg[rows], views.azimuth_deg[rows])
        @ _unit(np.array([incidence_deg]), np.array([azimuth_deg])).T
    )
    nearest = np.argsort(-np.nan_to_num(difference[:, 0], nan=-1.0), kind="stable")
    return np.asarray(rows[nearest[:count]] - views.start[row])


def _unit(incidence_deg: Array, azimuth_deg: Array) -> Array:
    """Unit vectors (n, 3) east, north, up."""
    incidence, azimuth = np.radians(incidence_deg), np.radians(azimuth_deg)
    return np.column_stack(
        [np.sin(incidence) * np.sin(azimuth), np.sin(incidence) * np.cos(azimuth), np.cos(incidence)]
    )
