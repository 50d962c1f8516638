"""Selection of predicted positions: inside an image, and well distributed."""

import numpy as np

from amers.services.types import Array, BoolArray, IntArray


def in_image(line_sample: Array, shape: tuple[int, int], margin_px: Array | float) -> BoolArray:
    """Which positions (n, 2) lie in an image enlarged by a margin; NaN positions do not.

    Args:
        line_sample: (n, 2) pixels.
        shape: lines and samples of the image.
        margin_px: of all positions, or (n,) of each; pixels.
    """
    size = np.array(shape)
    margin = np.broadcast_to(margin_px, (len(line_sample),))[:, None]
    return np.asarray(
        ((line_sample >= -0.5 - margin) & (line_sample <= size - 0.5 + margin)).all(axis=1)
    )


def spread_over_image(
    line_sample: Array,
    height_m: Array,
    preference: Array,
    shape: tuple[int, int],
    count: int,
) -> IntArray:
    """Rows of well-distributed points, the best of every part of the image first.

    The image is divided into about `count` / 2 square cells. The best point of every cell comes first,
    then the second best of every cell, and so on. Within a cell low, middle and high ground alternate.

    Args:
        line_sample: (n, 2) positions.
        height_m: (n,) of the ground.
        preference: (n,) larger is better.
        shape: lines and samples of the image.
        count: largest number of points selected.

    Returns:
        (m,) rows, in order of selection.
    """
    if len(line_sample) <= count:
        return np.argsort(-preference, kind="stable")
    side = np.sqrt(shape[0] * shape[1] / max(1.0, count / 2.0))
    cell = np.floor(line_sample / side).astype(np.int64)
    key = cell[:, 0] * 1_000_003 + cell[:, 1]
    third = np.searchsorted(np.quantile(height_m, [1 / 3, 2 / 3]), height_m)
    rank_in_third = rank_in_group(key * 3 + third, preference)
    # The best of every third of the heights comes before the second best of any.
    order = np.lexsort((-preference, rank_in_third))
    rank = np.empty(len(order))
    rank[order] = np.arange(len(order))
    return np.lexsort((-preference, rank_in_group(key, -rank)))[:count]


def rank_in_group(group: IntArray, preference: Array) -> IntArray:
    """Rank (n,) of every member within its group, from 0 for the largest preference."""
    order = np.lexsort((-preference, group))
    first = np.concatenate([[True], group[order][1:] != group[order][:-1]])
    start = np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - start
    return rank
