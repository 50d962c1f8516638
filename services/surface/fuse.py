"""Fusion of the surfaces of several pairs: aligned to their median, weighted, with a sigma.

Pairs of one block disagree by decimetres to metres, the more the shorter their base, by errors of their
models along the rows. Each pair is therefore shifted onto the median of all. Source of the shift in
position: Nuth and Kääb (2011), Co-registration and bias corrections of satellite elevation data sets.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from amers.services.types import Array, BoolArray, FloatImage, IntArray

DISPARITY_SIGMA_PX = 0.25
"""Noise of a disparity on flat ground, one standard deviation: 0.24 to 0.29 px for pairs of WorldView-3
images of a town against lidar in one town."""
_SHARED = 0.5
"""Correlation of the noise of two pairs with a common image: half of the noise is of that image."""
_STEEPEST = 1.0
"""Slopes above this, as steps of walls, do not align: a height there is of either side."""
_MAX_MISFIT_M = 2.0
DISTANCE_M, DISTANCES = 0.02, 100
"""Steps of the distances that are counted, up to the largest misfit."""
AROUND_PX = 20
"""Side of the square around a cell whose roughness counts, pixels of the finest image: walls are found
up to ten pixels off. The 90 % intervals hold 0.81 of the heights at 537 points of a block in a town,
0.75 with 13 pixels; chosen there."""
_ROUGHNESS_COUNTS = 1.5
"""How much of the roughness is error: the 90 % intervals of pairs and of fused surfaces hold 0.82 to
0.89 of all heights in a town with it, 0.77 to 0.85 with 1; chosen there."""
_SAME_M = 1.0
"""Heights of pairs that differ by less are of one surface."""
_ENOUGH, _ENOUGH_SHARE = 2, 1.0 / 3.0
"""Pairs that have to agree on a surface, and their share of those that see the place: heights that one
pair of several has are wrong more often than those around them (lidar in one town)."""
Counts = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Fused:
    """A surface made of several pairs.

    Attributes:
        height_m: (lines, samples) above the ellipsoid; NaN where no pair has one.
        sigma_m: (lines, samples) one standard deviation of its noise.
        views: (lines, samples) uint8, number of images that it was found in.
        agree: (lines, samples) uint8, number of pairs that agree on it.
    """

    height_m: FloatImage
    sigma_m: FloatImage
    views: Counts
    agree: Counts


def fuse(heights: FloatImage, sigma_m: Array, pairs: IntArray) -> Fused:
    """The surface of several pairs that are aligned.

    Args:
        heights: (p, lines, samples); NaN where a pair has none.
        sigma_m: (p,) noise of the heights of each pair, one standard deviation.
        pairs: (p, 2) numbers of their images.
    """
    return Fused(*_fused(heights, sigma_m, pairs))


def roughness_m(height_m: FloatImage, side: int) -> FloatImage:
    """Standard deviation (lines, samples) of the heights around a cell from the plane through them.

    Heights next to a wall may be those of its other side, and crowns of trees are blurred: by as much as
    the heights around vary, as lidar of one town shows.

    Args:
        height_m: (lines, samples); NaN where there is none.
        side: of the square around a cell, an odd number of cells.
    """
    known = np.isfinite(height_m)
    level = float(np.mean(height_m[known])) if known.any() else 0.0
    valid = known.astype(np.float32)
    above = np.where(known, height_m - level, 0.0).astype(np.float32)
    axis = np.arange(side, dtype=np.float64) - side // 2
    one = np.ones_like(axis)

    def total(values: FloatImage, along: Array, across: Array) -> FloatImage:
        return np.asarray(cv2.sepFilter2D(values, cv2.CV_32F, along, across))

    count = np.maximum(total(valid, one, one), 1.0)
    mean = total(above, one, one) / count
    variance = total(above * above, one, one) / count - mean * mean
    for along, across in ((axis, one), (one, axis)):
        position = total(valid, along, across) / count
        of_position = total(valid, along * along, across * across) / count - position**2
        product = total(above, along, across) / count - mean * position
        variance -= product**2 / np.maximum(of_position, 1e-6)
    return np.asarray(_ROUGHNESS_COUNTS * np.sqrt(np.maximum(variance, 0.0)))


def noise_of_distances(distances: IntArray) -> Array:
    """Standard deviation (p,) by the median of distances that `alignment_sums` counts; 0 for none."""
    below = np.cumsum(distances, axis=1)
    median = (below < below[:, -1:] / 2.0).sum(axis=1) * DISTANCE_M
    return np.asarray(1.4826 * median)


@njit(cache=True)
def alignment_sums(
    heights: FloatImage, middle: FloatImage, step_m: float
) -> tuple[Array, Array, IntArray]:
    """What tells how pairs lie off a surface on a tile.

    Args:
        heights: (p, lines, samples) of the pairs.
        middle: (lines, samples) the surface.
        step_m: side of a cell.

    Returns:
        Normal equations (p, 3, 3) and (p, 3) of the shifts that bring the pairs onto the surface, and
        numbers (p, 100) of cells by their distance from it, in steps of 2 cm.
    """
    count, lines, samples = heights.shape
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    distances = np.zeros((count, DISTANCES), dtype=np.int64)
    row = np.empty(3)
    for i in range(1, lines - 1):
        for j in range(1, samples - 1):
            east = (middle[i, j + 1] - middle[i, j - 1]) / (2.0 * step_m)
            north = (middle[i - 1, j] - middle[i + 1, j]) / (2.0 * step_m)
            if not (abs(east) < _STEEPEST and abs(north) < _STEEPEST):
                continue
            row[0], row[1], row[2] = -east, -north, 1.0
            for p in range(count):
                misfit = middle[i, j] - heights[p, i, j]
                if not abs(misfit) < _MAX_MISFIT_M:
                    continue
                distances[p, int(abs(misfit) / DISTANCE_M)] += 1
                weight = 1.0 / (1.0 + (misfit / 0.3) ** 2)
                for k in range(3):
                    right[p, k] += weight * row[k] * misfit
                    for m in range(3):
                        normal[p, k, m] += weight * row[k] * row[m]
    return normal, right, distances


@njit(cache=True)
def _fused(
    heights: FloatImage, sigma_m: Array, pairs: IntArray
) -> tuple[FloatImage, FloatImage, Counts, Counts]:
    count, lines, samples = heights.shape
    out = np.full((lines, samples), np.nan, dtype=np.float32)
    sigma = np.full((lines, samples), np.nan, dtype=np.float32)
    views = np.zeros((lines, samples), dtype=np.uint8)
    agree = np.zeros((lines, samples), dtype=np.uint8)
    weight = 1.0 / sigma_m**2
    for i in range(lines):
        for j in range(samples):
            values = heights[:, i, j]
            known = np.isfinite(values)
            if not known.any():
                continue
            used = _agreeing(values, sigma_m, known)
            own = np.where(used, weight, 0.0)
            mean = 0.0
            for p in range(count):
                mean += own[p] * values[p] if used[p] else 0.0
            mean /= own.sum()
            scatter = 0.0
            for p in range(count):
                scatter += own[p] * (values[p] - mean) ** 2 if used[p] else 0.0
            scatter /= own.sum() * max(used.sum() - 1, 1)
            # Pairs that do not agree show another surface: they widen the sigma.
            apart = 1.0 - own.sum() / weight[known].sum()
            out[i, j] = mean
            noise = max(_noise(sigma_m, pairs, used), scatter)
            sigma[i, j] = np.sqrt(noise + apart * (_SAME_M / 2.0) ** 2)
            views[i, j] = _number_of_images(pairs, used)
            agree[i, j] = used.sum()
    return out, sigma, views, agree


@njit(cache=True)
def _agreeing(values: FloatImage, sigma_m: Array, known: BoolArray) -> BoolArray:
    """The pairs of the lowest surface that enough pairs agree on; one pair, the best, where none do.

    Of two surfaces that pairs see, the lower one is the ground: matches of edges of roofs and trees
    reach over the ground beside them, hidden ground never reaches over a roof.
    """
    enough = max(_ENOUGH, int(np.ceil(known.sum() * _ENOUGH_SHARE)))
    best = -1
    for p in np.argsort(values):  # unknown ones, which are NaN, come last
        if not known[p]:
            break
        apart = values - values[p]
        noise_m = np.maximum(sigma_m, sigma_m[p])
        used = known & (np.abs(apart) <= np.minimum(np.maximum(_SAME_M, 3.0 * noise_m), _MAX_MISFIT_M))
        if used.sum() >= enough:
            return used
        if best < 0 or sigma_m[p] < sigma_m[best]:
            best = p
    alone = np.zeros(len(values), dtype=np.bool_)
    alone[best] = True
    return alone


@njit(cache=True)
def _noise(sigma_m: Array, pairs: IntArray, used: BoolArray) -> float:
    """Variance of the weighted mean of pairs, some of which share an image."""
    total, weight = 0.0, 0.0
    for p in np.flatnonzero(used):
        weight += sigma_m[p] ** -2.0
        for q in np.flatnonzero(used):
            shared = pairs[p, 0] in pairs[q] or pairs[p, 1] in pairs[q]
            correlation = 1.0 if p == q else (_SHARED if shared else 0.0)
            total += correlation / (sigma_m[p] * sigma_m[q])
    return float(total / weight**2)


@njit(cache=True)
def _number_of_images(pairs: IntArray, used: BoolArray) -> int:
    return len(np.unique(pairs[used].copy().ravel()))
