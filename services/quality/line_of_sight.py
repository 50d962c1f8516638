"""The line of sight of a scene that its chips imply, compared with that of its model.

A slope shears each chip of a point by the difference between the directions of its view and of the
scene. The slope and the direction of the scene follow from several chips, without the model of the
scene. Residuals against height need heights that differ by more than their errors; slopes are seen on
level ground.
"""

from dataclasses import dataclass

import numpy as np

from amers.services.matching.chip_shears import ChipShears
from amers.services.types import Array, BoolArray, IntArray

_UNKNOWNS = 6
"""The direction, and the linear distortion of the image."""
_FEWEST = 12
"""Points that tell a direction."""
_APART = 0.1
"""Tangent by which two views of such a point see it from different directions, at least: one view, or
two that are alike, leave open whether a slope is steep or seen from the side."""
_LARGEST_SHEAR = 0.05
"""Of the chips of such a point: it displaces their borders by two pixels. The step of least squares from
which shears come falls short of larger ones."""
_SLOPE = 0.3
"""Slopes that are expected, one standard deviation: where scene and view see alike, nothing tells."""
_LEAST_SIGMA = 0.002
"""Of a shear, beside the noise of its chip: relief that is no plane."""
_LEAN_SIGMA = 0.04
"""Of an implied direction, tangent, that no number of points averages out."""
_DEGREES_OF_FREEDOM = 3.0
"""Of the distribution of the misfits of points, of which some are far off."""
_STEPS, _HALVINGS, _LONGEST_STEP, _SETTLED = 20, 4, 0.2, 1e-3
_LARGEST_SIGMA_DEG, _LARGEST_LEAN = 3.0, 1.5
"""Of a direction that is told: its largest standard deviation, and the tangent of the largest angle from
the vertical at which images are taken. Where slopes hardly rise above the noise, what views share of it
draws the direction aside."""
MOST_CHANCE = 1e-5
"""A direction beside that of the model that chance explains with a larger probability is none."""


@dataclass(frozen=True)
class ImpliedSight:
    """The line of sight that chips imply.

    Attributes:
        angle_deg: between it and that of the model.
        sigma_deg: one standard deviation.
        chance: probability of an implied direction as far from that of the model, if this is true.
        points: that tell it.
    """

    angle_deg: float
    sigma_deg: float
    chance: float
    points: int


def implied_sight(shears: ChipShears, lean: Array) -> ImpliedSight | None:
    """The line of sight that shears of chips imply; None where they hardly tell.

    Least squares over the slopes of all points, the direction of the scene and a linear distortion of
    the image; robust (Student's distribution), because much of what shears a chip is no slope. The
    slopes are eliminated: Golub and Pereyra (1973), with the derivative of Kaufman (1975).

    Args:
        shears: of views of points.
        lean: (v, 2) by which the model displaces ground at their points, see `ChipShears`.
    """
    tells = _tell(shears)
    shears, lean = shears.take(tells), lean[tells]
    start = np.flatnonzero(np.diff(shears.point, prepend=-1))
    n = len(start)
    if n < _FEWEST:
        return None
    views = np.diff(start, append=len(shears.point))
    weight = 1.0 / (shears.sigma**2 + _LEAST_SIGMA**2)
    sheared = _Sheared(lean - shears.lean, shears.gradient, weight, start, views)
    offset, covariance = sheared.direction()
    covariance = n / (n - _UNKNOWNS) * covariance + _LEAN_SIGMA**2 * np.eye(2)
    mean, sigma_deg = lean.mean(axis=0), np.degrees(np.sqrt(np.trace(covariance) / 2.0))
    if not sigma_deg <= _LARGEST_SIGMA_DEG or np.hypot(*(mean + offset)) > _LARGEST_LEAN:
        return None
    square = float(offset @ np.linalg.solve(covariance, offset))
    of_model, implied = np.array([*mean, 1.0]), np.array([*(mean + offset), 1.0])
    cosine = of_model @ implied / np.linalg.norm(of_model) / np.linalg.norm(implied)
    return ImpliedSight(
        angle_deg=float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        sigma_deg=float(sigma_deg),
        chance=float(np.exp(-square / 2.0)),
        points=n,
    )


def _tell(shears: ChipShears) -> BoolArray:
    """Views (v,) of the points that views see from different directions, on gentle slopes."""
    count = np.maximum(np.bincount(shears.point), 1)
    mean = np.stack([np.bincount(shears.point, lean) / count for lean in shears.lean.T], axis=1)
    away, largest = np.zeros(len(count)), np.zeros(len(count))
    np.maximum.at(away, shears.point, np.hypot(*(shears.lean - mean[shears.point]).T))
    np.maximum.at(largest, shears.point, np.linalg.norm(shears.gradient, axis=(1, 2)))
    return np.asarray(((away >= _APART / 2.0) & (largest <= _LARGEST_SHEAR))[shears.point])


