"""Structure in the residuals of a scene that errors of single points do not explain.

Residuals of a correction that fits are independent. Each family of shapes below is a way in which they
are not: a scanner that shakes or bends along the lines, lines that were lost or repeated, detectors out
of place along the samples, relief that the model sees from another side, parts of the image that moved.

The test of a family is exact for normal errors: the F statistic of its best shape, on whitened
residuals from which the affine correction has been projected out, times the number of shapes that were
tried (Bonferroni), which is conservative. Bows are two shapes beside hundreds of periods: each kind of
shape has an equal share of the false alarms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.linalg import orth, solve_triangular
from scipy.special import fdtrc

from amers.services.types import Array

Family = Literal["lines", "steps", "samples", "seams", "image", "height"]
"""What residuals may depend on; "steps" are along the lines, "seams" steps along the samples."""
ALONG_AXES: tuple[Family, ...] = ("lines", "steps", "samples", "seams")
OTHERWISE: tuple[Family, ...] = ("image", "height")
_OF_PLACES: tuple[Family, ...] = (*ALONG_AXES, "image")
"""Families that say how far off a place is; what depends on height is another model's."""
_EXPECTED, _EXPECTED_SEAMS = 0.05, 0.01
"""A priori probability that an image moves in some way of a family, and that it has a seam."""

_LEAST_POINTS = 12
"""Fewer residuals show no structure."""
_LEAST_BESIDE = 3
"""Points on each side of a step."""
_OVERSAMPLING = 2.0
"""Periods that are tried for each that independent residuals can tell apart."""
_MOST_CYCLES = {"lines": 128, "samples": 16}
"""Periods are tried down to this part of the extent of the points."""
_MOST_STEPS = 128
"""Places that are tried for a step."""
_DEGREES = (2, 3)
"""Of the polynomials that are tried beside periods."""
_MOST_UNDERSTATED = 9.0
"""Variance of heights over what is declared, at most."""
_MODES = 3
"""Half waves along each axis of the shapes in two dimensions."""
_DEGENERATE = 1e-6
"""Share of a shape that an affine correction leaves, below which it is no shape of its own."""


@dataclass(frozen=True)
class Structure:
    """The shape of a family that explains the residuals best.

    Attributes:
        family: of the shape.
        chance: probability, at most, that independent errors show some shape of the family as clearly.
        shape: "quadratic", "cubic", "period", "step", "wave" or "slope"; "" where nothing was tried.
        at: period in pixels, or line or sample of a step; NaN for other shapes.
        size_px: (2,) of the shape at the points, line and sample, root mean square.
        largest_px: longest displacement of a point by the shape, from their mean.
        slope_px: (2,) pixels per metre of height, of a slope; NaN for other shapes.
    """

    family: Family
    chance: float
    shape: str
    at: float
    size_px: Array
    largest_px: float
    slope_px: Array


