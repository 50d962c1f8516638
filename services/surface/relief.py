"""Rendering of heights: colours of values, and shading with a light from the north-west.

Source: Horn (1981), Hill shading and the reflectance map: a surface that reflects the same to all sides.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from amers.services.types import Array, FloatImage

Colours = npt.NDArray[np.uint8]

HEIGHT_COLOURS = ("#4f8f8b", "#8fbf8a", "#e9e2a6", "#d9a566", "#b0714f", "#d8c6bb")
"""From the lowest height to the highest."""
CHANGE_COLOURS = ("#2166ac", "#92c5de", "#f7f7f7", "#f4a582", "#b2182b")
"""From what sank to what rose."""
_LIGHT = np.array([-0.5, 0.5, 0.5**0.5])
"""East, north and up of the light: from the north-west, 45 degrees high, as maps have it."""
_SHADE = 0.7
"""Share of the colour that the light changes: a slope in the dark keeps the rest."""
_SHOWN = (0.01, 0.99)
"""Quantiles of the heights that get the first and the last colour."""


def colours_of(values: Array | FloatImage, limits: tuple[float, float], ramp: Sequence[str]) -> Colours:
    """Red, green, blue and opacity (…, 4) of values; transparent where there is none.

    Args:
        values: of any shape; NaN for none.
        limits: values of the first and the last colour, which those beyond have too.
        ramp: colours such as "#7fb2e5", between which is interpolated.
    """
    low, high = limits
    known = np.asarray(np.nan_to_num(values), dtype=np.float64)
    share = np.clip((known - low) / max(high - low, 1e-9), 0.0, 1.0)
    nodes = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in ramp], dtype=np.float64)
    at = np.linspace(0.0, 1.0, len(ramp))
    channels = [np.interp(share, at, node) for node in nodes.T]
    return np.stack([*channels, 255.0 * np.isfinite(values)], axis=-1).round().astype(np.uint8)


def shown_range(values: FloatImage) -> tuple[float, float]:
    """Values of the first and the last colour: all but 1 % at both ends; 0 and 1 where there is none."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = np.quantile(known, _SHOWN).tolist()
    return low, max(high, low + 0.1)


def relief(height_m: FloatImage, cell_m: float, limits_m: tuple[float, float]) -> Colours:
    """Heights in colours under the light, red, green, blue and opacity (lines, samples, 4).

    Args:
        height_m: (lines, samples), north up; NaN for none.
        cell_m: side of a cell.
        limits_m: heights of the first and the last colour.
    """
    east, north = _slope(height_m, 1, cell_m), -_slope(height_m, 0, cell_m)
    facing = _LIGHT[2] - _LIGHT[0] * east - _LIGHT[1] * north
    bright = np.maximum(facing, 0.0) / np.sqrt(1.0 + east**2 + north**2) / _LIGHT[2]
    pixels = colours_of(height_m, limits_m, HEIGHT_COLOURS)
    lit = pixels[:, :, :3] * (1.0 - _SHADE + _SHADE * bright)[:, :, None]
    pixels[:, :, :3] = np.clip(lit, 0.0, 255.0).round()
    return pixels


def _slope(height_m: FloatImage, axis: int, cell_m: float) -> FloatImage:
    """Rise for each metre along an axis, to the neighbours that have heights; 0 without any."""
    step = np.diff(height_m, axis=axis)
    before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
    before[axis], after[axis] = (1, 0), (0, 1)
    both = np.stack([np.pad(step, pad, constant_values=np.nan) for pad in (before, after)])
    known = np.isfinite(both)
    total = np.where(known, both, 0.0).sum(axis=0)
    return np.asarray(total / np.maximum(known.sum(axis=0), 1) / cell_m)