@dataclass(frozen=True)
class _Sheared:
    """Shears of v views of n points.

    Attributes:
        apart: (v, 2) by which the scene displaces ground more than the view, by its model.
        gradient: (v, 2, 2) see `ChipShears`.
        weight: (v,) of the views.
        start, views: (n,) first views of the points, and their numbers.
    """

    apart: Array
    gradient: Array
    weight: Array
    start: IntArray
    views: IntArray

    def direction(self) -> tuple[Array, Array]:
        """Offset (2,) of the implied direction from that of the model, and its covariance (2, 2)."""
        offset, scale = np.zeros(2), np.inf
        here = self._near(offset)
        misfit, covariance = here.misfit(np.ones(len(self.start))), np.zeros((2, 2))
        for _ in range(_STEPS):
            scale = max(min(scale, float(np.median(misfit)) / 3.0), 1e-12)
            robust = 1.0 / (1.0 + misfit / (_DEGREES_OF_FREEDOM * scale))
            step, covariance = here.step(robust)
            step *= min(1.0, _LONGEST_STEP / max(float(np.hypot(*step)), 1e-12))
            before = _loss(misfit, scale)
            for _ in range(_HALVINGS):
                there = self._near(offset + step)
                misfit = there.misfit(robust)
                if _loss(misfit, scale) <= before:
                    break
                step = step / 2.0
            here, offset = there, offset + step
            if np.hypot(*step) < _SETTLED:
                break
        return offset, covariance

    def of_points(self, values: Array) -> Array:
        """Sums (n, ...) over the views of each point."""
        return np.asarray(np.add.reduceat(values, self.start))

    def of_views(self, values: Array) -> Array:
        """Values (n, ...) of the points, for each of their views."""
        return np.repeat(values, self.views, axis=0)

    def _near(self, offset: Array) -> "_Linearised":
        """What slopes do not explain of the shears, near a direction that is off (2,)."""
        apart = self.apart + offset
        square = self.of_points(self.weight * (apart**2).sum(axis=1)) + 1.0 / _SLOPE**2

        def explained(values: Array) -> Array:
            """Slopes (v, ...) that explain the most of values (v, 2, ...)."""
            sums = self.of_points(np.einsum("v,va,va...->v...", self.weight, apart, values))
            return self.of_views(sums / square.reshape(-1, *[1] * (sums.ndim - 1)))

        slope = explained(self.gradient)
        design = np.zeros((len(apart), 2, 2, _UNKNOWNS))
        for k in range(2):
            design[:, k, :, k] = slope
            for j in range(2):
                design[:, k, j, 2 + 2 * k + j] = 1.0
        left, beside = (
            values - np.einsum("va,v...->va...", apart, explained(values))
            for values in (self.gradient, design)
        )
        return _Linearised(self, left.reshape(-1, 4), beside.reshape(-1, 4, _UNKNOWNS))


@dataclass(frozen=True)
class _Linearised:
    """What slopes do not explain of shears, and how it changes with the direction and the distortion.

    Attributes:
        sheared: of v views.
        left: (v, 4) of the shears.
        design: (v, 4, 6) derivatives.
    """

    sheared: _Sheared
    left: Array
    design: Array

    def misfit(self, robust: Array) -> Array:
        """Squares (n,) of the misfits of points beside the distortion that weights (n,) of them give."""
        parameters = np.zeros(_UNKNOWNS)
        normal, right = self._normal(robust)
        parameters[2:] = np.linalg.pinv(normal[2:, 2:]) @ right[2:]
        rest = self.left - self.design @ parameters
        return self.sheared.of_points(self.sheared.weight * (rest**2).sum(axis=1))

    def step(self, robust: Array) -> tuple[Array, Array]:
        """Change (2,) of the direction by weights (n,) of the points, and its covariance (2, 2)."""
        normal, right = self._normal(robust)
        inverse = np.linalg.pinv(normal)
        parameters = inverse @ right
        rest = self.left - self.design @ parameters
        of_views = np.einsum("v,vai,va->vi", self.sheared.weight, self.design, rest)
        scores = robust[:, None] * self.sheared.of_points(of_views)
        return parameters[:2], (inverse @ (scores.T @ scores) @ inverse)[:2, :2]

    def _normal(self, robust: Array) -> tuple[Array, Array]:
        weighted = (self.sheared.weight * self.sheared.of_views(robust))[:, None, None] * self.design
        flat, design = weighted.reshape(-1, _UNKNOWNS), self.design.reshape(-1, _UNKNOWNS)
        return flat.T @ design, flat.T @ self.left.ravel()


def _loss(misfit: Array, scale: float) -> float:
    return float(np.log1p(misfit / (_DEGREES_OF_FREEDOM * scale)).sum())