@dataclass(frozen=True)
class Residuals:
    """Residuals of the n points of a scene, whitened.

    Attributes:
        line_sample: (n, 2) pixels.
        height_m: (n,) of the points.
        height_pull: (2,) covariance of the errors of a point's height and of its position in the image,
            line and sample, pixels times metres.
        misfit: (n, 2) pixels, that an affine correction has to explain.
        covariance: (2, n, n) of the errors of line and sample.
        design: (n, k) derivatives by the parameters that are estimated in any case.
        chip_side_px: of a chip in the image: measures are averages over as many lines, and no shorter
            period is looked for.
    """

    line_sample: Array
    height_m: Array
    height_pull: Array
    misfit: Array
    covariance: Array
    design: Array
    chip_side_px: float

    @property
    def regular(self) -> "Residuals":
        """The same residuals, each with a little noise of its own.

        Chips that are the same have the same errors: no covariance of them can be inverted.
        """
        least = 1e-9 * np.diagonal(self.covariance, 0, 1, 2).max(axis=1)
        noise = least[:, None, None] * np.eye(len(self.misfit))
        return replace(self, covariance=self.covariance + noise)

    @cached_property
    def whitened(self) -> tuple[Array, Array, Array]:
        """Cholesky factors (2, n, n), bases (2, n, k) of the design, what it leaves (2, n)."""
        lower = np.linalg.cholesky(self.regular.covariance)
        bases, left = [], []
        for k in range(2):
            columns = np.column_stack([self.design, self.misfit[:, k]])
            white = solve_triangular(lower[k], columns, lower=True, check_finite=False)
            basis = orth(white[:, :-1], rcond=1e-9)
            bases.append(basis)
            left.append(white[:, -1] - basis @ (basis.T @ white[:, -1]))
        return np.asarray(lower, np.float64), np.array(bases), np.array(left)

    def gains(self, shapes: Array) -> tuple[Array, Array]:
        """What shapes explain.

        Args:
            shapes: (m, n, p) of p columns each, p of 1 or 2.

        Returns:
            (m,) sums over both coordinates of what the squares of whitened residuals lose, and (m, 2, p)
            coefficients.
        """
        lower, bases, left = self.whitened
        m, n, p = shapes.shape
        gain, coefficients = np.zeros(m), np.zeros((m, 2, p))
        columns = shapes.transpose(1, 0, 2).reshape(n, m * p)
        for k in range(2):
            white = solve_triangular(lower[k], columns, lower=True, check_finite=False)
            square = (white**2).sum(axis=0).reshape(m, p)
            white -= bases[k] @ (bases[k].T @ white)
            parts = white.reshape(n, m, p).transpose(1, 0, 2)
            normal = parts.transpose(0, 2, 1) @ parts
            right = (left[k] @ white).reshape(m, p)
            # A shape that an affine correction explains, or two columns that are one, explain nothing.
            small = np.diagonal(normal, 0, 1, 2) <= _DEGENERATE * square
            alike = np.linalg.det(normal) <= _DEGENERATE * np.diagonal(normal, 0, 1, 2).prod(axis=1)
            degenerate = small.any(axis=1) | alike
            normal[degenerate] = np.eye(p)
            right[degenerate] = 0.0
            own = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
            gain += (own * right).sum(axis=1)
            coefficients[:, k] = own
        return gain, coefficients

    def chance(self, gain: Array, parameters: int) -> Array:
        """Probability (m,) that independent errors give shapes of p parameters a coordinate as much."""
        _, bases, left = self.whitened
        total = float((left**2).sum())
        freedom = 2.0 * (left.shape[1] - bases.shape[2] - parameters)
        rest = np.maximum(total - gain, 1e-12 * total + 1e-300)
        return np.asarray(fdtrc(2.0 * parameters, freedom, gain / rest * freedom / (2.0 * parameters)))


def structures(residuals: Residuals, families: Sequence[Family]) -> tuple[Structure, ...]:
    """The structure of each family; see the module."""
    return tuple(_structure(residuals, family) for family in families)


def _structure(residuals: Residuals, family: Family) -> Structure:
    """The best shape of a family."""
    tried = []
    if family == "height":
        residuals = _beyond_height_errors(_bent(residuals))
    if len(residuals.misfit) >= max(_LEAST_POINTS, residuals.design.shape[1] + 6):
        kinds = [shapes for shapes in _shapes(residuals, family) if len(shapes[2])]
        for names, at, shapes in kinds:
            gain, coefficients = residuals.gains(shapes)
            chance = residuals.chance(gain, shapes.shape[2])
            best = int(np.argmin(chance))
            tried.append(
                (
                    float(chance[best]) * len(shapes) * len(kinds),
                    names[best],
                    at[best],
                    coefficients[best],
                    shapes[best],
                )
            )
    none = np.full(2, np.nan)
    if not tried:
        return Structure(family, 1.0, "", float("nan"), none, 0.0, none)
    chance_of_family, name, at_best, coefficient, shape = min(tried, key=lambda one: one[0])
    displacement = shape @ coefficient.T
    return Structure(
        family,
        chance=min(1.0, chance_of_family),
        shape=name,
        at=float(at_best),
        size_px=displacement.std(axis=0),
        largest_px=float(np.linalg.norm(displacement - displacement.mean(axis=0), axis=1).max()),
        slope_px=coefficient[:, 0] if family == "height" else none,
    )


def _bent(residuals: Residuals) -> Residuals:
    """The residuals beyond a surface of second degree: relief is smooth, and looks like a bow."""
    low = residuals.line_sample.min(axis=0)
    first, second = (
        2.0 * (residuals.line_sample - low) / np.maximum(np.ptp(residuals.line_sample, axis=0), 1e-9)
        - 1.0
    ).T
    columns = [first**2, first * second, second**2]
    return replace(residuals, design=np.column_stack([residuals.design, *columns]))


def _beyond_height_errors(residuals: Residuals) -> Residuals:
    """The residuals without what errors of the heights explain.

    A point that is too high by its error is displaced by it: residuals of points on level ground grow
    with their heights by -c / v, with the covariance c of the errors of height and position in the image
    and the variance v of the heights, up to as many times more as points are worse than declared.
    """
    height = residuals.height_m - residuals.height_m.mean()
    basis = orth(residuals.design, rcond=1e-9)
    variance = float(np.mean((height - basis @ (basis.T @ height)) ** 2))
    pull = -residuals.height_pull / max(variance, 1e-12)
    _, coefficients = residuals.gains(height[None, :, None])
    times = float(coefficients[0, :, 0] @ pull) / max(float(pull @ pull), 1e-300)
    explained = height[:, None] * pull * np.clip(times, 0.0, _MOST_UNDERSTATED)
    return replace(residuals, misfit=residuals.misfit - explained)


