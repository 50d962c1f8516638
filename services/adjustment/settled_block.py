"""Rounds of least squares and outlier rejection of a block, until neither changes."""

from dataclasses import dataclass, replace

import numpy as np

from amers.services.adjustment.block_accuracy import BlockAccuracy, block_accuracy
from amers.services.adjustment.block_gauge import Gauge
from amers.services.adjustment.block_parts import Parts, Weights, joined, same
from amers.services.adjustment.block_scale import LEAST_SCALE, check_scale, posterior_scale
from amers.services.adjustment.block_solution import (
    Solved,
    State,
    checked_gauge,
    least_squares,
    normals,
)
from amers.services.adjustment.control_check import agreeing_control
from amers.services.adjustment.parameters import BlockPriors
from amers.services.adjustment.part_tasks import judged_part
from amers.services.adjustment.robust_start import active_observations
from amers.services.tasks import Arrays
from amers.services.types import Array, BoolArray

_SLOPE_OBSERVATIONS = 0.3
"""Drifts and skews that what is stated of them counts for, when their variance is estimated. A pair
shows two, and those may be small by chance: counted for one, regions of 90 % hold 75 % where images
drift more."""
_STAGE = "rounds"
_ROUNDS = 15
_SETTLED = 0.02
"""Relative change of the scales at which they have settled."""


@dataclass(frozen=True)
class Weighing:
    """What the least squares of a round start from and weigh.

    Attributes:
        state: parameters and points.
        priors: of the parameters, their drifts and skews by `slope_factor`.
        scale: of the observations, over their sigmas.
        slope_factor: standard deviation of drifts and skews over what was stated.
        active: (m,) observations that are used.
        control_active: (c,) control points that are used.
    """

    state: State
    priors: BlockPriors
    scale: float
    slope_factor: float
    active: BoolArray
    control_active: BoolArray


@dataclass(frozen=True)
class Round:
    """Least squares, and what they tell.

    Attributes:
        solved: the last step.
        gauge: of its groups.
        accuracy: of its parameters.
        determined: (K,) share of every parameter that observations tell.
        before: what was weighed.
        after: what the next round would weigh.
    """

    solved: Solved
    gauge: Gauge
    accuracy: BlockAccuracy
    determined: Array
    before: Weighing
    after: Weighing

    def is_settled(self, previous: BoolArray) -> bool:
        """Whether another round would weigh the same; `previous` (m,) was used the round before."""
        used, active = self.before.active, self.after.active
        # Observations at the limit of the tolerance would come back and leave for ever: they stay out.
        again = np.array_equal(active, previous) and bool((used <= active).all())
        same = again or np.array_equal(active, used)
        now, before = ((one.scale, one.slope_factor) for one in (self.after, self.before))
        return (
            same
            and np.array_equal(self.after.control_active, self.before.control_active)
            and np.allclose(now, before, rtol=_SETTLED)
        )


def settled(parts: Parts, start: Weighing, *, once: bool) -> Round:
    """The last round: the one after which nothing changes, or the only one."""
    previous, now, first = start.active, start, 0
    if (kept := parts.kept(_STAGE)) is not None:
        previous, now, first = kept["previous"], _taken_up(start, kept), int(kept["done"])
    for done in range(first, _ROUNDS):
        last = _round(parts, now)
        if once or last.is_settled(previous):
            return last
        previous, now = now.active, last.after
        if done + 1 < _ROUNDS:
            _keep(parts, now, previous, done + 1)
    return replace(last, before=replace(last.before, slope_factor=now.slope_factor))


def _keep(parts: Parts, now: Weighing, previous: BoolArray, done: int) -> None:
    """Keep what a round begins with, after so many of them."""
    whole = {key: value for key, value in vars(now).items() if key not in ("state", "priors")}
    shape = now.priors.shape
    parts.keep(_STAGE, **vars(now.state), **whole, shape=shape, previous=previous, done=done)


