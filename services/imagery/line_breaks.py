"""Line breaks: places in an image between whose lines others are missing, or repeated.

A scanner that loses or repeats lines leaves a trace in the pixels: across the break, neighbouring lines
differ more than elsewhere, over the whole width of the image, and between these two lines only. No
control point is needed to see it, and the line is known exactly. How many lines are missing is not.
"""

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.special import bdtrc

from services.imagery.scene import Scene
from services.imagery.source import ImageSource, Window
from services.sensors.ortho import OrthoModel
from services.types import Array, FloatImage, IntArray

_PARTS = 32
"""Parts of the width that are looked at, each by itself."""
_FEWEST_PARTS = 8
"""Parts with pixels, below which a line tells nothing."""
_STRIPS, _STRIP_PX = 4, 512
"""Strips of a wide image that are read, and samples of each."""
_AT_ONCE = 1024
"""Lines read at a time."""
_NEAR = 8
"""Lines on either side with which a place is compared; nearer to a border, nothing is told."""
_MAX_FALSE_ALARMS = 1e-4
"""Breaks in an image that chance makes, where the differences of lines are independent."""
_LEAST_CONTRAST = 0.35
"""Logarithm of the difference across a break over that of its neighbours, at least (1.4 times)."""
_ORDINARY, _TIMES = 98.0, 2.0
"""Percentile of this logarithm over an image, and how many times a break exceeds it: lines that a
compression or a sensor makes different are no breaks."""
_BESIDE = 0.5
"""Contrast beside a break over its own, below: a bad line differs from both neighbours."""
_MOST = 8
"""An image with more is one of bad lines."""
_LEAST_DIFFERENCE = 1e-3
"""Grey values: lines that are alike have no logarithm."""


def scene_breaks(scene: Scene) -> IntArray:
    """The line breaks of a scene; none in an ortho-image, which was not scanned line by line."""
    if isinstance(scene.model, OrthoModel):
        return np.zeros(0, dtype=np.int64)
    return line_breaks(scene.image)


def line_breaks(image: ImageSource) -> IntArray:
    """First lines (k,) behind breaks, ascending; none where there are more than eight.

    The mean difference of each line from the one before it is taken in 32 parts of the width. A break is
    where it is larger than at the eight lines on either side, in more parts than chance explains
    (binomial, times the number of lines) and by a factor that other lines of the image do not reach.
    """
    none = np.zeros(0, dtype=np.int64)
    difference = np.log(np.maximum(_differences(image), _LEAST_DIFFERENCE))
    known = np.isfinite(difference)
    parts = known.sum(axis=1)
    told = parts >= _FEWEST_PARTS
    if not told.any():
        return none
    width = 2 * _NEAR + 1
    difference[~known] = np.log(_LEAST_DIFFERENCE)
    largest = known & (difference >= maximum_filter1d(difference, width, axis=0, mode="nearest"))
    excess = difference - median_filter(difference, (width, 1), mode="nearest")
    excess[~known] = np.nan
    contrast = np.zeros(len(parts))
    contrast[told] = np.nanmedian(excess[told], axis=1)
    beside = np.maximum(np.append(contrast[1:], 0.0), np.insert(contrast[:-1], 0, 0.0))
    agreeing = np.maximum(largest.sum(axis=1), 1)
    false_alarms = len(parts) * bdtrc(agreeing - 1, np.maximum(parts, 1), 1.0 / width)
    broken = contrast >= max(_LEAST_CONTRAST, _TIMES * np.percentile(contrast[told], _ORDINARY))
    broken &= (beside < _BESIDE * contrast) & (false_alarms <= _MAX_FALSE_ALARMS)
    broken[:_NEAR] = broken[-_NEAR:] = False
    found = np.flatnonzero(broken) + 1
    return found if len(found) <= _MOST else none


def _differences(image: ImageSource) -> Array:
    """Mean differences (lines - 1, parts) of each line from the one before; NaN with too few pixels."""
    lines, samples = image.shape
    count = _STRIPS if samples > _STRIPS * _STRIP_PX else 1
    strip_px = _STRIP_PX if count > 1 else samples
    starts = np.linspace(0, samples - strip_px, count).astype(int).tolist()
    out = []
    for first in range(0, lines - 1, _AT_ONCE):
        windows = [
            Window(first, start, min(_AT_ONCE, lines - 1 - first) + 1, strip_px) for start in starts
        ]
        out.append(np.hstack([_of_parts(image.read(window), _PARTS // count) for window in windows]))
    return np.concatenate(out) if out else np.zeros((0, _PARTS))


def _of_parts(pixels: FloatImage, parts: int) -> Array:
    """Mean differences (lines - 1, parts) of the lines of a window."""
    width = pixels.shape[1] // parts
    if not width:
        return np.full((len(pixels) - 1, parts), np.nan)
    whole = pixels[:, : parts * width]
    with np.errstate(invalid="ignore"):
        apart = np.abs(np.diff(whole, axis=0)).reshape(-1, parts, width)
    mean = apart.mean(axis=2)
    if np.isfinite(mean).all():
        return np.asarray(mean, np.float64)
    known = np.isfinite(apart)
    number = known.sum(axis=2)
    mean = np.where(known, apart, 0.0).sum(axis=2) / np.maximum(number, 1)
    return np.where(number >= width / 2, mean, np.nan)
