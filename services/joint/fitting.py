"""Selection of the scenes that fit their block; a scene that does not fit is removed by name."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.adjustment.known_images import KnownImages
from amers.services.errors import ComputationError, DoesNotFit
from amers.services.joint.block import JointBlock, adjust_together
from amers.services.joint.measured import MeasuredScene
from amers.services.registration.options import RegistrationOptions
from amers.services.types import BoolArray, IntArray, Observations

LEAST_USED = 0.6
"""Share of the measures of a scene that agree, of a scene that fits."""
LARGEST_RATIO = 2.0
"""Residuals of a scene that fits over those of the middle scene."""
_ENOUGH = 4
"""Control points, or tie points, that tell whether a scene fits; with control points, these place it."""
_ENOUGH_TIES = 12
"""Tie points that place a scene without control points: a few of them may be wrong."""


@dataclass(frozen=True)
class Left:
    """A scene that left its block.

    Attributes:
        measured: the scene.
        error: why, for people.
    """

    measured: MeasuredScene
    error: DoesNotFit


@dataclass(frozen=True)
class SceneFit:
    """How the measures of a scene fit their block.

    Attributes:
        ties, used_ties: tie points observed, and of them those that agree.
        control, used_control: the same for control points.
        normalised: residuals of those that agree, in units of their stated sigmas, root mean square.
    """

    ties: int
    used_ties: int
    control: int
    used_control: int
    normalised: float

    @property
    def used(self) -> float:
        """Share of the measures that agree: the smaller of ties and control, where there are enough."""
        shares = [
            used / count
            for used, count in ((self.used_ties, self.ties), (self.used_control, self.control))
            if count >= _ENOUGH
        ]
        return min(shares, default=0.0)


def adjust_fitting(
    scenes: Sequence[MeasuredScene],
    ties: Observations,
    options: RegistrationOptions,
    neighbour: KnownImages | None = None,
) -> tuple[JointBlock, list[Left]]:
    """The block of the scenes that fit, and those that have left, in the order of leaving.

    Raises:
        ComputationError: no two scenes, or no scene with control points, fit.
    """
    kept = list(range(len(scenes)))
    left: list[Left] = []
    adjusted = set(neighbour.names) if neighbour else set()

    def leave(number: int, why: str) -> None:
        measured = scenes[kept.pop(number)]
        if measured.name not in adjusted:
            left.append(Left(measured, DoesNotFit(f"{measured.name}: {why}")))

    while True:
        present = [scenes[number] for number in kept]
        own = ties_between(ties, kept)
        counts = np.bincount(own.image, minlength=len(present))
        own_control = np.array([int(one.usable.sum()) for one in present])
        held = counts + own_control - np.where(own_control > 0, _ENOUGH, _ENOUGH_TIES)
        if present and held.min() < 0:
            number = int(np.argmin(held))
            leave(
                number,
                f"{counts[number]} tie points and {own_control[number]} control points found, "
                f"{_ENOUGH_TIES} of the first expected or {_ENOUGH} of both: check that its model is "
                "that of the image, and that its ground is that of the other scenes",
            )
            continue
        if all(one.name in adjusted or not one.usable.any() for one in present) and not (
            adjusted.intersection(one.name for one in present)
        ):
            raise left[-1].error if left else DoesNotFit("no scene shows a control point")
        try:
            block = adjust_together(present, own, options, neighbour=neighbour)
        except ComputationError as error:
            if all(one.name in adjusted for one in present[1:]):
                raise
            leave(
                _least_trusted(present, counts, adjusted), f"the block has no solution with it ({error})"
            )
            continue
        fits = [scene_fit(block, number) for number in range(len(present))]
        odd = _oddest(fits, np.array([one.name not in adjusted for one in present]))
        if odd is None or len(present) == 1:
            return block, left
        leave(odd, _why(fits, odd))


def ties_between(ties: Observations, kept: Sequence[int]) -> Observations:
    """The observations of tie points that two or more of some scenes show, numbered by these scenes."""
    place = np.full(int(ties.image.max(initial=-1)) + 1 + len(kept), -1)
    inside = [number for number in kept if number < len(place)]
    place[inside] = [kept.index(number) for number in inside]
    own = ties.take(place[ties.image] >= 0)
    own = own.take(np.bincount(own.point, minlength=1)[own.point] >= 2)
    point = np.unique(own.point, return_inverse=True)[1].astype(np.int64)
    return Observations(point, place[own.image], own.line_sample, own.sigma_px)


def scene_fit(block: JointBlock, number: int) -> SceneFit:
    """How the measures of a scene fit."""
    rows = block.of_ties(number)
    used = rows[block.adjustment.active[rows]]
    control = block.at[number][block.active(number)[block.rows[number]]]
    both: IntArray = np.concatenate([used, control])
    residual = block.adjustment.residual_px[both]
    sigma_px = np.concatenate([block.ties.sigma_px[used], _sigmas(block, number)])
    square = (residual**2).sum(axis=1) / (2.0 * sigma_px**2)
    return SceneFit(
        ties=len(rows),
        used_ties=len(used),
        control=len(block.rows[number]),
        used_control=len(control),
        normalised=float(np.sqrt(square.mean())) if len(square) else float("nan"),
    )


def _sigmas(block: JointBlock, number: int) -> np.ndarray:
    """Stated sigmas of the measures of the active control points of a scene, pixels."""
    sigma_px = block.scenes[number].search.matches.sigma_px
    return np.asarray(sigma_px[block.active(number)])


def _ratios(fits: Sequence[SceneFit]) -> np.ndarray:
    normalised = np.array([fit.normalised for fit in fits])
    return np.asarray(normalised / max(float(np.nanmedian(normalised)), 1e-9))


def _oddest(fits: Sequence[SceneFit], may_leave: BoolArray) -> int | None:
    """The scene that fits worst, if it does not fit."""
    used, ratio = np.array([fit.used for fit in fits]), np.nan_to_num(_ratios(fits), nan=1.0)
    worst = np.maximum((LEAST_USED / np.maximum(used, 1e-3)), ratio / LARGEST_RATIO)
    number = int(np.argmax(np.where(may_leave, worst, 0.0)))
    return number if may_leave[number] and worst[number] > 1.0 else None


def _why(fits: Sequence[SceneFit], number: int) -> str:
    fit, ratio = fits[number], float(_ratios(fits)[number])
    if fit.used < LEAST_USED:
        return (
            f"{fit.used_ties} of {fit.ties} tie points and {fit.used_control} of {fit.control} control "
            f"points agree with the other scenes, at least {LEAST_USED:.0%} of each expected: clouds, "
            "changes, or a wrong model"
        )
    return (
        f"its residuals are {ratio:.1f} times the median of the scenes, at most {LARGEST_RATIO:g} times "
        "expected: its model is bent, or belongs to another image"
    )


def _least_trusted(scenes: Sequence[MeasuredScene], ties: IntArray, adjusted: set[str]) -> int:
    """The scene to leave first when there is no solution: one without a solution of its own.

    Of those that have one, it is that whose own points disagree most with it.
    """
    doubt = [
        -1.0
        if measured.name in adjusted
        else 1e6 - float(count)
        if measured.alone is None
        else measured.alone.sigma0
        for measured, count in zip(scenes, ties, strict=True)
    ]
    return int(np.argmax(doubt))
