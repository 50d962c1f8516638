"""Detection of displaced ground, separated from other causes of displaced points.

A landslide, a quarry or a part of another image displaces an area by one vector. Where it moved by a few
times what points scatter, its points are no outliers, and motion along lines and samples comes near to
them. An ellipse that moved is compared with everything else that is known to displace neighbours
together, by how likely each makes the measures.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from scipy.linalg import solve_triangular

from amers.services.misfit.affine_fit import FREE, AffineFit
from amers.services.misfit.displacement_components import MAX_CHANCE, Component, with_components
from amers.services.misfit.displacement_solution import agreeing_with
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.scene_motion import SceneMotion
from amers.services.misfit.shared_errors import likeliest_shared_errors
from amers.services.misfit.structure import Residuals
from amers.services.types import Array, BoolArray

_LEAST_EVIDENCE = 8.0
"""Logarithm of how many times more likely ground that moved makes the measures, at least."""
_FEWEST = 5
"""Measures on ground that moved, and on ground that did not."""
_LIMIT = 4.0
"""Standard deviations from which on a measure that does not agree makes no difference."""
_CENTRES = np.linspace(-0.9, 0.9, 7)
_RADII = np.sqrt(4.0 / np.pi * np.array([0.05, 0.1, 0.17, 0.25, 0.33, 0.42]))
"""Of circles that cover these shares of the image."""
_STRETCHED = 1.8
"""Ratio of the axes of the ellipses that are tried beside circles."""
_DIRECTIONS = np.array([0.0, 0.25, 0.5, 0.75]) * np.pi
_LOOKED_AT = 15
"""Shapes that explain most, of which the robust solution is sought."""
_CHANGES = np.array([0.1, 0.1, 0.12, 0.12, np.pi / 10.0])
"""Steps of centre, logarithms of the half axes, and direction, by which an ellipse is improved."""
_ROUNDS = 6
_EDGES = np.linspace(-1.0, 1.0, 11)
"""Lines and samples between which detectors, or lines of the image, may be out of place."""
_DEGREE = 3
"""Of a surface of line and sample: what terrain and optics do."""
_LOOSE_PX = 1000.0
"""A priori standard deviation of what displaces the points."""
_NODES = np.stack(np.meshgrid(*[np.linspace(-0.95, 0.95, 20)] * 2), axis=-1).reshape(-1, 2)
"""Places all over the image, from -1 to 1."""


@dataclass(frozen=True)
class MovedGround:
    """Ground of a scene that moved.

    Attributes:
        measures: (n,) that lie on it.
        log_evidence: logarithm of how many times more likely it makes the measures than anything else,
            one of all areas tried.
    """

    measures: BoolArray
    log_evidence: float


@dataclass(frozen=True)
class _Explained:
    """How likely what displaces the measures of a scene makes them.

    Attributes:
        measured: the measures.
        fit: of them.
        seen: (n,) measures that there are.
        tolerance: within which they agree, standard deviations.
    """

    measured: PlacedMeasures
    fit: AffineFit
    seen: BoolArray
    tolerance: float

    def _displaced(self, shapes: Array) -> tuple[AffineFit, Array, float]:
        """The fit of a correction and shapes (n, k) of any size, a robust solution, and its scale."""
        both = replace(
            self.fit,
            member=np.column_stack([self.fit.member, shapes]).astype(np.float64),
            offset_px=np.column_stack([self.fit.offset_px, np.full((2, shapes.shape[1]), _LOOSE_PX)]),
        )
        free = FREE["affine"]
        parameters = both.robust_solution(self.seen, free)
        return both, parameters, both.scale(parameters, self.seen, free)

    def scale(self, shapes: Array) -> float:
        """Standard deviation of unit weight beside shapes (n, k)."""
        return self._displaced(shapes)[2]

    def by(self, shapes: Array, area: BoolArray | None = None) -> float:
        """Logarithm of the likelihood, with shapes (n, k) of any size.

        Where an area (n,) is given, too few measures that agree inside or outside it make it -inf.
        """
        both, parameters, scale = self._displaced(shapes)
        agrees = self.seen & (both.magnitude(parameters) <= self.tolerance * scale)
        if area is not None and not _on_both_sides(area, agrees):
            return -np.inf
        told = _log_likelihood(self.measured.residuals(both, self.seen), agrees[self.seen])
        # Schwarz (1978): half of the logarithm of the measures for each parameter of each coordinate.
        return told - shapes.shape[1] * float(np.log(self.seen.sum()))

    def by_motion(self, components: tuple[Component, ...], agrees: BoolArray) -> float:
        """The same with motion along lines and samples, with which measures (n,) agree."""
        residuals = self.measured.residuals(self.fit, self.seen)
        return _log_likelihood(with_components(residuals, components), agrees[self.seen])

    def by_shared_errors(self, clipped: AffineFit) -> float:
        """The same with errors that neighbours share, as a fit with limited residuals tells them."""
        shared = likeliest_shared_errors(
            clipped,
            self.seen,
            FREE["affine"],
            np.inf,
            position=self.measured.position,
            overlapping=self.measured.overlapping,
        )
        if not shared.correlated.any():
            return -np.inf
        residuals = self.measured.residuals(self.fit, self.seen, shared)
        agrees = agreeing_with(residuals, (), self.fit.expected(np.inf), self.tolerance)
        return _log_likelihood(residuals, agrees)


def moved_ground(
    measured: PlacedMeasures,
    fit: AffineFit,
    clipped: AffineFit,
    motion: SceneMotion,
    *,
    seen: BoolArray,
    tolerance: float,
) -> MovedGround | None:
    """Ground that moved; None where anything else is as likely.

    Where the image shows two places, that of the larger area is the scene's.

    Args:
        measured: the measures.
        fit: of them.
        clipped: the fit, whose residuals from an affine solution are limited.
        motion: along lines and samples, that explains the measures best.
        seen: (n,) measures that there are.
        tolerance: of the measures, standard deviations.
    """
    rows = measured.residuals(clipped, seen)
    circles = _inside(_CIRCLES, fit.t)
    circles = circles[_on_both_sides(circles, seen)]
    if not len(circles):
        return None
    gain, _ = rows.gains(circles[:, seen, None].astype(np.float64))
    if rows.chance(gain.max(keepdims=True), 1)[0] * len(circles) > MAX_CHANCE:
        return None
    explained = _Explained(measured, fit, seen, tolerance)
    ellipse = _likeliest_ellipse(explained, rows)
    moved = _inside(ellipse, fit.t)
    # Points may be worse than stated.
    unit = max(1.0, explained.scale(_column(moved))) ** 2
    explained = replace(explained, fit=fit.scaled(unit))
    told = explained.by(_column(moved)) - float(np.log(len(_ELLIPSES)))
    evidence = np.inf
    for likelihood in _by_all_else(explained, rows, clipped.scaled(unit), motion.scaled(unit)):
        evidence = min(evidence, told - likelihood)
        if evidence < _LEAST_EVIDENCE:
            return None
    if _inside(ellipse, _NODES).mean() > 0.5:
        moved = ~moved
    return MovedGround(seen & moved, evidence)


def _by_all_else(
    explained: _Explained, rows: Residuals, clipped: AffineFit, motion: SceneMotion
) -> Iterator[float]:
    """How likely all else that displaces neighbours together makes the measures, one after another."""
    t, seen = explained.fit.t, explained.seen
    yield explained.by_motion(motion.components, motion.agreeing)
    yield explained.by_shared_errors(clipped)
    yield explained.by(_surface(explained.measured, t))
    bands = np.array(list(_bands(t)))
    bands = bands[_on_both_sides(bands, seen)]
    gain, _ = rows.gains(bands[:, seen, None].astype(np.float64))
    for band in bands[np.argsort(-gain)[:_LOOKED_AT]]:
        yield explained.by(_column(band))


def _likeliest_ellipse(explained: _Explained, rows: Residuals) -> Array:
    """The ellipse (5,) whose points are displaced most likely by one vector."""
    t, seen = explained.fit.t, explained.seen
    tried = _ELLIPSES[_on_both_sides(_inside(_ELLIPSES, t), seen)]

    def likelihood(ellipse: Array) -> float:
        inside = _inside(ellipse, t)
        return explained.by(_column(inside), inside)

    gain, _ = rows.gains(_inside(tried, t)[:, seen, None].astype(np.float64))
    best = max(tried[np.argsort(-gain)[:_LOOKED_AT]], key=likelihood)
    most = likelihood(best)
    for _ in range(_ROUNDS):
        near = best + np.concatenate([np.diag(_CHANGES), -np.diag(_CHANGES)])
        found = [likelihood(one) for one in near]
        if max(found) <= most:
            break
        most, best = max(found), near[int(np.argmax(found))]
    return best


def _on_both_sides(inside: BoolArray, seen: BoolArray) -> BoolArray:
    """Which areas (..., n) have enough of the measures inside and outside."""
    count = (inside & seen).sum(axis=-1)
    return np.asarray((count >= _FEWEST) & (count <= seen.sum() - _FEWEST))


def _column(inside: BoolArray) -> Array:
    """An area (n,) as a shape (n, 1)."""
    return inside[:, None].astype(np.float64)


def _bands(t: Array) -> Iterator[BoolArray]:
    """Positions (n,) between each two lines, and each two samples: parts of an image, or a detector."""
    for axis, (first, last) in product(range(2), combinations(_EDGES, 2)):
        yield (t[:, axis] >= first) & (t[:, axis] < last)


def _surface(measured: PlacedMeasures, t: Array) -> Array:
    """Shapes (n, k) of a surface of line and sample, and of the height."""
    powers = [(i, k - i) for k in range(2, _DEGREE + 1) for i in range(k + 1)]
    height_m = measured.height_m - measured.height_m.mean()
    return np.column_stack(
        [*(t[:, 0] ** i * t[:, 1] ** j for i, j in powers), height_m / max(float(height_m.std()), 1e-9)]
    )


def _inside(ellipse: Array, t: Array) -> BoolArray:
    """Which positions t (n, 2), from -1 to 1 over the image, lie in ellipses (..., 5): (..., n).

    An ellipse is its centre, the logarithms of its half axes, and the direction of the first.
    """
    from_centre = t - ellipse[..., None, :2]
    cos, sin = np.cos(ellipse[..., 4, None]), np.sin(ellipse[..., 4, None])
    along = from_centre[..., 0] * cos + from_centre[..., 1] * sin
    across = from_centre[..., 1] * cos - from_centre[..., 0] * sin
    half = np.exp(ellipse[..., None, 2:4])
    return np.asarray((along / half[..., 0]) ** 2 + (across / half[..., 1]) ** 2 <= 1.0)


_CIRCLES = np.array(
    [[x, y, np.log(r), np.log(r), 0.0] for x, y, r in product(_CENTRES, _CENTRES, _RADII)]
)
_ELLIPSES = np.concatenate(
    [
        _CIRCLES,
        *(
            _CIRCLES + [0.0, 0.0, 0.5 * np.log(_STRETCHED), -0.5 * np.log(_STRETCHED), turn]
            for turn in _DIRECTIONS
        ),
    ]
)
"""(m, 5) of all sizes all over an image."""


def _log_likelihood(residuals: Residuals, agrees: BoolArray) -> float:
    """Logarithm of how likely measures are, but for a constant.

    Points that do not agree count by their distance from the prediction of the others, up to a limit.

    Args:
        residuals: of all measures, with a covariance that includes everything that displaces them.
        agrees: (n,) those that determine the solution.
    """
    total, square = 0.0, np.zeros(int((~agrees).sum()))
    for covariance, misfit in zip(residuals.covariance, residuals.misfit.T, strict=True):
        lower = np.linalg.cholesky(covariance[np.ix_(agrees, agrees)])
        known = np.column_stack([residuals.design, misfit])[agrees]
        white = solve_triangular(lower, known, lower=True)
        parameters = np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0]
        left = white[:, -1] - white[:, :-1] @ parameters
        shared = solve_triangular(lower, covariance[np.ix_(agrees, ~agrees)], lower=True)
        variance = np.diagonal(covariance)[~agrees] - (shared**2).sum(axis=0)
        predicted = residuals.design[~agrees] @ parameters + shared.T @ left
        square += (misfit[~agrees] - predicted) ** 2 / variance
        total -= 0.5 * float((left**2).sum()) + float(np.log(np.diagonal(lower)).sum())
        total -= 0.5 * float(np.log(variance).sum())
    return total - 0.5 * float(np.minimum(square, _LIMIT**2).sum())
