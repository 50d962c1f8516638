"""Semi-global matching of two rectified images on census costs, in both directions.

Source: Hirschmüller (2008), Stereo processing by semiglobal matching and mutual information; for census
costs, Zabih and Woodfill (1994).
"""

import numpy as np
import numpy.typing as npt
from numba import njit

from amers.services.types import BoolArray, FloatImage

Costs = npt.NDArray[np.uint8]
Sums = npt.NDArray[np.uint16]
_UNKNOWN = 12
"""Cost of a disparity at which one image shows nothing: half of the 24 comparisons of a census."""
_FAR = 30_000
"""Larger than any sum of costs along a path."""
_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


def disparity_sums(costs: Costs, steps: FloatImage, penalties: tuple[int, int, float]) -> Sums:
    """Costs summed along eight paths towards every pixel.

    Args:
        costs: (rows, columns, disparities) of the reference image.
        steps: (rows, columns) grey values of the reference image, in units of its contrast.
        penalties: of a change of disparity by one, of a larger one, and the grey step that halves the
            second one; infinite for the same everywhere.
    """
    sums = np.zeros(costs.shape, dtype=np.uint16)
    for down, right in _DIRECTIONS:
        _add_paths(costs, sums, steps, (down, right), penalties)
    return sums


@njit(cache=True)
def census(pixels: FloatImage) -> npt.NDArray[np.uint32]:
    """Which of the 24 pixels around each one (rows, columns) are darker, as bits."""
    rows, columns = pixels.shape
    out = np.zeros(pixels.shape, dtype=np.uint32)
    for i in range(rows):
        for j in range(columns):
            word = np.uint32(0)
            centre = pixels[i, j]
            for k in range(-2, 3):
                for m in range(-2, 3):
                    if k == 0 and m == 0:
                        continue
                    r = min(max(i + k, 0), rows - 1)
                    c = min(max(j + m, 0), columns - 1)
                    word = np.uint32((word << np.uint32(1)) | np.uint32(pixels[r, c] < centre))
            out[i, j] = word
    return out


@njit(cache=True)
def matching_costs(
    first: npt.NDArray[np.uint32],
    second: npt.NDArray[np.uint32],
    valid: tuple[BoolArray, BoolArray],
    lowest: int,
    count: int,
) -> Costs:
    """Number of comparisons that differ at each disparity, (rows, columns, count).

    Args:
        first, second: census of the images.
        valid: their valid pixels.
        lowest: first disparity.
        count: of disparities.
    """
    rows, columns = first.shape
    out = np.empty((rows, columns, count), dtype=np.uint8)
    one, two, four = np.uint32(0x55555555), np.uint32(0x33333333), np.uint32(0x0F0F0F0F)
    for i in range(rows):
        for j in range(columns):
            cell = out[i, j]
            if not valid[0][i, j]:
                cell[:] = _UNKNOWN
                continue
            word = first[i, j]
            for d in range(count):
                at = j - lowest - d
                if at < 0 or at >= columns or not valid[1][i, at]:
                    cell[d] = _UNKNOWN
                    continue
                x = np.uint32(word ^ second[i, at])
                x = np.uint32(x - ((x >> np.uint32(1)) & one))
                x = np.uint32((x & two) + ((x >> np.uint32(2)) & two))
                x = np.uint32((x + (x >> np.uint32(4))) & four)
                cell[d] = np.uint8(np.uint32(x * np.uint32(0x01010101)) >> np.uint32(24))
    return out


@njit(cache=True)
def costs_of_second(costs: Costs, lowest: int) -> Costs:
    """The same costs by the pixels of the second image, whose disparities are those of their matches."""
    rows, columns, count = costs.shape
    out = np.full(costs.shape, _UNKNOWN, dtype=np.uint8)
    for i in range(rows):
        for j in range(columns):
            for d in range(count):
                at = j - lowest - d
                if 0 <= at < columns:
                    out[i, at, d] = costs[i, j, d]
    return out