def _taken_up(start: Weighing, kept: Arrays) -> Weighing:
    """What the round after an interruption begins with."""
    return Weighing(
        State(kept["values"], kept["lon_lat_h"], int(kept["iterations"])),
        replace(start.priors, shape=kept["shape"]),
        float(kept["scale"]),
        float(kept["slope_factor"]),
        kept["active"],
        kept["control_active"],
    )


def _round(parts: Parts, now: Weighing) -> Round:
    """Least squares of what is active, and what agrees with them."""
    problem = parts.problem
    scale = max(now.scale, LEAST_SCALE)
    weights = Weights(now.active / problem.scales(scale) ** 2, now.control_active.astype(np.float64))
    first = normals(parts, now.state.place, weights)
    gauge = checked_gauge(parts, first)
    solved = least_squares(parts, now.priors, gauge, first, now.state.iterations)
    state, priors = solved.state, solved.system.priors
    of_images = len(problem.images) * now.priors.size
    accuracy = block_accuracy(solved.system, parts.pairs, gauge, of_images)
    square, coordinates, told = judged(parts, solved, accuracy)
    determined = _determined(priors, accuracy.variance())
    computed = now.active & np.isfinite(square) & ~problem.by_hand
    # What people marked determines the parameters as well.
    own = float(determined.sum()) * float(computed.sum()) / max(float(now.active.sum()), 1.0)
    point = problem.observations.point
    scale = posterior_scale(square[computed], point[computed], coordinates, own)
    check_scale(scale)
    factor = _slope_factor(state.values.ravel(), priors, determined, now.slope_factor)
    after = Weighing(
        state,
        now.priors.with_slopes(factor),
        scale,
        now.slope_factor * factor,
        active_observations(
            problem, square, now.active, scale, now.control_active, coordinates=coordinates
        ),
        agreeing_control(problem.control.known_coordinates(), told, now.control_active),
    )
    return Round(solved, gauge, accuracy, determined, now, after)


def judged(parts: Parts, solved: Solved, accuracy: BlockAccuracy) -> tuple[Array, Array, Arrays]:
    """Squares (m,) of residuals, coordinates (p,) that rays determine, and what tells of the control."""
    known = len(parts.problem.control) > 0
    found = parts.each(
        judged_part,
        parts.at(solved.normals.at),
        parts.of_weights(solved.normals.weights),
        parts.at(solved.state.place),
        parts.of_pairs(accuracy.covariance()) if known else same(None),
    )
    keys = ("halves", "residual", "predicted") if known else ()
    told = {key: joined(parts.control, found, key) for key in keys}
    square = joined(parts.observations, found, "square")
    return square, joined(parts.points, found, "rays"), told


def _determined(priors: BlockPriors, variance: Array) -> Array:
    """Share (K,) of every parameter that observations determine, the rest being its prior."""
    return np.asarray(np.clip(1.0 - variance * priors.weight(), 0.0, 1.0))


def _slope_factor(values: Array, priors: BlockPriors, determined: Array, so_far: float) -> float:
    """By how much the standard deviation of drifts and skews changes (MacKay's fixed point)."""
    slopes = priors.estimated & (priors.shape > 0.0)
    if not slopes.any():
        return 1.0
    stated = priors.shape[slopes] * so_far**2
    found = float((values[slopes] ** 2 * stated).sum())
    shown = float(determined[slopes].sum())
    freedom = _SLOPE_OBSERVATIONS + shown
    # Few slopes tell their variance badly: regions of Student's law, relative to the normal law's.
    least = max(freedom, 1.0)
    few = least * (0.1 ** (-2.0 / least) - 1.0) / (2.0 * np.log(10.0))
    variance = (_SLOPE_OBSERVATIONS + found) / freedom * few
    # What is stated holds as far as not even one is shown: by one image on one control point, none.
    return float(np.sqrt(1.0 + min(shown, 1.0) * (variance - 1.0)) / so_far)
