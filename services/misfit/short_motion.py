"""Motion of a sensor within the lines of a chip, which positions of chips average out and cannot show.

Strips of the chips are displaced against their chips, see `amers.services.matching.chip_strips`. What
relief does to a chip changes from point to point; what the sensor did at a line is the same in all chips
that show it. A parabola is left out of each chip, so that neither errors of the points nor smooth relief
count.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import fdtrc

from amers.services.misfit.structure import Structure, probability_of_structure
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, BoolArray, IntArray

STRIPS = 8
"""Strips of a chip across the lines of a scene."""
_LONGEST = 1.5
"""Longest period that is tried, sides of a chip: positions of chips show longer ones."""
_SHORTEST = 2.5
"""The shortest, strips of a chip."""
_OVERSAMPLING = 2.0
_APART = 0.8
"""Distance of the chips that count, sides of a chip: nearer ones share their noise."""
_DEGREE = 2
"""Of the polynomial that is left out of each chip: its place, slopes of the ground, and its relief."""
_FEWEST_CHIPS, _FEWEST_STRIPS = 8, 5
_ODD = 9.0
"""Variance of the strips of a chip over that of the median chip, beyond which it is left out."""
MAX_CHANCE = 1e-7
"""A period that chance explains with a larger probability is none. Strips of chips in a town are
displaced by what stands there, which neighbours share: the least probability of 53 clean scenes of nine
real dates was 1e-5, with a wave of 3 px (`python -m benchmarks.real_scenes`)."""
_MOST_PERIODS = 6
_MOST_CHIPS = 120
"""The most precise chips tell enough."""
_AT_ONCE = 64
"""Periods that are tried at once: large scenes have thousands."""


@dataclass(frozen=True)
class ChipStrips:
    """Strips of n chips across the lines of a scene, displaced against their chips.

    Attributes:
        line: (n, s) of the middle of each strip, from that of its chip, pixels.
        displacement_px: (n, s, 2) line and sample; NaN where nothing is known.
        sigma_px: (n, s, 2) one standard deviation.
    """

    line: Array
    displacement_px: Array
    sigma_px: Array

    def take(self, rows: IntArray | BoolArray) -> "ChipStrips":
        """The strips of some of the chips."""
        return ChipStrips(self.line[rows], self.displacement_px[rows], self.sigma_px[rows])

    def replaced(self, rows: IntArray, by: "ChipStrips") -> "ChipStrips":
        """The strips of n chips, of which some rows (k,) are others."""
        columns = (self.line.copy(), self.displacement_px.copy(), self.sigma_px.copy())
        for column, new in zip(columns, (by.line, by.displacement_px, by.sigma_px), strict=True):
            column[rows] = new
        return ChipStrips(*columns)

    def against(self, displacement: DisplacementGrid, line_sample: Array) -> Array:
        """How much (n, s, 2) a displacement moves the strips of chips at (n, 2) against their chips."""
        places = np.stack(
            [line_sample[:, :1] + self.line, line_sample[:, 1:] + 0.0 * self.line], axis=-1
        )
        moved = displacement.at(places.reshape(-1, 2)).reshape(places.shape)
        return np.asarray(moved - moved.mean(axis=1, keepdims=True))


@dataclass(frozen=True)
class ShortMotion:
    """Motion within the chips.

    Attributes:
        structure: its clearest period, with the size of all periods.
        variance_px2: (2,) of line and sample, what it adds to the variance of a position; 0 where chance
            explains all.
    """

    structure: Structure
    variance_px2: Array


_NONE = np.full(2, np.nan)
STILL = ShortMotion(Structure("chips", 1.0, "", np.nan, _NONE, 0.0, _NONE), np.zeros(2))
"""What is known where strips show nothing."""


def short_motion(strips: ChipStrips, line_sample: Array, side_px: float) -> ShortMotion:
    """The motion that strips of chips show beyond chance, as a sum of periods.

    Args:
        strips: of n chips.
        line_sample: (n, 2) of the chips.
        side_px: of a chip.
    """
    rows = _apart(strips, line_sample, side_px)
    if len(rows) < _FEWEST_CHIPS:
        return STILL
    strips = strips.take(rows)
    line = line_sample[rows, :1] + strips.line
    contrasts = _Contrasts.of(strips)
    periods = _periods(line, side_px)
    freedom = float(contrasts.freedom.sum())
    if not len(periods) or freedom < 4 * _FEWEST_CHIPS:
        return STILL
    left, found = contrasts.left, STILL
    for _ in range(_MOST_PERIODS):
        freedom -= 4.0
        best = _clearest(contrasts, left, periods, line, side_px / STRIPS)
        rest = max(float((left**2).sum()) - best.gain, 1e-300)
        chance = float(fdtrc(4.0, freedom, best.gain / rest * freedom / 4.0)) * len(periods)
        structure = found.structure
        if found is STILL:
            structure = replace(structure, chance=min(chance, 1.0), shape="period", at=best.period)
        # Of any phase: what the parabolas hide of a wave, they hide of its noise, too.
        explained = np.einsum("ki,kij,kj->k", best.coefficient, best.information, best.coefficient)
        by_chance = 2.0 * rest / freedom
        power = np.maximum(explained - by_chance, 0.0) / np.trace(best.information, axis1=1, axis2=2)
        told = probability_of_structure(chance) if chance <= MAX_CHANCE else 0.0
        variance = found.variance_px2 + told * power
        largest = float(np.sqrt(2.0 * variance.sum()))
        found = ShortMotion(replace(structure, size_px=np.sqrt(variance), largest_px=largest), variance)
        if chance > MAX_CHANCE:
            break
        left = left - (best.wave @ best.coefficient[:, :, None])[:, :, 0]
    return found


def _apart(strips: ChipStrips, line_sample: Array, side_px: float) -> IntArray:
    """Rows of chips that show their strips and hardly overlap, the most precise first."""
    known = np.isfinite(strips.displacement_px).all(axis=2).sum(axis=1) >= _FEWEST_STRIPS
    rows = np.flatnonzero(known & np.isfinite(line_sample).all(axis=1))
    sigma = np.nanmedian(strips.sigma_px[rows], axis=(1, 2))
    rows = rows[np.lexsort((*line_sample[rows].T, sigma))]
    kept: list[int] = []
    for row in rows.tolist():
        distance = np.linalg.norm(line_sample[kept] - line_sample[row], axis=1)
        if (distance >= _APART * side_px).all():
            kept.append(row)
        if len(kept) == _MOST_CHIPS:
            break
    return np.array(kept, dtype=np.int64)


def _periods(line: Array, side_px: float) -> Array:
    """Periods (m,) that strips at some lines may show, longest first."""
    extent = _OVERSAMPLING * float(np.ptp(line))
    fewest = max(1, int(extent / (_LONGEST * side_px)))
    return extent / np.arange(fewest, int(extent / (_SHORTEST * side_px / STRIPS)) + 1)


@dataclass(frozen=True)
class _Contrasts:
    """Displacements of strips in units of their sigmas, beyond a parabola for each chip.

    Attributes:
        weight: (2, n, s) 1 over sigma; 0 where nothing is known.
        left: (2, n * s) the contrasts.
        freedom: (2, n) of them.
    """

    weight: Array
    left: Array
    freedom: Array

    @classmethod
    def of(cls, strips: ChipStrips) -> Self:
        known = np.asarray(np.isfinite(strips.displacement_px).all(axis=2))
        sigma = np.where(known[:, :, None], strips.sigma_px, np.inf)
        weight = 1.0 / sigma.transpose(2, 0, 1)
        freedom = np.broadcast_to(known.sum(axis=1) - (_DEGREE + 1.0), weight.shape[:2])
        displacement = np.nan_to_num(strips.displacement_px).transpose(2, 0, 1)
        left = _beyond_parabolas(displacement * weight, weight)
        variance = (left**2).sum(axis=2) / freedom
        typical = np.median(variance, axis=1, keepdims=True)
        counts = np.asarray((variance <= _ODD * typical).all(axis=0), dtype=np.float64)
        left = (left * counts[:, None]).reshape(2, -1)
        return cls(weight * counts[:, None], left, freedom * counts)

    def waves(self, periods: Array, line: Array, height_px: float) -> Array:
        """Cosine and sine (m, 2, n * s, 2) of periods (m,), as strips at lines (n, s) show them."""
        phase = 2.0 * np.pi * line / periods[:, None, None]
        seen = np.sinc(height_px / periods)[:, None, None]
        parts = []
        for wave in (np.cos(phase), np.sin(phase)):
            white = _beyond_parabolas((seen * wave)[:, None] * self.weight, self.weight)
            parts.append(white.reshape(len(periods), 2, -1))
        return np.stack(parts, axis=-1)


def _beyond_parabolas(white: Array, weight: Array) -> Array:
    """Whitened values (..., 2, n, s) without the closest parabola of each chip."""
    place = np.linspace(-1.0, 1.0, weight.shape[-1])
    columns: list[Array] = []
    for degree in range(_DEGREE + 1):
        column = weight * place**degree
        for other in columns:
            column = column - other * (other * column).sum(axis=-1, keepdims=True)
        columns.append(column / np.maximum(np.linalg.norm(column, axis=-1, keepdims=True), 1e-300))
    for column in columns:
        white = white - column * (column * white).sum(axis=-1, keepdims=True)
    return np.asarray(white)


@dataclass(frozen=True)
class _Wave:
    """A period, fitted to c contrasts of line and sample.

    Attributes:
        period: lines.
        gain: what it explains of the sum of their squares.
        coefficient: (2, 2) of cosine and sine, for line and sample.
        information: (2, 2, 2) of the coefficients.
        wave: (2, c, 2) cosine and sine.
    """

    period: float
    gain: float
    coefficient: Array
    information: Array
    wave: Array


def _clearest(
    contrasts: _Contrasts, left: Array, periods: Array, line: Array, height_px: float
) -> _Wave:
    """The period that explains the most of what is left (2, c) of strips at lines (n, s)."""

    def clearest_of(some: Array) -> _Wave:
        waves = contrasts.waves(some, line, height_px)
        information = waves.transpose(0, 1, 3, 2) @ waves
        right = (waves.transpose(0, 1, 3, 2) @ left[:, :, None])[..., 0]
        scale = np.trace(information, axis1=2, axis2=3)[..., None, None]
        information = information + 1e-9 * scale * np.eye(2)
        coefficient = np.linalg.solve(information, right[..., None])[..., 0]
        gain = (coefficient * right).sum(axis=(1, 2))
        k = int(np.argmax(gain))
        return _Wave(float(some[k]), float(gain[k]), coefficient[k], information[k], waves[k])

    parts = np.array_split(periods, -(-len(periods) // _AT_ONCE))
    return max(map(clearest_of, parts), key=lambda wave: wave.gain)
