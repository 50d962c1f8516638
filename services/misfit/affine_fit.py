"""Weighted and robust fits of an affine displacement, with an offset for each block of points."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from amers.services.misfit.robust import MAD_TO_STD, ROUNDING, likeliest_variance
from amers.services.misfit.robust_kernel import reweighted_solution
from amers.services.types import Array, BoolArray

Order = Literal["shift", "drift", "affine"]
ORDERS: tuple[Order, ...] = ("shift", "drift", "affine")

FREE: dict[Order, BoolArray] = {
    "shift": np.array([[True, False, False], [True, False, False]]),
    "drift": np.array([[True, True, False], [True, False, True]]),
    "affine": np.ones((2, 3), dtype=bool),
}

_MUCH_BETTER = 0.5
"""Below this ratio of residuals to declared sigmas, the points are better than declared."""

_MAD_SPREAD = 1.16
"""Relative standard deviation of a robust scale of n normal residuals, times the square root of n."""


@dataclass(frozen=True)
class AffineFit:
    """Misfits that an affine displacement has to explain; the two coordinates are independent.

    The parameters of a solution are (2, 3 + b): constant, along lines, along samples, and an offset for
    each of b blocks.

    Attributes:
        t: (n, 2) positions, -1 to 1 over the image.
        misfit: (n, 2) pixels.
        variance: (n, 2) px^2.
        member: (n, b) 1 where a point belongs to a block, else 0; b is 0 where all belong to one.
        offset_px: (2, b) a priori standard deviation of the offsets.
    """

    t: Array
    misfit: Array
    variance: Array
    member: Array
    offset_px: Array

    @cached_property
    def design(self) -> Array:
        """Derivative (n, 3 + b) of each coordinate by its parameters."""
        return np.column_stack([np.ones(len(self.t)), self.t, self.member])

    @cached_property
    def products(self) -> Array:
        """Products (n, (3 + b)^2) of the derivatives by each two parameters."""
        return (self.design[:, :, None] * self.design[:, None, :]).reshape(len(self.t), -1)

    @cached_property
    def sigma(self) -> Array:
        """(n, 2) pixels."""
        return np.sqrt(self.variance)

    def estimated(self, free: BoolArray) -> BoolArray:
        """Which parameters (2, 3 + b) are estimated, where some (2, 3) of the correction are free."""
        return np.column_stack([free, np.ones_like(self.offset_px, dtype=bool)])

    def expected(self, slope_px: float) -> Array:
        """A priori weight (2, 3 + b) of the parameters."""
        return np.column_stack([np.zeros(2), np.full((2, 2), slope_px**-2.0), self.offset_px**-2.0])

    def with_empirical_variance(
        self, parameters: Array, active: BoolArray, of_points: Array
    ) -> "AffineFit":
        """The same fit with smaller variances, where residuals are much smaller than declared."""
        if self.raw_scale(parameters, active) >= _MUCH_BETTER:
            return self
        variance = self.variance.copy()
        own = (variance - of_points)[active]
        variance[active] = likeliest_variance(self.residual(parameters)[active], own, of_points[active])
        return replace(self, variance=variance)

    def clipped(self, parameters: Array, most: float) -> "AffineFit":
        """The same fit whose residuals from a solution are at most some standard deviations."""
        computed = self.design @ parameters.T
        residual = np.clip(self.misfit - computed, -most * self.sigma, most * self.sigma)
        return replace(self, misfit=computed + residual)

    def scaled(self, factor: float) -> "AffineFit":
        """The same fit with its variances multiplied by a factor."""
        return replace(self, variance=self.variance * factor)

    def solution(
        self,
        active: BoolArray,
        free: BoolArray,
        slope_px: float = np.inf,
    ) -> tuple[Array, Array]:
        """Parameters (2, 3 + b) and covariance (2, 3 + b, 3 + b), zero where not free.

        Args:
            active: (n,) measures that are used.
            free: (2, 3) parameters that are estimated.
            slope_px: a priori standard deviation of drift and skew.
        """
        weight = 1.0 / self.variance[active].T
        normal = weight @ self.products[active]
        right = (weight * self.misfit[active].T) @ self.design[active]
        inverse = inverse_normal(
            normal.reshape(2, *self.design.shape[1:] * 2), self.expected(slope_px), self.estimated(free)
        )
        return (inverse @ right[:, :, None])[:, :, 0], inverse

    def likeliest_slope_px(self, active: BoolArray, unit: float, least_px: float) -> float:
        """The a priori sigma of drift and skew that makes their estimates most likely.

        Args:
            active: (n,) measures.
            unit: standard deviation of unit weight.
            least_px: smallest sigma.
        """
        parameters, covariance = self.solution(active, FREE["affine"])
        slope = parameters[:, 1:3].ravel()
        variance = unit**2 * np.diagonal(covariance, 0, 1, 2)[:, 1:3].ravel()
        spread_px = least_px * np.geomspace(1.0, 1000.0, 121)
        total = variance + spread_px[:, None] ** 2
        likelihood = -(np.log(total) + slope**2 / total).sum(axis=1)
        return float(spread_px[np.argmax(likelihood)])

    def freedom(self, active: BoolArray, free: BoolArray, slope_px: float, covariance: Array) -> float:
        """Degrees of freedom of the residuals: a parameter that its prior determines takes none."""
        by_prior = float((np.diagonal(covariance, 0, 1, 2) * self.expected(slope_px)).sum())
        return 2.0 * int(active.sum()) - int(self.estimated(free).sum()) + by_prior

    def residual(self, parameters: Array) -> Array:
        """(n, 2) pixels."""
        return np.asarray(self.misfit - self.design @ parameters.T)

    def magnitude(self, parameters: Array) -> Array:
        """(n,) the larger of the two normalised residuals."""
        return np.asarray(np.abs(self.residual(parameters) / self.sigma).max(axis=1))

    def raw_scale(self, parameters: Array, active: BoolArray) -> float:
        """Robust standard deviation of the normalised residuals, as they are."""
        return _robust_std(np.abs(self.residual(parameters) / self.sigma)[active])

    def scale(self, parameters: Array, active: BoolArray, free: BoolArray) -> float:
        """Robust standard deviation of unit weight.

        Parameters make residuals smaller than errors. A scale below one that chance explains is one: few
        measures that agree by chance do not make the others look wrong.
        """
        count = 2.0 * int(active.sum())
        freedom = max(count - int(self.estimated(free).sum()), 1.0)
        scale = self.raw_scale(parameters, active) * float(np.sqrt(count / freedom))
        by_chance = 1.0 - 2.0 * _MAD_SPREAD / np.sqrt(freedom)
        return 1.0 if by_chance < scale < 1.0 else scale

    def robust_solution(self, active: BoolArray, free: BoolArray) -> Array:
        """Parameters (2, 3 + b) by iterative re-weighting that starts at the median shift."""
        return reweighted_solution(
            self.design[active],
            np.ascontiguousarray(self.misfit[active].T),
            np.ascontiguousarray(self.sigma[active].T),
            self.expected(np.inf),
            self.estimated(free),
        )

    def spread(self, active: BoolArray) -> float:
        """Standard deviation of the positions along the axis where it is smallest."""
        return float(self.t[active].std(axis=0).min())


def inverse_normal(normal: Array, expected: Array, estimated: BoolArray) -> Array:
    """Inverse (2, k, k) of normal matrices with a priori weights (2, k); zero where not estimated."""
    both = estimated[:, :, None] & estimated[:, None, :]
    filled = np.where(both, normal, 0.0)
    diagonal = np.einsum("ijj->ij", filled)
    rounding = ROUNDING * np.einsum("ijj->i", normal)[:, None]
    diagonal[:] = np.where(estimated, diagonal + expected + rounding, 1.0)
    return np.asarray(np.linalg.inv(filled) * both)


def _robust_std(magnitude: Array) -> float:
    """Robust standard deviation of residuals, from their magnitudes."""
    return max(float(MAD_TO_STD * np.median(magnitude)), 1e-9)