@njit(cache=True)
def _add_paths(
    costs: Costs,
    sums: Sums,
    steps: FloatImage,
    direction: tuple[int, int],
    penalties: tuple[int, int, float],
) -> None:
    """Add the costs along the paths of one direction, down and right, to the sums."""
    down, right = direction
    small, large, halving = penalties
    rows, columns, count = costs.shape
    far, first_penalty = np.uint16(_FAR), np.uint16(small)
    before = np.zeros((columns + 2, count + 2), dtype=np.uint16)
    line = np.zeros((columns + 2, count + 2), dtype=np.uint16)
    for border in (0, count + 1):
        before[:, border] = far
        line[:, border] = far
    least_before = np.zeros(columns + 2, dtype=np.uint16)
    least = np.zeros(columns + 2, dtype=np.uint16)
    for r in range(rows):
        i = r if down >= 0 else rows - 1 - r
        for c in range(columns):
            j = c if right >= 0 else columns - 1 - c
            source = before if down else line
            k = j + 1 - right
            minimum = least_before[k] if down else least[k]
            p, q = i - down, j - right
            penalty = float(large)
            if 0 <= p < rows and 0 <= q < columns:
                penalty = max(large / (1.0 + abs(steps[i, j] - steps[p, q]) / halving), small + 1.0)
            jump = np.uint16(minimum + np.uint16(penalty))
            own, here, total, cost = source[k], line[j + 1], sums[i, j], costs[i, j]
            smallest = far
            for d in range(count):
                best = own[d + 1]
                nearer = np.uint16(own[d] + first_penalty)
                farther = np.uint16(own[d + 2] + first_penalty)
                best = nearer if nearer < best else best
                best = farther if farther < best else best
                best = jump if jump < best else best
                best = np.uint16(np.uint16(best - minimum) + cost[d])
                here[d + 1] = best
                smallest = best if best < smallest else smallest
                total[d] = np.uint16(total[d] + best)
            least[j + 1] = smallest
        if down:
            before, line = line, before
            least_before, least = least, least_before


@njit(cache=True)
def best_disparities(sums: Sums, lowest: int) -> FloatImage:
    """Disparity (rows, columns) of the least sum, NaN at the limits; between steps see `_fraction`."""
    rows, columns, count = sums.shape
    out = np.full((rows, columns), np.nan, dtype=np.float32)
    for i in range(rows):
        for j in range(columns):
            total = sums[i, j]
            best, least = 0, total[0]
            for d in range(1, count):
                if total[d] < least:
                    best, least = d, total[d]
            if 0 < best < count - 1:
                left, right = float(total[best - 1]), float(total[best + 1])
                out[i, j] = lowest + best + _fraction(left - float(least), right - float(least))
    return out


@njit(cache=True)
def _fraction(left: float, right: float) -> float:
    """Where the least cost lies between steps, by how much it rises to the left and to the right.

    A parabola draws fractions towards whole steps, two lines of equal slope towards halves; their mean
    spreads the disparities evenly, as seen on pairs of WorldView-3 and of Pléiades.
    """
    if left + right <= 0.0:
        return 0.0
    parabola = 0.5 * (left - right) / (left + right)
    lines = 0.5 * (left - right) / max(left, right)
    return (parabola + lines) / 2.0


@njit(cache=True)
def differences(first: FloatImage, second: FloatImage) -> FloatImage:
    """Difference (rows, columns) of the disparities of one detail in both directions; NaN for none.

    Args:
        first: disparities by the pixels of the first image.
        second: by those of the second one.
    """
    rows, columns = first.shape
    out = np.full((rows, columns), np.nan, dtype=np.float32)
    for i in range(rows):
        for j in range(columns):
            d = first[i, j]
            if not np.isfinite(d):
                continue
            at = j - d
            k = int(np.floor(at))
            if k < 0 or k + 1 >= columns:
                continue
            left, right = second[i, k], second[i, k + 1]
            t = at - k
            if not np.isfinite(left) or not np.isfinite(right) or abs(left - right) > 1.0:
                nearest = left if t < 0.5 else right
                out[i, j] = abs(d - nearest)
            else:
                out[i, j] = abs(d - (left + t * (right - left)))
    return out
