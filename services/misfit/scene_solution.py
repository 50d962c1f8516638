"""Final least-squares solution of a scene, with known inliers and known errors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from amers.services.misfit.affine_fit import AffineFit
from amers.services.misfit.bends import bends
from amers.services.misfit.displacement_components import Component, unit_variance, with_components
from amers.services.misfit.displacement_solution import joined, solve_displacement
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.shared_errors import SharedErrors
from amers.services.misfit.structure import Residuals
from amers.services.misfit.unseen_seams import unseen_seams
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.types import Array, BoolArray


@dataclass(frozen=True)
class SceneSolution:
    """Estimate and covariance of a correction.

    Attributes:
        parameters: (2, k), of which the first three of each coordinate are affine.
        covariance: (6, 6) of the affine ones.
        displacement: beyond them; None for an affine correction.
        sigma0: standard deviation of unit weight.
    """

    parameters: Array
    covariance: Array
    displacement: DisplacementGrid | None
    sigma0: float


@dataclass(frozen=True)
class AgreeingMeasures:
    """The measures of a scene that agree, and how they err.

    Attributes:
        measured: the n measures.
        fit: of them, with the variances that they show.
        declared: with those that are stated.
        active: (n,) those that agree.
        shared: errors that neighbours share.
        tolerance: within which they agree, standard deviations.
    """

    measured: PlacedMeasures
    fit: AffineFit
    declared: AffineFit
    active: BoolArray
    shared: SharedErrors
    tolerance: float

    def affine(self, free: BoolArray, slope_px: float) -> SceneSolution:
        """The affine correction.

        Args:
            free: (2, k) parameters that are estimated.
            slope_px: a priori standard deviation of drift and skew at the edge of the image.
        """
        active, factor = self.active, self.shared.factor
        parameters, _ = self.fit.scaled(factor).solution(active, free, slope_px)
        of_errors = self.shared.covariance(
            self.measured.position[active], self.measured.overlapping[np.ix_(active, active)]
        )
        covariance = _covariance(
            self.declared.scaled(factor), active, free, slope_px, of_errors / factor
        )
        sigma0 = _sigma0(self.declared, active, free, slope_px, _kept_variance(self.tolerance))
        return SceneSolution(parameters, covariance, None, sigma0)

    def displaced(self, expected: Array, components: Sequence[Component]) -> SceneSolution:
        """The correction with a displacement of some components; `expected` (2, k) weighs parameters."""
        moving = self._as_shown(components)
        solution = solve_displacement(self._told(), moving, expected, self.measured.shape)
        stated = [one.scaled(self._stated) for one in components]
        chi2 = unit_variance(
            with_components(self.measured.residuals(self.declared, self.active), stated)
        )
        return SceneSolution(
            solution.parameters,
            joined(solution.covariance),
            solution.displacement,
            float(np.sqrt(chi2 / _kept_variance(self.tolerance))),
        )

    def left_open(self, expected: Array, components: Sequence[Component]) -> tuple[Component, ...]:
        """What the measures leave open beside some components: bends, and seams beyond the points."""
        moving, told, shape = self._as_shown(components), self._told(), self.measured.shape
        return (
            *bends(with_components(told, moving), expected, shape),
            *unseen_seams(components, told.line_sample[:, 1], shape[1]),
        )

    def _told(self) -> Residuals:
        """The residuals with all their errors."""
        return self.measured.residuals(self.declared, self.active, self.shared)

    @property
    def _stated(self) -> float:
        """Variance that the measures state over the one that they show."""
        return float(np.mean((self.declared.variance / self.fit.variance)[self.active]))

    def _as_shown(self, components: Sequence[Component]) -> list[Component]:
        """Components with as much motion as the sigmas state, in the proportion that residuals show."""
        factor, unit = self._stated * self.shared.factor, 1.0
        if any(one.along == "image" for one in components):
            # An ortho-image is displaced by what is seen, even if measures are better than they state.
            residuals = self.measured.residuals(self.fit, self.active)
            unit = min(1.0, unit_variance(with_components(residuals, components)))
        return [one.scaled(factor * (unit if one.along == "image" else 1.0)) for one in components]


def _kept_variance(tolerance: float) -> float:
    """Variance that a normal law of unit variance keeps within a tolerance on both sides."""
    density = np.exp(-0.5 * tolerance**2) / np.sqrt(2.0 * np.pi)
    return float(1.0 - 2.0 * tolerance * density / (2.0 * ndtr(tolerance) - 1.0))


def _sigma0(
    fit: AffineFit, active: BoolArray, free: BoolArray, slope_px: float, kept_variance: float
) -> float:
    """Standard deviation of unit weight; 1 without redundancy."""
    parameters, covariance = fit.solution(active, free, slope_px)
    chi2 = float((fit.residual(parameters)[active] ** 2 / fit.variance[active]).sum())
    freedom = fit.freedom(active, free, slope_px, covariance)
    return float(np.sqrt(chi2 / freedom / kept_variance)) if freedom > 0 else 1.0


def _covariance(
    fit: AffineFit, active: BoolArray, free: BoolArray, slope_px: float, correlation: Array
) -> Array:
    """Covariance (6, 6) of the parameters of a weighted solution whose errors are correlated."""
    _, independent = fit.solution(active, free, slope_px)
    covariance = np.zeros((6, 6))
    for k, expected in enumerate(fit.expected(slope_px)):
        weighted = fit.design[active] / fit.sigma[active, k, None]
        spread = weighted.T @ correlation @ weighted + np.diag(expected)
        covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = (independent[k] @ spread @ independent[k])[
            :3, :3
        ]
    return covariance
