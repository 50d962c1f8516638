"""Levelling of grey values: a gain and an offset per scene and band, from all overlaps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.types import Array, BoolArray, FloatImage, IntArray

FEWEST_CELLS = 50
"""Cells that two scenes have to share before they are compared."""
MOST_CELLS = 100_000
"""Cells of an overlap that are compared at most; of more, every second, third … is taken."""
_LEAST_CORRELATION = 0.5
"""Below this the contrasts of two scenes are of different things, and only their means are compared."""
_OUTLIER = 3.0
"""Differences beyond this many robust standard deviations are of clouds and changes."""
_ROUNDS = 5


@dataclass(frozen=True)
class Levels:
    """What levels the grey values of scenes: `gain * value + offset`.

    Attributes:
        gain, offset: (scenes, bands).
    """

    gain: Array
    offset: Array

    def apply(self, pixels: FloatImage, number: int) -> FloatImage:
        """Levelled pixels (bands, lines, samples) of a scene; NaN and +inf stay."""
        gain = self.gain[number].astype(np.float32)[:, None, None]
        offset = self.offset[number].astype(np.float32)[:, None, None]
        return np.asarray(pixels * gain + offset, dtype=np.float32)


def unchanged(scenes: int, bands: int) -> Levels:
    """Levels that change nothing."""
    return Levels(np.ones((scenes, bands)), np.zeros((scenes, bands)))


@dataclass(frozen=True)
class Overlap:
    """Grey values of two scenes on the same ground, without what differs otherwise.

    Attributes:
        first, second: numbers of the scenes.
        count: cells compared.
        mean: (2, bands) of both.
        spread: (2, bands) standard deviations.
        correlation: (bands,).
    """

    first: int
    second: int
    count: int
    mean: Array
    spread: Array
    correlation: Array


def overlap_of(first: int, second: int, values: FloatImage) -> Overlap | None:
    """What two scenes show on the same ground; None where that is too little.

    Args:
        first, second: their numbers.
        values: (2, bands, cells); cells that are not finite in all bands of both are left out.
    """
    values = values[:, :, np.isfinite(values).all(axis=(0, 1))]
    if values.shape[2] > MOST_CELLS:
        values = values[:, :, :: -(-values.shape[2] // MOST_CELLS)]
    if values.shape[2] < FEWEST_CELLS:
        return None
    x = values.astype(np.float64)
    kept = _alike(x)
    x = x[:, :, kept]
    if x.shape[2] < FEWEST_CELLS:
        return None
    mean, spread = x.mean(axis=2), x.std(axis=2)
    covariance = ((x[0] - mean[0][:, None]) * (x[1] - mean[1][:, None])).mean(axis=1)
    correlation = covariance / np.maximum(spread.prod(axis=0), 1e-12)
    return Overlap(first, second, x.shape[2], mean, spread, correlation)


def _alike(x: Array) -> BoolArray:
    """Cells (m,) of values (2, bands, m) whose standardised values are the same but for noise."""
    middle = np.median(x, axis=2)
    spread = 1.4826 * np.median(np.abs(x - middle[:, :, None]), axis=2)
    kept = np.ones(x.shape[2], dtype=np.bool_)
    for _ in range(_ROUNDS):
        standard = (x - middle[:, :, None]) / np.maximum(spread, 1e-9)[:, :, None]
        difference = standard[0] - standard[1]
        centre = np.median(difference[:, kept], axis=1)[:, None]
        sigma = 1.4826 * np.median(np.abs(difference[:, kept] - centre), axis=1)[:, None]
        found = (np.abs(difference - centre) <= _OUTLIER * sigma + 1e-6).all(axis=0)
        if found.sum() < FEWEST_CELLS or (found == kept).all():
            break
        kept = found
        middle, spread = x[:, :, kept].mean(axis=2), x[:, :, kept].std(axis=2)
    return kept


def level(overlaps: Sequence[Overlap], means: Array, anchor: int | None = None) -> Levels:
    """Gains and offsets by least squares over all overlaps.

    The ratio of two gains is that of the standard deviations over the overlap (reduced major axis): it
    does not depend on which scene is the first, and noise of both weakens neither. Scenes that are
    joined by overlaps keep their mean gain (geometric) and their mean grey value, or the values of the
    anchor.

    Args:
        overlaps: of pairs of scenes.
        means: (scenes, bands) mean grey values.
        anchor: number of the scene whose grey values stay.
    """
    count, bands = means.shape
    levels = unchanged(count, bands)
    for band in range(bands):
        gain_rows = [o for o in overlaps if o.correlation[band] >= _LEAST_CORRELATION]
        ratio = [np.log(o.spread[1, band] / o.spread[0, band]) for o in gain_rows]
        weight = [np.sqrt(o.count / (1.01 - o.correlation[band] ** 2)) for o in gain_rows]
        gain = np.exp(_differences(gain_rows, np.array(ratio), np.array(weight), count))
        # The unknown is by how much the mean of a scene changes.
        fixed = means[:, band] * (1.0 - gain)
        step = [
            gain[o.second] * o.mean[1, band]
            + fixed[o.second]
            - gain[o.first] * o.mean[0, band]
            - fixed[o.first]
            for o in overlaps
        ]
        weight = [np.sqrt(o.count) for o in overlaps]
        change = _differences(overlaps, np.array(step), np.array(weight), count)
        levels.gain[:, band], levels.offset[:, band] = gain, fixed + change
    if anchor is None:
        return levels
    joined = _joined(overlaps, count)
    same = joined == joined[anchor]
    gain, offset = levels.gain[anchor].copy(), levels.offset[anchor].copy()
    levels.gain[same] /= gain
    levels.offset[same] = (levels.offset[same] - offset) / gain
    return levels


def _differences(overlaps: Sequence[Overlap], step: Array, weight: Array, count: int) -> Array:
    """Values (count,) with `first - second = step`, the smallest of all that fit best."""
    if not len(overlaps):
        return np.zeros(count)
    matrix = np.zeros((len(overlaps), count))
    for row, overlap in enumerate(overlaps):
        matrix[row, overlap.first], matrix[row, overlap.second] = weight[row], -weight[row]
    return np.asarray(np.linalg.lstsq(matrix, step * weight, rcond=1e-9)[0])


def _joined(overlaps: Sequence[Overlap], count: int) -> IntArray:
    """The lowest number (count,) of the scenes that each one is joined to."""
    group = np.arange(count)
    for overlap in overlaps:
        a, b = group[overlap.first], group[overlap.second]
        group[group == max(a, b)] = min(a, b)
    return group
