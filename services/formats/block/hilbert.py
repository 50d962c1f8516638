"""Hilbert order: points that are near on the ground are near in the file."""

import numpy as np

from amers.services.types import Array, IntArray

_ORDER = 16


def hilbert_order(lon_lat: Array) -> IntArray:
    """Row numbers (n,) that sort points (n, 2) along a Hilbert curve over their bounding box.

    Source: Warren, Hacker's Delight, section 16.2; two bits of the index per iteration.
    """
    if len(lon_lat) == 0:
        return np.empty(0, dtype=np.int64)
    low = lon_lat.min(axis=0)
    size = np.maximum(lon_lat.max(axis=0) - low, 1e-12)
    cell = ((lon_lat - low) / size * ((1 << _ORDER) - 1)).astype(np.int64)
    return np.argsort(_hilbert_index(cell[:, 0], cell[:, 1]), kind="stable")


def _hilbert_index(x: IntArray, y: IntArray) -> IntArray:
    index = np.zeros(len(x), dtype=np.int64)
    x, y = x.copy(), y.copy()
    for bit in range(_ORDER - 1, -1, -1):
        right, top = (x >> bit) & 1, (y >> bit) & 1
        index += ((3 * right) ^ top) << (2 * bit)
        flip = (top == 0) & (right == 1)
        mask = (1 << _ORDER) - 1
        x, y = np.where(flip, mask - x, x), np.where(flip, mask - y, y)
        x, y = np.where(top == 0, y, x), np.where(top == 0, x, y)
    return index
