"""Filling of the gaps of a surface from the surrounding heights.

Source of the rule: Hirschmüller (2008), Stereo processing by semiglobal matching and mutual information:
what is hidden lies behind what hides it, so that of the heights in eight directions the second lowest is
taken, not the mean.
"""

import numpy as np
from numba import njit

from amers.services.types import FloatImage

_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
_AROUND = 5
"""Directions of the eight in which a height has to be found: gaps are filled, borders are not moved."""


@njit(cache=True)
def filled_gaps(height_m: FloatImage, sigma_m: FloatImage, reach: int) -> tuple[FloatImage, FloatImage]:
    """Heights and sigmas with gaps filled by the second lowest of the heights in eight directions.

    The sigma of a filled cell has half the range of these heights added.

    Args:
        height_m: (lines, samples); NaN in gaps.
        sigma_m: (lines, samples) one standard deviation of them.
        reach: largest distance of a height from a cell that is filled, cells.
    """
    lines, samples = height_m.shape
    heights, sigmas = height_m.copy(), sigma_m.copy()
    found, at = np.empty(8), np.empty((8, 2), dtype=np.int64)
    for i in range(lines):
        for j in range(samples):
            if np.isfinite(height_m[i, j]):
                continue
            count = 0
            for down, right in _DIRECTIONS:
                for step in range(1, reach + 1):
                    k, m = i + step * down, j + step * right
                    if not (0 <= k < lines and 0 <= m < samples):
                        break
                    if np.isfinite(height_m[k, m]):
                        found[count] = height_m[k, m]
                        at[count, 0], at[count, 1] = k, m
                        count += 1
                        break
            if count < _AROUND:
                continue
            order = np.argsort(found[:count])
            taken = order[1]
            half_range = (found[order[count - 1]] - found[order[0]]) / 2.0
            own = sigma_m[at[taken, 0], at[taken, 1]]
            heights[i, j] = found[taken]
            sigmas[i, j] = np.sqrt(own * own + half_range * half_range)
    return heights, sigmas