def probability_of_structure(chance: float, expected: float = _EXPECTED) -> float:
    """Probability that a structure is more than chance, from the chance of one that is as clear.

    `expected` is its probability a priori.

    A chance of p makes a structure at most 1 / (-e p log p) times more likely than none. Source: Sellke,
    Bayarri and Berger (2001), Calibration of p values for testing precise null hypotheses.
    """
    if chance >= np.exp(-1.0):
        return 0.0
    against = -np.e * max(chance, 1e-300) * np.log(max(chance, 1e-300))
    return float(1.0 / (1.0 + against * (1.0 - expected) / expected))


def unfollowed_variance_px2(found: Sequence[Structure], of_image: Array) -> Array:
    """What structures that nothing follows add to the variance (2,) of a position, line and sample.

    Families are different words for one misfit: the largest counts.

    Args:
        found: the structures.
        of_image: (2,) share of the variance of measures that is an error of the image. Points do not err
            along lines or samples of an image that they were not made from; what neighbours share in all
            directions may be an error of the points.
    """
    parts = [
        probability_of_structure(one.chance, _EXPECTED_SEAMS if one.family == "seams" else _EXPECTED)
        * np.nan_to_num(one.size_px) ** 2
        * (of_image if one.family == "image" else 1.0)
        for one in found
        if one.family in _OF_PLACES
    ]
    return np.max(parts, axis=0) if parts else np.zeros(2)


_Shapes = tuple[Sequence[str], Sequence[float], Array]


def _shapes(residuals: Residuals, family: Family) -> list[_Shapes]:
    """Names, places and columns (m, n, p) of the shapes of a family."""
    if family == "height":
        height = (residuals.height_m - residuals.height_m.mean())[None, :, None]
        return [(("slope",), (np.nan,), height)]
    if family == "image":
        return [_waves(residuals.line_sample)]
    position = residuals.line_sample[:, 1 if family in ("samples", "seams") else 0]
    if family in ("steps", "seams"):
        return [_steps(position)]
    most = int(min(_MOST_CYCLES[family], max(2 * len(position), _LEAST_POINTS)))
    return [_polynomials(position), _periods(position, residuals.chip_side_px, most)]


def _polynomials(position: Array) -> _Shapes:
    """Legendre polynomials of a coordinate (n,)."""
    low, high = position.min(), position.max()
    unit = 2.0 * (position - low) / max(high - low, 1e-9) - 1.0
    columns = [np.polynomial.legendre.Legendre.basis(degree)(unit) for degree in _DEGREES]
    return ("quadratic", "cubic"), (np.nan, np.nan), np.array(columns)[:, :, None]


def _periods(position: Array, shortest_px: float, most_cycles: int) -> _Shapes:
    """Sine and cosine of a coordinate (n,), of periods from twice its extent to the shortest.

    Points that are spread unevenly tell periods below twice their mean spacing, too.
    """
    extent = max(float(np.ptp(position)), 1e-9)
    most = min(extent / max(shortest_px, 1e-9), most_cycles)
    cycles = np.arange(1, max(int(_OVERSAMPLING * most), 2) + 1) / _OVERSAMPLING
    periods = extent / cycles
    phase = 2.0 * np.pi * position / periods[:, None]
    return ["period"] * len(periods), periods.tolist(), np.stack([np.cos(phase), np.sin(phase)], axis=-1)


def _steps(position: Array) -> _Shapes:
    """A step in the middle of each gap between neighbours along a coordinate (n,)."""
    ordered = np.unique(position)
    places = (ordered[1:] + ordered[:-1]) / 2.0
    after = position > places[:, None]
    enough = (after.sum(axis=1) >= _LEAST_BESIDE) & ((~after).sum(axis=1) >= _LEAST_BESIDE)
    step = -(-int(enough.sum()) // _MOST_STEPS) or 1
    places, after = places[enough][::step], after[enough][::step]
    return ["step"] * len(places), places.tolist(), after.astype(np.float64)[:, :, None]


def _waves(line_sample: Array) -> _Shapes:
    """Products of half waves of both coordinates (n, 2)."""
    low = line_sample.min(axis=0)
    unit = (line_sample - low) / np.maximum(np.ptp(line_sample, axis=0), 1e-9)
    along = [np.cos(np.pi * k * unit) for k in range(1, _MODES + 1)]
    columns = [first[:, 0] * second[:, 1] for first in along for second in along]
    return ["wave"] * len(columns), [float("nan")] * len(columns), np.array(columns)[:, :, None]
