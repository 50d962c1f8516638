"""The motion of lines and samples of a scene, from its measures and the breaks of its image."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.misfit.affine_fit import AffineFit
from amers.services.misfit.broken_image import placed_steps, steps_at_breaks
from amers.services.misfit.displacement_components import Component
from amers.services.misfit.displacement_solution import solve_displacement
from amers.services.misfit.placed_measures import PlacedMeasures
from amers.services.misfit.structure import Structure
from amers.services.sensors.correction import no_correction
from amers.services.types import Array, BoolArray, IntArray

_LEFT_OUT = 5
"""Measures that disagree with an affine correction, from which on a profile is looked for in all."""


@dataclass(frozen=True)
class SceneMotion:
    """What no affine correction follows.

    Attributes:
        components: of lines and samples that moved, which a displacement follows.
        along_axes: what is left along the axes.
        agreeing: (n,) measures that agree with the components.
    """

    components: tuple[Component, ...]
    along_axes: tuple[Structure, ...]
    agreeing: BoolArray

    def scaled(self, factor: float) -> "SceneMotion":
        """The same motion with the variances of its components multiplied by a factor."""
        return replace(self, components=tuple(one.scaled(factor) for one in self.components))


def what_moves(
    measured: PlacedMeasures,
    fit: AffineFit,
    start: Array,
    clipped: AffineFit,
    *,
    seen: BoolArray,
    active: BoolArray,
    breaks: IntArray | None,
    tolerance: float,
) -> SceneMotion:
    """What the measures show that no affine correction follows.

    Args:
        measured: the measures.
        fit: of them.
        start: (2, 3 + b) parameters of a robust solution.
        clipped: the fit, whose residuals from it are limited.
        seen: (n,) measures that there are.
        active: (n,) those that agree with an affine correction.
        breaks: first lines behind breaks of the image; None for none.
        tolerance: of the measures, standard deviations.
    """
    expected = fit.expected(np.inf)
    known: tuple[Component, ...] = ()
    if measured.scanned and breaks is not None and len(breaks):
        known = _known_steps(measured, fit, start, seen=seen, breaks=breaks, tolerance=tolerance)
        active = measured.agreeing(fit, seen, known, expected, tolerance)
    components, along_axes = measured.components(fit, active, known)
    first = components
    if not components and (seen & ~active).sum() >= _LEFT_OUT:
        # What lies beside a step agrees with itself, and was left out.
        components, _ = measured.components(clipped, seen)
    agreeing = active
    if components:
        # An affine correction may keep measures that are wrong beside what moves, and leave right ones.
        agreeing = measured.agreeing(fit, seen, components, expected, tolerance)
        again, left = measured.components(fit, agreeing, known)
        if again or not first:
            components, along_axes = again or components, left
            agreeing = measured.agreeing(fit, seen, components, expected, tolerance)
    return SceneMotion(components, along_axes, agreeing)


def _known_steps(
    measured: PlacedMeasures,
    fit: AffineFit,
    start: Array,
    *,
    seen: BoolArray,
    breaks: IntArray,
    tolerance: float,
) -> tuple[Component, ...]:
    """The steps at breaks of the image, placed by a correction that follows them."""
    affine = replace(no_correction(measured.shape), parameters=start[:, :3])
    steps, expected = steps_at_breaks(breaks, affine), fit.expected(np.inf)
    agreeing = measured.agreeing(fit, seen, steps, expected, tolerance)
    solution = solve_displacement(measured.residuals(fit, agreeing), steps, expected, measured.shape)
    parameters, displacement = solution.parameters[:, :3], solution.displacement
    followed = replace(affine, parameters=parameters, displacement=displacement)
    return placed_steps(breaks, steps, followed)
