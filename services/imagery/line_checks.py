"""Detection of repeated lines, and of places where lines are missing, in a profile."""

from dataclasses import dataclass

import numpy as np

from amers.services.imagery.line_profiles import LineProfile, quantile_of_cells, without_periods
from amers.services.types import Array, BoolArray, FloatImage, IntArray

LEAST_TEXTURE = 32
"""Pixels of a line that differ from both their neighbours, at least: a line of flat ground, or of flat
blocks of a compression, may equal another one."""
DOUBLED_SHARE = 0.2
"""Share of lines that equal the one before, above which the image is enlarged by nearest neighbour."""
JUMP_LIMIT = 3.1
"""Largest jump between neighbouring lines, see `jumps`. Source: `benchmarks/pixel_checks.py`."""
_ORDINARY = 98.0
"""Percentile of the contrast of lines that is the unit of a jump."""
_LEAST_CONTRAST = 0.03
"""Least unit of a jump, logarithm: the noise of 2,048 independent pixels."""
_FEWEST_CELLS, _LEAST_SHARE = 8, 0.5
"""Cells of a line that are known, and their share, below which a line tells nothing."""
_QUANTILE = 0.35
"""Of the contrast of the cells of a line that is its own: what a third of a line shows is no jump."""
_BORDER = 4
"""First and last lines that are left aside: a filter makes others of them, and little lies beyond."""
_BESIDE = 0.25
"""Contrast of the lines beside a jump over its own, at most: a bad line differs from both neighbours."""
_MIXED_TIMES = 1.4
"""How many times clearer a jump is in the pixels than in their change along the line, at most; a sensor
that changes its gain or offset leaves the latter as it is."""


@dataclass(frozen=True)
class RepeatedLines:
    """Lines that are exact copies of earlier ones.

    Attributes:
        first: the first of them.
        count: their number.
        lag: lines from the original of the first to the first.
    """

    first: int
    count: int
    lag: int


def doubled_share(profile: LineProfile) -> float:
    """Share of the lines with any texture that equal the line before; the smaller of both halves."""
    textured = profile.varying >= LEAST_TEXTURE
    equal = textured & profile.equal
    half = len(textured) // 2
    parts = [slice(0, half), slice(half, None)]
    return float(min(equal[one].sum() / max(textured[one].sum(), LEAST_TEXTURE) for one in parts))


def repeated_lines(profile: LineProfile) -> list[RepeatedLines]:
    """Runs of lines with texture that equal earlier ones, in order.

    What is repeated once is repeated whole, unless the image ends. Lines that are mirrored at a border,
    as filters do, equal others one by one.
    """
    found: list[RepeatedLines] = []
    last: dict[float, int] = {}
    for line in np.flatnonzero(profile.detailed >= LEAST_TEXTURE).tolist():
        number = float(profile.number[line])
        original = last.get(number)
        last[number] = line
        if original is None:
            continue
        lag = line - original
        if found and (found[-1].first + found[-1].count, found[-1].lag) == (line, lag):
            found[-1] = RepeatedLines(found[-1].first, found[-1].count + 1, lag)
        else:
            found.append(RepeatedLines(line, 1, lag))
    lines = len(profile.number)
    return [
        one
        for one in found
        if one.count >= one.lag or (one.first + one.count == lines and one.count >= _BORDER)
    ]


def jumps(profile: LineProfile) -> Array:
    """How far each line (n,) differs from the one before beyond its neighbours, in ordinary differences.

    The contrast of a line is a quantile over its cells; oscillations that a resampling leaves are
    removed; the unit is the contrast that 2 % of the lines exceed.
    """
    change, scale = _contrast(profile.change)
    mixed, mixed_scale = _contrast(profile.mixed)
    beside = np.maximum(np.append(change[1:], 0.0), np.insert(change[:-1], 0, 0.0))
    score = np.minimum(change / scale, _MIXED_TIMES * mixed / mixed_scale)
    return np.where(beside <= _BESIDE * change, score, 0.0)


def _contrast(cells: FloatImage) -> tuple[Array, float]:
    """Contrast (n,) of lines, and its unit."""
    known = np.isfinite(cells)
    told = known.sum(axis=1) >= max(_FEWEST_CELLS, _LEAST_SHARE * cells.shape[1])
    contrast = np.zeros(len(cells))
    contrast[told] = quantile_of_cells(cells[told], _QUANTILE)
    if told.any():
        contrast[told] = without_periods(contrast[told])
    scale = float(np.percentile(contrast[told], _ORDINARY)) if told.any() else 0.0
    return contrast, max(scale, _LEAST_CONTRAST)


def lost_lines(score: Array, repeated: list[RepeatedLines], limit: float = JUMP_LIMIT) -> IntArray:
    """First lines (k,) behind jumps that no repeated lines explain, ascending."""
    explained: BoolArray = np.zeros(len(score) + 2, dtype=bool)
    explained[:_BORDER] = explained[len(score) - _BORDER + 1 :] = True
    for one in repeated:
        explained[max(one.first - 1, 0) : one.first + one.count + 2] = True
    return np.flatnonzero((score > limit) & ~explained[: len(score)])
