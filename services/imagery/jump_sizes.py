"""Size of a jump between two lines: the number of lost lines, or the displacement of a part.

Pixels differ the more the farther apart they are: the difference across the jump is that of pixels as
many lines apart as it takes elsewhere around it. A moved part shows what lies beside it once more.
"""

import cv2
import numpy as np

from amers.services.imagery.line_profiles import strips_of
from amers.services.imagery.source import ImageSource, Window
from amers.services.types import Array, FloatImage

_LINES = 96
"""Lines that are read on either side of a jump."""
_FARTHEST = 32
"""Largest number of lines that are lost between two lines; beyond, pixels differ no more."""
_PART_PX = 32
"""Samples of a part of which the difference is the mean."""
_REACH_PX, _TEMPLATE_LINES, _LEAST_SCORE = 48, 4, 0.95
"""Displacement of a moved part that is searched, lines beside its joint, and their correlation."""
_ALIKE, _COMPARED = 0.5, 8
"""Difference of lines behind a jump from earlier ones that they repeat, at most, over that of
neighbouring lines; lines that are compared."""


def moved_px(image: ImageSource, line: int, span: tuple[int, int]) -> Array | None:
    """Displacement (2,) of a part, line and sample, by what both sides of a joint show; else None.

    Args:
        image: read around the joint.
        line: the first one behind the joint.
        span: first and last sample of the joint, exclusive.
    """
    left, right = span[0] + _REACH_PX, span[1] - _REACH_PX
    first, last = max(line - _REACH_PX, 0), min(line + _REACH_PX, image.shape[0])
    if right - left < _PART_PX or line - first < _TEMPLATE_LINES or last - line < _TEMPLATE_LINES:
        return None
    pixels = image.read(Window(first, span[0], last - first, span[1] - span[0]))
    if not np.isfinite(pixels).all():
        return None
    at, inside = line - first, slice(_REACH_PX, right - span[0])
    sides = (
        (slice(at, at + _TEMPLATE_LINES), slice(0, at)),
        (slice(at - _TEMPLATE_LINES, at), slice(at, None)),
    )
    best, found = _LEAST_SCORE, None
    for shown, searched in sides:
        template = np.ascontiguousarray(pixels[shown, inside])
        if template.std() == 0.0:
            continue
        score = cv2.matchTemplate(np.ascontiguousarray(pixels[searched]), template, cv2.TM_CCOEFF_NORMED)
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        if score[row, column] > best:
            best = float(score[row, column])
            found = np.array(
                [shown.start - (searched.start + row), _REACH_PX - column], dtype=np.float64
            )
    return found


def jump_px(image: ImageSource, line: int) -> float:
    """Lines that are lost before a line, roughly; negative for lines that are repeated; NaN if unknown.

    Args:
        image: read around the line.
        line: the first one behind the jump.
    """
    first, last = max(line - _LINES, 0), min(line + _LINES, image.shape[0])
    pixels = [
        image.read(Window(first, sample, last - first, width))
        for sample, width in strips_of(image.shape[1])
    ]
    at = line - first
    across = _differences(pixels, 1)[at - 1]
    repeated = _repeated(pixels, at)
    if repeated:
        return -float(repeated)
    for apart in range(2, _FARTHEST + 1):
        known = _differences(pixels, apart)
        # Pairs of lines on the same side of the jump.
        sides = np.concatenate([known[: max(at - apart, 0)], known[at:]])
        if len(sides) < _COMPARED:
            return float("nan") if apart == 2 else float(apart - 2)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.log(across / _means(sides))
        finite = ratio[np.isfinite(ratio)]
        if not len(finite):
            return float("nan")
        if np.median(finite) <= 0.0:
            return float(apart - 1)
    return float(_FARTHEST)


def _differences(pixels: list[FloatImage], apart: int) -> Array:
    """Mean difference (lines - apart, parts) of lines from those some lines before."""
    found = []
    for part in pixels:
        width = part.shape[1] // _PART_PX * _PART_PX
        if width:
            with np.errstate(invalid="ignore"):
                difference = np.abs(part[apart:, :width] - part[:-apart, :width])
            found.append(difference.reshape(len(difference), -1, _PART_PX).mean(axis=2))
    if not found:
        return np.full((max(len(pixels[0]) - apart, 0), 1), np.nan)
    return np.concatenate(found, axis=1).astype(np.float64)


def _means(differences: Array) -> Array:
    """Means (parts,) over the lines where differences (lines, parts) are known; NaN where none is."""
    known = np.isfinite(differences)
    total = np.where(known, differences, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)


def _repeated(pixels: list[FloatImage], at: int) -> int:
    """How many lines are repeated, exactly or not, before a line; 0 when none are seen to be."""
    usual = _means(_differences(pixels, 1))
    best, lag = _ALIKE, 0
    for apart in range(2, at):
        alike = _differences(pixels, apart)[at - apart : at - apart + min(_COMPARED, apart)]
        if len(alike) < 2:
            break
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = _means(alike) / usual
        finite = ratio[np.isfinite(ratio)]
        if len(finite) and np.median(finite) < best:
            best, lag = float(np.median(finite)), apart
    return lag
