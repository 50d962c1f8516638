"""Periodic noise of known smoothness, and its shifts by fractions of a pixel."""

import numpy as np
from scipy import fft

from amers.services.types import Array, FloatImage


def texture(rng: np.random.Generator, side: int, smoothness_px: float) -> Array:
    """White noise smoothed by a Gaussian of a given standard deviation; mean 0, standard deviation 1."""
    gain = np.exp(-2.0 * (np.pi * _frequency(side) * smoothness_px) ** 2)
    noise = fft.irfft2(fft.rfft2(rng.standard_normal((side, side))) * gain, s=(side, side))
    return np.asarray((noise - noise.mean()) / noise.std())


def moved(pixels: Array, rows: float, columns: float) -> Array:
    """Periodic pixels moved down and to the right."""
    side = len(pixels)
    phase = rows * fft.fftfreq(side)[:, None] + columns * fft.rfftfreq(side)[None, :]
    return np.asarray(fft.irfft2(fft.rfft2(pixels) * np.exp(-2j * np.pi * phase), s=pixels.shape))


def as_pixels(pixels: Array) -> FloatImage:
    """The noise as grey values around 500."""
    return (500.0 + 100.0 * pixels).astype(np.float32)


def _frequency(side: int) -> Array:
    return np.asarray(np.hypot(fft.fftfreq(side)[:, None], fft.rfftfreq(side)[None, :]))
