"""Line breaks: places in an image where lines are missing or repeated.

A scanner that loses or repeats lines leaves a trace in the pixels: across the break, neighbouring lines
differ more than elsewhere, over the whole width of the image, and between these two lines only. No
control point is needed to see it, and the line is known exactly. How many lines are missing is not.
"""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import maximum_filter1d, median_filter
from scipy.special import bdtrc

from amers.services.imagery.pixel_checks import Fault
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ImageSource, Window
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array, FloatImage, IntArray

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
_LEAST_UNSHARED = 0.15
"""The same of what a line does not share with the one before, whatever its gain and offset."""
_LEAST_VARIANCE = 1e-9
"""Of a line that has one grey value."""
_SAME = 2
"""Lines within which two signs are of one break."""
_MOST = 8
"""An image with more is one of bad lines."""
_LEAST_DIFFERENCE = 1e-3
"""Grey values: lines that are alike have no logarithm."""


def scene_breaks(scene: Scene) -> IntArray:
    """The line breaks of a scene; none in an ortho-image, which was not scanned line by line.

    Lines that its pixels repeat or lack make breaks as well.
    """
    if isinstance(scene.model, OrthoModel):
        return np.zeros(0, dtype=np.int64)
    told = [
        one.line + (1 if one.kind == Fault.LOST_LINES else 0)
        for one in scene.pixel_findings or ()
        if one.kind in (Fault.LOST_LINES, Fault.REPEATED_LINES)
    ]
    breaks = np.sort(np.concatenate([line_breaks(scene.image), np.array(told, dtype=np.int64)]))
    apart = np.diff(breaks, prepend=-2 * _SAME) > _SAME
    return breaks[apart] if apart.sum() <= _MOST else breaks[:0]


def format_breaks(breaks: IntArray) -> str:
    """What breaks (k,) are and where they lie, in words."""
    return f"the pixels show lost or repeated lines at line {', '.join(map(str, breaks.tolist()))}"


def line_breaks(image: ImageSource) -> IntArray:
    """First lines (k,) behind breaks, ascending; none where there are more than eight.

    The mean difference of each line from the one before it is taken in 32 parts of the width. A break is
    where it is larger than at the eight lines on either side, in more parts than chance explains
    (binomial, times the number of lines) and by a factor that other lines of the image do not reach, and
    where it is no change of gain or offset.
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
    if len(found) > _MOST:
        return none
    return found[[_shows_other_ground(image, line) for line in found.tolist()]]


def _differences(image: ImageSource) -> Array:
    """Mean differences (lines - 1, parts) of each line from the one before; NaN with too few pixels."""
    lines = image.shape[0]
    pieces = [(first, min(_AT_ONCE, lines - 1 - first) + 1) for first in range(0, lines - 1, _AT_ONCE)]
    return np.concatenate([_of_strips(image, first, count, _mean_change) for first, count in pieces])


def _shows_other_ground(image: ImageSource, line: int) -> bool:
    """Whether a line has less in common with the one before than the lines beside it.

    A sensor that changes its gain or offset makes all pixels of a line different, of the same ground.
    """
    unshared = _of_strips(image, line - _NEAR - 1, 2 * _NEAR + 2, _unshared)
    logarithm = np.log(np.maximum(unshared, _LEAST_DIFFERENCE))
    beside = np.median(np.delete(logarithm, _NEAR, axis=0), axis=0)
    return bool(np.nanmedian(logarithm[_NEAR] - beside) >= _LEAST_UNSHARED)


def _of_strips(
    image: ImageSource, first: int, count: int, measure: Callable[[FloatImage], Array]
) -> Array:
    """What a measure says of each line and the one before (count - 1, parts), in strips of an image."""
    samples = image.shape[1]
    strips = _STRIPS if samples > _STRIPS * _STRIP_PX else 1
    strip_px = _STRIP_PX if strips > 1 else samples
    parts = _PARTS // strips
    width = strip_px // parts
    if not width:
        return np.full((count - 1, _PARTS), np.nan)
    out = []
    for start in np.linspace(0, samples - strip_px, strips).astype(int).tolist():
        pixels = image.read(Window(first, start, count, strip_px))[:, : parts * width]
        out.append(measure(pixels.reshape(count, parts, width)))
    return np.hstack(out)


def _mean_change(pixels: FloatImage) -> Array:
    """Mean difference (lines - 1, parts) of lines (lines, parts, width) of which half is known."""
    with np.errstate(invalid="ignore"):
        apart = np.abs(np.diff(pixels, axis=0))
    mean = apart.mean(axis=2)
    if np.isfinite(mean).all():
        return np.asarray(mean, np.float64)
    known = np.isfinite(apart)
    number = known.sum(axis=2)
    mean = np.where(known, apart, 0.0).sum(axis=2) / np.maximum(number, 1)
    return np.where(2 * number >= apart.shape[2], mean, np.nan)


def _unshared(pixels: FloatImage) -> Array:
    """What (lines - 1, parts) of lines (lines, parts, width) no gain and offset make of those before."""
    known = np.isfinite(pixels)
    number = known.sum(axis=2, keepdims=True)
    mean = np.where(known, pixels, 0.0).sum(axis=2, keepdims=True) / np.maximum(number, 1)
    centred = np.where(known, pixels - mean, 0.0)
    variance = (centred**2).mean(axis=2)
    shared = (centred[1:] * centred[:-1]).mean(axis=2) ** 2 / np.maximum(variance[:-1], _LEAST_VARIANCE)
    enough = 2 * number[:, :, 0] >= pixels.shape[2]
    left = np.sqrt(np.maximum(variance[1:] - shared, 0.0))
    return np.where(enough[1:] & enough[:-1], left, np.nan)
