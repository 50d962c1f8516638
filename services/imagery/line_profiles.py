"""Profiles: the change from each line of an image (or sample) to the next, in cells along it.

The image is read once along each axis, piece by piece. Of an image wider than 2,048 pixels, four strips
evenly over the width are read.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from amers.services.imagery.source import ImageSource, Window
from amers.services.types import Array, BoolArray, FloatImage, IntArray

STRIPS, STRIP_PX = 4, 512
"""Strips of an image that is wider than all of them, and pixels of each across."""
_AT_ONCE = 1024
"""Lines read at a time."""
_CELLS, _CELL_PX = 64, 16
"""Cells along a line, at most, and pixels of one, at least."""
_LEAST_CHANGE = 0.02
"""Change of a cell, as a share of the median one, below which it is not distinguished from none."""

_UNEVEN = 1.2
"""Difference between the changes on either side of a line, logarithm, above which it lies at the border
of other ground, such as water or lost pixels, which is no fault."""
_FEWEST_LINES = 64
_PERIODS, _FINER, _LONGEST = 8, 8, 32
"""Oscillations subtracted at most, refinement of their frequency, longest period."""
_STRONG = 30.0
"""Power over the median one: noise exceeds it once in 1e13 frequencies."""


@dataclass(frozen=True)
class TransposedImage:
    """An image whose lines are the samples of another one; an `ImageSource`."""

    source: ImageSource

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.source.shape[1], self.source.shape[0]

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; see `ImageSource`."""
        turned = Window(window.sample, window.line, window.samples, window.lines)
        return np.ascontiguousarray(self.source.read(turned).T)


@dataclass(frozen=True)
class LineProfile:
    """The n lines of an image, each compared with the one before; the first has none.

    Attributes:
        change: (n, cells) logarithm of the mean absolute difference from the line before over that of
            the lines on either side; NaN where it is unknown, or these are unlike.
        mixed: (n, cells) the same of what changes along the line as well, which an edge of the ground
            along the line does not.
        equal: (n,) whether a line equals the one before, wherever both are known.
        varying: (n,) number of pixels that differ from the one before along the line.
        detailed: (n,) number of pixels that differ from both neighbours along the line: flat blocks of
            a compression have none.
        number: (n,) a number that equal lines share, and others do not.
        start: (cells + 1,) first pixel of each cell, along the line; the last is the end of the last.
    """

    change: FloatImage
    mixed: FloatImage
    equal: BoolArray
    varying: IntArray
    detailed: IntArray
    number: Array
    start: IntArray


