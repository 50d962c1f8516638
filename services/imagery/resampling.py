"""Cubic spline interpolation of images: exact at the pixels, accurate at any fraction of a pixel."""

from functools import lru_cache

import cv2
import numpy as np
from numba import njit

from amers.services.imagery.gaps import filled, lost_pixels
from amers.services.types import Array, FloatImage

_POLE = np.sqrt(3.0) - 2.0
SPLINE_REACH_PX = 8
"""Half length of the filter from pixels to spline coefficients; the omitted taps are below 3e-5."""


def resample(coefficients: FloatImage, line_sample: Array) -> FloatImage:
    """Values of an image at any positions.

    Args:
        coefficients: (lines, samples) of the image, see `spline_coefficients`.
        line_sample: (..., 2) positions, pixels.

    Returns:
        (...) float32; NaN beyond the image, NaN or +inf beside lost pixels.
    """
    flat = np.ascontiguousarray(line_sample, dtype=np.float64).reshape(-1, 2)
    return np.asarray(_values(coefficients, flat).reshape(line_sample.shape[:-1]))


def spline_coefficients(pixels: FloatImage, blur_px: float = 0.0) -> FloatImage:
    """Coefficients of the cubic spline through an image, or through a blurred copy of it.

    The spline preserves position and amplitude of well-sampled detail at any fraction of a pixel.
    Bicubic convolution displaces gradients by some hundredths of a pixel, and blurs most at half a
    pixel.

    Source: Unser, Aldroubi and Eden (1993), B-spline signal processing; the recursions of the paper and
    the blur are combined in one filter.

    Args:
        pixels: (lines, samples); NaN where there is no data, +inf where saturated.
        blur_px: standard deviation of the Gaussian blur, pixels.

    Returns:
        (lines, samples) float32, small gaps bridged; NaN or +inf where most of the footprint of the
        blur is lost, see `gaps`.
    """
    if np.isfinite(pixels).all():
        return _filtered(pixels, blur_px)
    return _filtered(filled(pixels), blur_px) + lost_pixels(pixels, blur_px)


def finite_bounds(line_sample: Array) -> tuple[Array, Array]:
    """Lowest and highest (2,) of the finite positions (..., 2); inf and -inf where there are none."""
    return _finite_bounds(np.ascontiguousarray(line_sample, dtype=np.float64).reshape(-1, 2))


def _filtered(pixels: FloatImage, blur_px: float) -> FloatImage:
    kernel = _kernel(round(blur_px, 3))
    return np.asarray(
        cv2.sepFilter2D(pixels, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
    )


@lru_cache(maxsize=256)
def _kernel(blur_px: float) -> FloatImage:
    """The convolution of a Gaussian with the inverse filter of the sampled cubic B-spline."""
    k = np.arange(-SPLINE_REACH_PX, SPLINE_REACH_PX + 1)
    inverse = np.sqrt(3.0) * _POLE ** np.abs(k)
    if blur_px == 0.0:
        kernel = inverse
    else:
        reach = int(np.ceil(4.0 * blur_px))
        gaussian = np.exp(-0.5 * (np.arange(-reach, reach + 1) / blur_px) ** 2)
        kernel = np.convolve(gaussian / gaussian.sum(), inverse)
    return np.asarray((kernel / kernel.sum()).astype(np.float32))


@njit(cache=True, inline="always")
def spline_weights(t: float) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Weights of four coefficients for a position a fraction `t` (0 to 1) beyond the second of them."""
    s = 1.0 - t
    return (
        np.float32(s * s * s / 6.0),
        np.float32(2.0 / 3.0 - t * t * (2.0 - t) / 2.0),
        np.float32(2.0 / 3.0 - s * s * (2.0 - s) / 2.0),
        np.float32(t * t * t / 6.0),
    )


@njit(cache=True)
def _finite_bounds(line_sample: Array) -> tuple[Array, Array]:
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for k in range(len(line_sample)):
        line, sample = line_sample[k, 0], line_sample[k, 1]
        if np.isfinite(line) and np.isfinite(sample):
            low[0], high[0] = min(low[0], line), max(high[0], line)
            low[1], high[1] = min(low[1], sample), max(high[1], sample)
    return low, high


@njit(cache=True, error_model="numpy")
def _values(c: FloatImage, line_sample: Array) -> FloatImage:
    lines, samples = c.shape
    out = np.empty(len(line_sample), dtype=np.float32)
    for k in range(len(line_sample)):
        line, sample = line_sample[k, 0], line_sample[k, 1]
        if not (0.0 <= line <= lines - 1.0 and 0.0 <= sample <= samples - 1.0):
            out[k] = np.nan
            continue
        i, j = min(int(line), lines - 2), min(int(sample), samples - 2)
        u0, u1, u2, u3 = spline_weights(line - i)
        v0, v1, v2, v3 = spline_weights(sample - j)
        i0, i3 = abs(i - 1), i + 2 if i + 2 < lines else lines - 2
        j0, j3 = abs(j - 1), j + 2 if j + 2 < samples else samples - 2
        out[k] = (
            u0 * (v0 * c[i0, j0] + v1 * c[i0, j] + v2 * c[i0, j + 1] + v3 * c[i0, j3])
            + u1 * (v0 * c[i, j0] + v1 * c[i, j] + v2 * c[i, j + 1] + v3 * c[i, j3])
            + u2 * (v0 * c[i + 1, j0] + v1 * c[i + 1, j] + v2 * c[i + 1, j + 1] + v3 * c[i + 1, j3])
            + u3 * (v0 * c[i3, j0] + v1 * c[i3, j] + v2 * c[i3, j + 1] + v3 * c[i3, j3])
        )
        if out[k] != out[k]:
            out[k] = _lost_value(c, (i0, i, i + 1, i3), (j0, j, j + 1, j3))
    return out


@njit(cache=True)
def _lost_value(c: FloatImage, rows: tuple[int, ...], columns: tuple[int, ...]) -> float:
    """+inf where most of the lost coefficients among 16 are saturated, else NaN."""
    excess = 0
    for i in rows:
        for j in columns:
            if c[i, j] == np.inf:
                excess += 1
            elif c[i, j] != c[i, j]:
                excess -= 1
    return np.inf if excess > 0 else np.nan
