"""The correction with a profile along the lines: estimate and covariance by universal kriging."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.adjustment.line_profile import Component, with_components
from services.adjustment.structure import Residuals
from services.sensors.correction import LineProfile
from services.types import Array, BoolArray

_MEDIAN_OF_LARGER = 1.0512
"""Median of the larger of two magnitudes of the standard normal law."""
_AS_BAD = 0.8
"""Share of the worst residual from which on measures are dropped with it."""
_NODES_A_PERIOD = 32
_NODES_A_LENGTH = 8
_FEWEST_NODES, _MOST_NODES = 65, 1025


@dataclass(frozen=True)
class ProfileSolution:
    """A correction with a profile.

    Attributes:
        parameters: (2, k) of the design.
        covariance: (2, k, k) of them.
        profile: along the lines.
    """

    parameters: Array
    covariance: Array
    profile: LineProfile


def agreeing_with(
    residuals: Residuals, components: Sequence[Component], expected: Array, tolerance: float
) -> BoolArray:
    """Measures (n,) that lie within a tolerance of what the others predict of them, one by one.

    Args:
        residuals: of all measures.
        components: of the profile.
        expected: (2, k) a priori weights of the parameters.
        tolerance: standard deviations.
    """
    full = with_components(residuals, components)
    kept = np.arange(len(residuals.misfit))
    while len(kept) > residuals.design.shape[1] + 2:
        magnitude = np.zeros(len(kept))
        for k in range(2):
            inverse = np.linalg.inv(full.covariance[k][np.ix_(kept, kept)])
            design = full.design[kept]
            weighted = inverse @ design
            normal = design.T @ weighted + np.diag(expected[k])
            projection = inverse - weighted @ np.linalg.pinv(normal, hermitian=True) @ weighted.T
            precision = np.maximum(np.diagonal(projection), 1e-12)
            left_out = (projection @ full.misfit[kept, k]) / np.sqrt(precision)
            magnitude = np.maximum(magnitude, np.abs(left_out))
        worst = float(magnitude.max())
        if worst <= tolerance * max(float(np.median(magnitude)) / _MEDIAN_OF_LARGER, 1e-9):
            break
        # The worst spoils what is predicted of its neighbours; others as bad are wrong by themselves.
        kept = kept[magnitude < _AS_BAD * worst]
    agrees = np.zeros(len(residuals.misfit), dtype=bool)
    agrees[kept] = True
    return agrees


def solve_profile(
    residuals: Residuals, components: Sequence[Component], expected: Array, last_line: float
) -> ProfileSolution:
    """Estimate and covariance of parameters and profile.

    Args:
        residuals: of the active measures, whose covariance holds all their errors.
        components: of the profile.
        expected: (2, k) a priori weights of the parameters.
        last_line: of the image; the profile reaches from line 0 to it.
    """
    line = residuals.line_sample[:, 0]
    nodes = _nodes(components, line, last_line)
    full = with_components(residuals, components)
    parameters, covariance, displacement, variance, cross = [], [], [], [], []
    for k in range(2):
        inverse = np.linalg.inv(full.covariance[k])
        weighted = inverse @ full.design
        own = np.linalg.pinv(full.design.T @ weighted + np.diag(expected[k]), hermitian=True)
        value = own @ (weighted.T @ full.misfit[:, k])
        seen = np.zeros((len(nodes), len(line)))
        unseen = np.zeros(len(nodes))
        for component in components:
            of_both = component.variance_px2[k] / component.seen
            seen += of_both * component.correlation(nodes, line)
            unseen += of_both / component.seen * np.diag(component.correlation(nodes, nodes))
        gain = seen @ inverse
        moved = gain @ full.design
        parameters.append(value)
        covariance.append(own)
        displacement.append(gain @ (full.misfit[:, k] - full.design @ value))
        spread = unseen - (gain * seen).sum(axis=1) + ((moved @ own) * moved).sum(axis=1)
        variance.append(np.maximum(spread, 0.0))
        cross.append(-(moved @ own)[:, :3])
    profile = LineProfile(
        nodes, np.stack(displacement, axis=-1), np.stack(variance, axis=-1), np.stack(cross, axis=1)
    )
    return ProfileSolution(np.array(parameters), np.array(covariance), profile)


def joined(covariance: Array) -> Array:
    """Covariance (6, 6) of the parameters of line and sample, from those of each (2, k, k)."""
    both = np.zeros((6, 6))
    both[:3, :3], both[3:, 3:] = covariance[:, :3, :3]
    return both


def _nodes(components: Sequence[Component], line: Array, last_line: float) -> Array:
    """Lines (k,) of the nodes: close enough for the shortest component, and at the points."""
    low, high = min(0.0, float(line.min())), max(last_line, float(line.max()))
    steps = [
        one.at_px / _NODES_A_PERIOD if one.kind == "period" else one.length_px / _NODES_A_LENGTH
        for one in components
        if one.kind != "step"
    ]
    count = (high - low) / min(steps, default=high - low)
    even = np.linspace(low, high, int(np.clip(count, _FEWEST_NODES, _MOST_NODES)))
    gaps = [
        edge
        for one in components
        if one.kind == "step"
        for edge in (one.at_px, one.at_px + one.length_px)
    ]
    return np.unique(np.concatenate([even, gaps]))