def line_profile(image: ImageSource) -> LineProfile:
    """The profile of the lines of an image."""
    lines, samples = image.shape
    strips = strips_of(samples)
    count = min(_CELLS // len(strips), max(1, strips[0][1] // _CELL_PX))
    borders = np.linspace(0, strips[0][1], count + 1).astype(np.int64)
    start = np.concatenate([borders[:-1] + first for first, _ in strips])
    profile = LineProfile(
        np.zeros((lines, len(start)), dtype=np.float32),
        np.zeros((lines, len(start)), dtype=np.float32),
        np.zeros(lines, dtype=bool),
        np.zeros(lines, dtype=np.int64),
        np.zeros(lines, dtype=np.int64),
        np.zeros(lines),
        np.append(start, sum(strips[-1])),
    )
    for first in range(0, lines, _AT_ONCE):
        _add_piece(profile, image, first, borders)
    return profile


def strips_of(samples: int) -> list[tuple[int, int]]:
    """First pixel and width of the strips of an image that are read; all have the same width."""
    if samples <= STRIPS * STRIP_PX:
        return [(0, samples)]
    starts = np.linspace(0, samples - STRIP_PX, STRIPS).astype(int).tolist()
    return [(first, STRIP_PX) for first in starts]


def _add_piece(profile: LineProfile, image: ImageSource, first: int, borders: IntArray) -> None:
    """Read the lines of a piece, with the neighbours that they are compared with, into the profile."""
    begun, end = max(first - 2, 0), min(first + _AT_ONCE, image.shape[0])
    count = min(end + 1, image.shape[0]) - begun
    counts, number = np.zeros((4, count), dtype=np.int64), np.zeros(count)
    means = []
    for sample, width in strips_of(image.shape[1]):
        means.append(np.zeros((2, count, len(borders) - 1), dtype=np.float32))
        _compare(image.read(Window(begun, sample, count, width)), borders, means[-1], counts, number)
    change, mixed = np.concatenate(means, axis=2)
    rows, part = slice(first, end), slice(first - begun, end - begun)
    known, differing, varying, detailed = counts[:, part]
    profile.change[rows] = _contrast(change, begun)[part]
    profile.mixed[rows] = _contrast(mixed, begun)[part]
    profile.equal[rows] = (known > 0) & (differing == 0)
    profile.varying[rows], profile.detailed[rows] = varying, detailed
    profile.number[rows] = number[part]


def _contrast(means: FloatImage, begun: int) -> FloatImage:
    """Logarithm of means (n, cells) over that of the lines on either side; NaN where one is unknown."""
    changing = means[means > 0.0]
    least = _LEAST_CHANGE * float(np.median(changing)) if len(changing) else 1.0
    with np.errstate(invalid="ignore"):
        logarithm = np.log(np.maximum(means, np.float32(least)))
    if begun == 0:
        logarithm[0] = np.nan
    beside = np.full_like(logarithm, np.nan)
    beside[1:-1] = (logarithm[:-2] + logarithm[2:]) / 2.0
    with np.errstate(invalid="ignore"):
        beside[1:-1][np.abs(logarithm[:-2] - logarithm[2:]) > _UNEVEN] = np.nan
    if begun == 0 and len(means) > 3:
        beside[1] = logarithm[2]
    if len(means) > 1:
        beside[-1] = logarithm[-2]
    return np.asarray(logarithm - beside, np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _compare(
    pixels: FloatImage, borders: IntArray, means: FloatImage, counts: IntArray, number: Array
) -> None:
    """Compare the lines of a strip (n, width) with those before, in cells between borders.

    Args:
        pixels: of the strip.
        borders: (cells + 1,) of the cells.
        means: (2, n, cells) receives the differences; NaN where less than half of a cell is known.
        counts: (4, n) of pixels known, differing, varying and detailed are added.
        number: (n,) to which the pixels are added.
    """
    lines, width = pixels.shape
    for i in range(lines):
        total, varied = 0.0, False
        before = np.float32(np.nan)
        for j in range(width):
            value = pixels[i, j]
            known = np.isfinite(value)
            if known:
                # Weights without a pattern: the fractional parts of multiples of the golden ratio.
                weight = (j + 1) * 0.6180339887498949
                total += value * (1.0 + weight - np.floor(weight))
            varies = known and np.isfinite(before) and value != before
            counts[2, i] += varies
            counts[3, i] += varies and varied
            before, varied = value, varies
        number[i] += total
        for cell in range(means.shape[2]):
            if i == 0:
                means[:, i, cell] = np.nan
                continue
            change, mixed = 0.0, 0.0
            count, count_mixed, changed = 0, 0, 0
            before = np.float32(np.nan)
            for j in range(borders[cell], borders[cell + 1]):
                step = pixels[i, j] - pixels[i - 1, j]
                if np.isfinite(step):
                    change += abs(step)
                    count += 1
                    changed += step != 0.0
                    if np.isfinite(before):
                        mixed += abs(step - before)
                        count_mixed += 1
                before = step
            counts[0, i] += count
            counts[1, i] += changed
            enough = 2 * count >= borders[cell + 1] - borders[cell]
            means[0, i, cell] = change / count if enough else np.nan
            means[1, i, cell] = mixed / count_mixed if enough and count_mixed else np.nan


def quantile_of_cells(cells: FloatImage, share: float) -> FloatImage:
    """A quantile (n,) over the known ones of cells (n, m) of each line; NaN where none is known."""
    known = np.isfinite(cells).sum(axis=1)
    at = np.rint(share * np.maximum(known - 1, 0)).astype(np.int64)
    return np.take_along_axis(np.sort(cells, axis=1), at[:, None], axis=1)[:, 0]


def without_periods(series: Array | FloatImage) -> Array:
    """A series (n,) without the oscillations that a resampling leaves, of periods below 32.

    A resampled image is sharper where its pixels fall on those that it was made of: lines differ
    periodically from the lines before them. The strongest oscillations are subtracted one by one.
    """
    count = len(series)
    left: Array = (series - np.median(series)).astype(np.float64)
    if count < _FEWEST_LINES:
        return left
    largest = 3.0 * np.percentile(np.abs(left), 90.0)
    place, taper = np.arange(count), np.hanning(count)
    for _ in range(_PERIODS):
        clipped = np.clip(left, -largest, largest)
        power = np.abs(np.fft.rfft(clipped * taper, _FINER * count)) ** 2
        slowest = _FINER * count // _LONGEST
        power[:slowest] = 0.0
        peak = int(power.argmax())
        if power[peak] <= _STRONG * np.median(power[slowest:]):
            break
        angle = 2.0 * np.pi * peak / (_FINER * count) * place
        design = np.column_stack([np.cos(angle), np.sin(angle)])
        left = left - design @ np.linalg.lstsq(design, clipped, rcond=None)[0]
    return left
