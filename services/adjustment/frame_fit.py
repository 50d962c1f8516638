"""Translation of an adjusted block onto known ground, and the accuracy of its frame afterwards."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.parameters import frame_weight
from amers.services.errors import NoConsensus
from amers.services.geodesy import metres_per_degree_at
from amers.services.misfit.robust import CAUCHY_TUNING
from amers.services.types import Array, BoolArray, Frame

_AGREES = 0.9999
"""Probability of a smaller misfit of known ground that is right."""
_ROBUST_STEPS = 20
_UNKNOWN_M = 1e5
"""Standard deviation of a coordinate that nothing tells."""
_SHARED_BY_ALL = 0.5
"""Share of what neighbouring points of the block have in common that all known ground may show."""


@dataclass(frozen=True)
class FrameFit:
    """A block on known ground.

    Attributes:
        translation_m: (3,) east, north, up, that takes the block there; 0 for what nothing tells.
        frame: of the block after the translation.
        active: (c,) known ground that agrees.
        misfit_m: (c, 3) known minus found, after the translation; NaN for unknown coordinates.
    """

    translation_m: Array
    frame: Frame
    active: BoolArray
    misfit_m: Array


def fit_frame(frame: Frame, known: ControlGround, found: Array, covariance_m2: Array) -> FrameFit:
    """The most likely translation of a block, when known ground may be wrong.

    Known minus found is the translation, plus the error that its source shares, plus errors of its own.
    The stated frame of the block and those of the sources are their priors. A robust solution begins;
    then the worst misfit leaves, or the best comes back, until all that take part agree and no other
    does.

    Args:
        frame: of the block, as stated before.
        known: c positions on the Earth.
        found: (c, 3) the same points in the block.
        covariance_m2: (c, 3, 3) of these, relative to the frame of the block.

    Raises:
        NoConsensus: most of the known ground disagrees.
    """
    misfit_m = misfits_m(known, found)
    system = _System(frame, known, misfit_m, covariance_m2)
    active = system.robust_agreement()
    seen = [active]
    while True:
        ratio = system.ratio(active)
        changed = active.copy()
        worst = int(np.argmax(np.where(active, ratio, -np.inf)))
        best = int(np.argmin(np.where(active, np.inf, ratio)))
        if active[worst] and ratio[worst] > 1.0:
            changed[worst] = False
        elif not active[best] and ratio[best] < 1.0:
            changed[best] = True
        if any(np.array_equal(changed, before) for before in seen):
            break
        active = changed
        seen.append(active)
    if active.sum() * 2 <= len(known):
        names = ", ".join(name for name, agrees in zip(known.names, active, strict=True) if not agrees)
        raise NoConsensus(
            f"{int((~active).sum())} of {len(known)} control points disagree with the block and with "
            f"each other: {names}. State larger sigmas or a larger frame, or remove wrong points"
        )
    state, covariance = system.solution(active.astype(np.float64))
    told = np.sqrt(np.diagonal(covariance)[:3]) < _UNKNOWN_M
    own = covariance[:3, :3] + _SHARED_BY_ALL * frame.shared_m2
    translation_m = np.where(told, state[:3], 0.0)
    return FrameFit(
        translation_m,
        Frame(np.where(told[:, None] & told[None, :], (own + own.T) / 2.0, np.nan), frame.shared_m2),
        active,
        misfit_m - translation_m,
    )


def misfits_m(known: ControlGround, found: Array) -> Array:
    """Known minus found (c, 3), metres east, north, up; NaN for unknown coordinates."""
    difference = known.lon_lat_h - found
    difference[:, 0] -= 360.0 * np.round(difference[:, 0] / 360.0)
    metres = difference * np.column_stack([metres_per_degree_at(found), np.ones(len(found))])
    return np.where(known.known, metres, np.nan)


@dataclass(frozen=True)
class _System:
    """Normal equations of the translation and of the errors that sources share."""

    frame: Frame
    known: ControlGround
    misfit_m: Array
    covariance_m2: Array

    def solution(self, weight: Array) -> tuple[Array, Array]:
        """Translation and errors of the sources (3 + 3 s,), and their covariance, with weights (c,)."""
        size = 3 * (1 + len(self.known.frames))
        normal, right = 1e-2 / _UNKNOWN_M**2 * np.eye(size), np.zeros(size)
        normal[:3, :3] += frame_weight(self.frame.covariance_m2)
        for s, frame in enumerate(self.known.frames):
            rows = slice(3 + 3 * s, 6 + 3 * s)
            normal[rows, rows] += frame_weight(frame.covariance_m2 + frame.shared_m2)
        for i in range(len(self.known)):
            design, misfit, inverse = self._equation(i)
            normal += weight[i] * design.T @ inverse @ design
            right += weight[i] * design.T @ inverse @ misfit
        covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        return covariance @ right, covariance

    def _equation(self, i: int) -> tuple[Array, Array, Array]:
        """Design, misfit and inverse covariance of the known coordinates of one point."""
        inside = self.known.known[i]
        design = np.zeros((3, 3 * (1 + len(self.known.frames))))
        source = 3 + 3 * int(self.known.source[i])
        design[:, :3] = design[:, source : source + 3] = np.eye(3)
        own = np.where(np.isfinite(self.known.covariance_m2[i]), self.known.covariance_m2[i], 0.0)
        covariance = (own + self.covariance_m2[i])[np.ix_(inside, inside)]
        return design[inside], self.misfit_m[i][inside], np.linalg.inv(covariance)

    def _limit(self) -> Array:
        return np.asarray(chdtri(self.known.known_coordinates(), 1.0 - _AGREES))

    def ratio(self, active: BoolArray) -> Array:
        """Squares (c,) of misfits over their limits, each against what the others predict."""
        state, covariance = self.solution(active.astype(np.float64))
        square = np.empty(len(active))
        for i in range(len(active)):
            design, misfit, inverse = self._equation(i)
            predicted = design @ covariance @ design.T
            spread = np.linalg.inv(inverse) + (-predicted if active[i] else predicted)
            left = misfit - design @ state
            square[i] = float(left @ np.linalg.solve(spread, left))
        return square / self._limit()

    def robust_agreement(self) -> BoolArray:
        """Whether (c,) known ground agrees with a solution by Cauchy weights."""
        weight, freedom = np.ones(len(self.known)), self.known.known_coordinates()
        for _ in range(_ROBUST_STEPS):
            state, _ = self.solution(weight)
            square = np.empty(len(weight))
            for i in range(len(weight)):
                design, misfit, inverse = self._equation(i)
                left = misfit - design @ state
                square[i] = float(left @ inverse @ left)
            size = np.sqrt(square / np.maximum(freedom, 1))
            scale = max(1.0, float(np.median(size)))
            weight = 1.0 / (1.0 + (size / (CAUCHY_TUNING * scale)) ** 2)
        return np.asarray(square <= self._limit() * scale**2)
