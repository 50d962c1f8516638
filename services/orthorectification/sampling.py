"""Interpolation of an image at given positions, one window of the result at a time."""

import numpy as np
from numba import njit

from amers.services.imagery.gaps import LOST_SHARE
from amers.services.imagery.source import ImageSource, Window, block_means, low_pass
from amers.services.types import Array, FloatImage, IntArray

_KERNEL_REACH_PX = 3


def sampled(
    image: ImageSource,
    line_sample: Array,
    first: IntArray,
    size: IntArray,
    *,
    ratio: float = 1.0,
    cubic: bool = True,
) -> FloatImage:
    """Values (lines, samples) of an image at positions (lines, samples, 2).

    Args:
        image: one band.
        line_sample: positions; NaN where there is no value.
        first, size: (2,) of the window of the image that contains the positions, pixels.
        ratio: image pixels per position along a side: the image is low-passed to as many.
        cubic: whether the kernel is cubic (convolution, a = -0.5), or bilinear.

    Returns:
        float32; NaN where there is no data, +inf where the image is saturated.
    """
    factor = max(1, int(ratio / 2.0))
    margin = _KERNEL_REACH_PX * factor + int(2.0 * ratio)
    begin = first - margin
    lines, samples = (int(count) for count in size + 2 * margin)
    # The kernels extend the image by the pixels of its border. Squares begin at multiples of the factor
    # in every window, so that the image does not depend on its windows.
    low = np.clip(begin, 0, np.array(image.shape) - 1) // factor * factor
    high = np.clip(begin + [lines, samples], 1, np.array(image.shape))
    whole = (high - low) // factor * factor
    whole = np.where(whole == 0, high - low, whole) if factor > 1 else high - low
    pixels = image.read(Window(int(low[0]), int(low[1]), int(whole[0]), int(whole[1])))
    factor = factor if min(pixels.shape) >= factor else 1
    pixels = np.ascontiguousarray(low_pass(block_means(pixels, factor), ratio / factor))
    origin = (float(low[0]), float(low[1]))
    return _resampled(pixels, line_sample, origin, factor, cubic)


@njit(cache=True)
def drop_outside(line_sample: Array, lines: int, samples: int) -> tuple[Array, Array]:
    """Set positions (lines, samples, 2) outside an image to NaN.

    Returns:
        The lowest and highest (2,) of the others; inf and -inf where there are none.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for r in range(line_sample.shape[0]):
        for s in range(line_sample.shape[1]):
            line, sample = line_sample[r, s, 0], line_sample[r, s, 1]
            if -0.5 <= line <= lines - 0.5 and -0.5 <= sample <= samples - 0.5:
                low[0], high[0] = min(low[0], line), max(high[0], line)
                low[1], high[1] = min(low[1], sample), max(high[1], sample)
            else:
                line_sample[r, s] = np.nan
    return low, high


@njit(inline="always", error_model="numpy")
def _cubic_weights(t: float) -> tuple[float, float, float, float]:
    """Cubic convolution, a = -0.5 (Keys, 1981)."""
    return (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )


@njit(inline="always", error_model="numpy")
def _weighted(pixels: FloatImage, i: int, j: int, weights: tuple[float, float, float, float]) -> float:
    """Weighted sum of the four pixels of row `i` around column `j`."""
    v0, v1, v2, v3 = weights
    return v0 * pixels[i, j - 1] + v1 * pixels[i, j] + v2 * pixels[i, j + 1] + v3 * pixels[i, j + 2]


@njit(inline="always", error_model="numpy")
def _bilinear(pixels: FloatImage, line: float, sample: float) -> float:
    """Bilinear value; a missing pixel with zero weight does not count."""
    lines, samples = pixels.shape
    i, j = int(line), int(sample)
    fi, fj = line - i, sample - j
    i1 = min(i + 1, lines - 1) if fi > 0.0 else i
    j1 = min(j + 1, samples - 1) if fj > 0.0 else j
    top = pixels[i, j] + fj * (pixels[i, j1] - pixels[i, j])
    bottom = pixels[i1, j] + fj * (pixels[i1, j1] - pixels[i1, j])
    return top + fi * (bottom - top)


@njit(cache=True, error_model="numpy")
def _resampled(
    pixels: FloatImage,
    line_sample: Array,
    origin: tuple[float, float],
    factor: int,
    cubic: bool,
) -> FloatImage:
    """Values (lines, samples) at positions of the image; bilinear beside lost pixels.

    Args:
        pixels: means over squares of `factor` pixels of the image.
        line_sample: (lines, samples, 2) positions in the image.
        origin: line and sample in the image of the first pixel averaged.
        factor: image pixels per pixel.
        cubic: whether the kernel is cubic.
    """
    lines, samples = pixels.shape
    rows, columns, _ = line_sample.shape
    out = np.empty((rows, columns), dtype=np.float32)
    centre = (factor - 1) / 2.0
    for r in range(rows):
        for s in range(columns):
            line = (line_sample[r, s, 0] - origin[0] - centre) / factor
            sample = (line_sample[r, s, 1] - origin[1] - centre) / factor
            if not (line == line and sample == sample):
                out[r, s] = np.nan
                continue
            line = min(max(line, 0.0), lines - 1.0)
            sample = min(max(sample, 0.0), samples - 1.0)
            i, j = int(line), int(sample)
            if cubic and 1 <= i < lines - 2 and 1 <= j < samples - 2:
                u0, u1, u2, u3 = _cubic_weights(line - i)
                weights = _cubic_weights(sample - j)
                a = _weighted(pixels, i - 1, j, weights)
                b = _weighted(pixels, i, j, weights)
                c = _weighted(pixels, i + 1, j, weights)
                d = _weighted(pixels, i + 2, j, weights)
                value = u0 * a + u1 * b + u2 * c + u3 * d
                if np.isfinite(value):
                    out[r, s] = value
                    continue
            value = _bilinear(pixels, line, sample)
            out[r, s] = value if np.isfinite(value) else _beside_lost(pixels, line, sample)
    return out


@njit(error_model="numpy")
def _beside_lost(pixels: FloatImage, line: float, sample: float) -> float:
    """Bilinear value of the valid pixels of four; the kind of the lost ones where these weigh more."""
    lines, samples = pixels.shape
    i, j = int(line), int(sample)
    total, weight, excess = 0.0, 0.0, 0.0
    for k in range(i, min(i + 2, lines)):
        for m in range(j, min(j + 2, samples)):
            w = (1.0 - abs(line - k)) * (1.0 - abs(sample - m))
            if np.isfinite(pixels[k, m]):
                total += w * pixels[k, m]
                weight += w
            else:
                excess += w if pixels[k, m] == np.inf else -w
    if weight >= 1.0 - LOST_SHARE:
        return total / weight
    return np.inf if excess > 0.0 else np.nan
