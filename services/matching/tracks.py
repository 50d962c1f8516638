"""Tracks: tie points over any number of images, from the matches of pairs."""

from collections.abc import Sequence

import numba
import numpy as np

from amers.services.matching.tie_points import Matches
from amers.services.types import Array, BoolArray, IntArray


def tracks(image: IntArray, links: Sequence[tuple[int, int, Matches]], start: IntArray) -> IntArray:
    """The tie point of every feature: a detail that each image shows at most once.

    Matches are joined from the most alike on. One that would give a tie point two features of an image
    is left out: something is wrong there, and a few wrong matches must not run all tie points together.

    Args:
        image: (f,) image of every feature of all images, one image after the other.
        links: two images and their matches.
        start: (n,) first feature of every image.

    Returns:
        (f,) number of the tie point, in the order of the first features; -1 without a match.
    """
    rows = np.concatenate(
        [m.rows + [start[i], start[j]] for i, j, m in links] or [np.empty((0, 2), int)]
    )
    similarity = np.concatenate([m.similarity for _, _, m in links] or [np.empty(0)])
    order = np.argsort(-similarity, kind="stable")
    root = _joined(image, rows[order])
    size = np.bincount(root, minlength=len(root))
    matched = size[root] > 1
    point = np.full(len(root), -1, dtype=np.int64)
    point[matched] = np.unique(root[matched], return_inverse=True)[1]
    return point


@numba.njit(cache=True)
def _joined(image: IntArray, pairs: IntArray) -> IntArray:
    """The first feature (f,) of every feature's component; no component has an image twice."""
    n = len(image)
    root, following, last = np.arange(n), np.full(n, -1), np.arange(n)
    for k in range(len(pairs)):
        one, other = root[pairs[k, 0]], root[pairs[k, 1]]
        if one == other:
            continue
        if other < one:
            one, other = other, one
        clash = False
        i = one
        while i >= 0 and not clash:
            j = other
            while j >= 0 and not clash:
                clash = image[i] == image[j]
                j = following[j]
            i = following[i]
        if clash:
            continue
        j = other
        while j >= 0:
            root[j] = one
            j = following[j]
        following[last[one]] = other
        last[one] = last[other]
    return root


def spread_tracks(point: IntArray, image: IntArray, cell: IntArray, per_cell: int) -> BoolArray:
    """Which features to keep, so that tie points spread evenly over all images; whole tie points.

    The longest tie points are taken first. One is left out when every cell that it is in has enough.

    Args:
        point: (m,) ascending, tie point of every feature.
        image: (m,) image of every feature.
        cell: (m,) cell of the image that the feature lies in, from 0.
        per_cell: tie points of a cell that are enough.
    """
    if len(point) == 0:
        return np.zeros(0, dtype=np.bool_)
    first = np.flatnonzero(np.concatenate([[True], point[1:] != point[:-1]]))
    length = np.diff(np.append(first, len(point)))
    key = np.unique(image * (int(cell.max()) + 1) + cell, return_inverse=True)[1].astype(np.int64)
    order = np.argsort(-length, kind="stable")
    kept = _fill_cells(first[order], length[order], key, per_cell)
    of_track = np.zeros(len(first), dtype=np.bool_)
    of_track[order] = kept
    return np.repeat(of_track, length)


@numba.njit(cache=True)
def _fill_cells(first: IntArray, length: IntArray, cell: IntArray, per_cell: int) -> BoolArray:
    """Which tracks find room in one of their cells, in the order given."""
    count = np.zeros(cell.max() + 1, dtype=np.int64)
    kept = np.zeros(len(first), dtype=np.bool_)
    for t in range(len(first)):
        members = cell[first[t] : first[t] + length[t]]
        if (count[members] < per_cell).any():
            kept[t] = True
            for member in members:
                count[member] += 1
    return kept


def image_cells(line_sample: Array, shape: tuple[int, int], cells_a_side: int) -> IntArray:
    """Number (m,) of the cell of an image that positions (m, 2) lie in."""
    row_column = np.floor((line_sample + 0.5) / np.array(shape) * cells_a_side).astype(np.int64)
    row, column = np.clip(row_column, 0, cells_a_side - 1).T
    return np.asarray(row * cells_a_side + column)
