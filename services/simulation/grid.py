"""Bilinear interpolation in a grid that repeats in both directions."""

import numpy as np
from numba import njit

from amers.services.types import Array, FloatImage


@njit(cache=True)
def bilinear(grid: FloatImage, x: float, y: float) -> float:
    """Bilinear value at column x and row y."""
    rows, columns = grid.shape
    x0 = int(np.floor(x))
    y0 = int(np.floor(y))
    fx = x - x0
    fy = y - y0
    if x0 < 0 or x0 >= columns:
        x0 %= columns
    if y0 < 0 or y0 >= rows:
        y0 %= rows
    x1 = x0 + 1 if x0 + 1 < columns else 0
    y1 = y0 + 1 if y0 + 1 < rows else 0
    top = grid[y0, x0] + fx * (np.float64(grid[y0, x1]) - grid[y0, x0])
    bottom = grid[y1, x0] + fx * (np.float64(grid[y1, x1]) - grid[y1, x0])
    return float(top + fy * (bottom - top))


@njit(cache=True)
def bilinear_values(grid: FloatImage, column_row: Array) -> Array:
    """Bilinear values (n,) at positions (n, 2), column first."""
    out = np.empty(len(column_row))
    for i in range(len(column_row)):
        out[i] = bilinear(grid, column_row[i, 0], column_row[i, 1])
    return out
