"""Division of a large block into parts: groups of neighbouring images, with their points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from amers.services.adjustment.block_problem import BlockProblem
from amers.services.adjustment.dissection import Dissection, halved
from amers.services.adjustment.normal_equations import Pairs
from amers.services.adjustment.parameters import AdjustableImage
from amers.services.geodesy import continuous
from amers.services.tasks import Arrays, Work
from amers.services.types import Array, BoolArray, IntArray

PART_OBSERVATIONS = 60_000
"""Observations of a part, where it has more than one image: those of 200 images with 300 points each.
Their equations take 80 MiB (`python -m benchmarks.block_parts`)."""
_STAGE = "adjust"
"""Of the tasks, where efforts are counted."""


class Weights(NamedTuple):
    """Weights of image positions (m,) and of control points (c,)."""

    observations: Array
    control: Array


class Place(NamedTuple):
    """Where the equations of a step are linear.

    Attributes:
        values: (n, k) parameters of images and frames.
        lon_lat_h: (p, 3) points.
        step_m: (p, 3) how far points have moved from there, in the same equations; None for not at all.
    """

    values: Array
    lon_lat_h: Array
    step_m: Array | None = None


@dataclass(frozen=True)
class Part:
    """Some points of a block, with the images that see them: a block problem of its own.

    Attributes:
        problem: its images, and all frames of the control behind them; its points, numbered anew.
        pairs: its blocks of parameters that have a point in common.
        common: (n,) blocks of parameters that are those of images in common with an adjusted block.
        last: the equations that were computed last, in a block of one part; None in others.
    """

    problem: BlockProblem
    pairs: Pairs
    common: BoolArray
    last: dict[str, Any] | None = None


@dataclass(frozen=True)
class Parts:
    """A block in parts, each a task: only one of them is in the memory of a process.

    All values of the block, of its points and of its observations are arrays here, without their
    derivatives. Sums over parts are in the order of the parts, whichever ends first.

    Attributes:
        problem: the whole block.
        label: (p,) part of every point.
        work: computes the tasks of several parts, and keeps how far they are. A single part is computed
            in this process.
        seed: arrays besides those of the problem that the adjustment depends on.
    """

    problem: BlockProblem
    label: IntArray
    work: Work
    seed: tuple[Array, ...] = ()

    def __len__(self) -> int:
        return int(self.label.max(initial=0)) + 1

    @cached_property
    def points(self) -> list[IntArray]:
        """Points of every part."""
        return self._split(self.label)

    @cached_property
    def observations(self) -> list[IntArray]:
        """Rows of the image positions of every part."""
        return self._split(self.label[self.problem.observations.point])

    @cached_property
    def control(self) -> list[IntArray]:
        """Rows of the control points of every part."""
        return self._split(self.label[self.problem.control.point])

    @cached_property
    def blocks(self) -> list[IntArray]:
        """Blocks of parameters of every part: of its images, and of all frames."""
        image, n = self.problem.observations.image, len(self.problem.images)
        frames = np.arange(n, self.problem.n_blocks)
        if len(self) == 1:
            return [np.arange(self.problem.n_blocks)]
        return [np.concatenate([np.unique(image[rows]), frames]) for rows in self.observations]

    def _split(self, label: IntArray) -> list[IntArray]:
        ends = np.cumsum(np.bincount(label, minlength=len(self)))
        return np.split(np.argsort(label, kind="stable"), ends[:-1])

    @cached_property
    def _own_pairs(self) -> list[Pairs]:
        """Pairs of every part, in its own numbers."""
        if len(self) == 1:
            return [self.problem.pairs]
        found = self._computed(_pairs_of, [self._problem_of])
        return [Pairs(one["start"], one["other"]) for one in found]

    @cached_property
    def _keys(self) -> list[IntArray]:
        """Pairs of every part: the first block of the whole times n, plus the second."""
        n = self.problem.n_blocks
        return [
            np.repeat(blocks, np.diff(own.start)) * n + blocks[own.other]
            for blocks, own in zip(self.blocks, self._own_pairs, strict=True)
        ]

    @cached_property
    def pairs(self) -> Pairs:
        """The blocks of parameters that have a point in common."""
        n = self.problem.n_blocks
        keys = np.unique(np.concatenate([np.arange(n) * (n + 1), *self._keys]))
        return Pairs(np.searchsorted(keys, np.arange(n + 1) * n).astype(np.int64), keys % n)

    @cached_property
    def pair_rows(self) -> list[IntArray]:
        """Rows of the pairs of every part among those of the block."""
        n = self.problem.n_blocks
        keys = np.repeat(np.arange(n), np.diff(self.pairs.start)) * n + self.pairs.other
        return [np.searchsorted(keys, own) for own in self._keys]

    def _problem_of(self, number: int) -> BlockProblem:
        whole, points, blocks = self.problem, self.points[number], self.blocks[number]
        if len(self) == 1:
            return whole
        images = blocks[: len(blocks) - len(whole.control.frames)]
        observed = whole.observations.take(self.observations[number])
        control = whole.control.take(self.control[number])
        return replace(
            whole,
            images=[whole.images[image] for image in images.tolist()],
            observations=replace(
                observed,
                point=np.searchsorted(points, observed.point),
                image=np.searchsorted(images, observed.image),
            ),
            control=replace(control, point=np.searchsorted(points, control.point)),
            n_points=len(points),
            tie=None,
        )

    def _part(self, number: int) -> Part:
        common = self.problem.common[self.blocks[number]]
        last = self._last if len(self) == 1 else None
        return Part(self._problem_of(number), self._own_pairs[number], common, last)

    @cached_property
    def _last(self) -> dict[str, Any]:
        return {}

    def each(
        self, function: Callable[..., Arrays], *given: Callable[[int], Any]
    ) -> list[dict[str, Any]]:
        """What a function of every part and of what is `given` for its number returns."""
        return self._computed(function, [self._part, *given])

    def _computed(
        self, function: Callable[..., Arrays], given: Sequence[Callable[[int], Any]]
    ) -> list[dict[str, Any]]:
        def arguments(number: int) -> tuple[Any, ...]:
            return tuple(one(number) for one in given)

        if len(self) == 1:
            return [dict(function(*arguments(0)))]
        return self.work.each(_STAGE, function, [partial(arguments, at) for at in range(len(self))])

    @cached_property
    def dissection(self) -> Dissection:
        """How the normal equations of large blocks are solved. Frames lie nowhere."""
        place = np.full((self.problem.n_blocks, 2), np.nan)
        place[: len(self.problem.images)] = image_places(self.problem.images)
        return Dissection(place, self.problem.size, self.work)

    def kept(self, stage: str) -> Arrays | None:
        """What was kept of a stage before an interruption; None for nothing, and in a single part."""
        name = self._name(stage)
        return self.work.kept[name] if len(self) > 1 and name in self.work.kept else None

    def keep(self, stage: str, **arrays: npt.ArrayLike) -> None:
        """Keep what a stage begins from, in place of what it began from before."""
        if len(self) > 1:
            self.work.kept[self._name(stage)] = {key: np.asarray(one) for key, one in arrays.items()}

    def _name(self, stage: str) -> str:
        return f"{_STAGE}/{self._digest}-{stage}"

    @cached_property
    def _digest(self) -> str:
        """Of all that is adjusted, except models."""
        observed, control, problem = self.problem.observations, self.problem.control, self.problem
        arrays = (self.label, *vars(observed).values(), problem.sigma, *self.seed)
        known = (control.point, control.lon_lat_h, control.covariance_m2, control.source)
        digest = blake2b(repr(problem.options).encode(), digest_size=16)
        for array in (*arrays, *known):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def at(self, place: Place) -> Callable[[int], Place]:
        """The place of every part."""

        def of_part(number: int) -> Place:
            points, step_m = self.points[number], place.step_m
            return Place(
                place.values[self.blocks[number]],
                place.lon_lat_h[points],
                None if step_m is None else step_m[points],
            )

        return of_part

    def of_weights(self, weights: Weights) -> Callable[[int], Weights]:
        """The weights of every part."""
        return lambda number: Weights(
            weights.observations[self.observations[number]], weights.control[self.control[number]]
        )

    def of_blocks(self, values: Array) -> Callable[[int], Array]:
        """The values (n, ...) of the blocks of every part."""
        return lambda number: values[self.blocks[number]]

    def of_pairs(self, values: Array) -> Callable[[int], Array]:
        """The values (s, ...) of the pairs of every part."""
        return lambda number: values[self.pair_rows[number]]

    def of_points(self, values: Array) -> Callable[[int], Array]:
        """The values (p, ...) of the points of every part."""
        return lambda number: values[self.points[number]]


def same(value: Any) -> Callable[[int], Any]:
    """What is the same for every part."""
    return lambda number: value


def joined(rows: Sequence[IntArray], found: Sequence[dict[str, Any]], key: str) -> Any:
    """The values (m, ...) of all parts in the rows of each, which are taken out of what was found."""
    first = found[0][key]
    count = sum(map(len, rows))
    out = np.empty((count, *first.shape[1:]), dtype=first.dtype)
    for own, one in zip(rows, found, strict=True):
        out[own] = one.pop(key)
    return out


def summed(rows: Sequence[IntArray], found: Sequence[dict[str, Any]], key: str, count: int) -> Any:
    """The sum (count, ...) of the values of all parts, each in its rows."""
    first = found[0][key]
    out = np.zeros((count, *first.shape[1:]), dtype=first.dtype)
    for own, one in zip(rows, found, strict=True):
        out[own] += one.pop(key)
    return out


def block_parts(problem: BlockProblem, work: Work | None = None, seed: tuple[Array, ...] = ()) -> Parts:
    """The parts of a block: as few as have at most so many observations each.

    Groups of images are halved across their longer side; a point belongs to the group of the first image
    that observes it.

    Args:
        problem: the block.
        work: computes the tasks; by default in this process.
        seed: as in `Parts`.
    """
    observed, most = problem.observations, PART_OBSERVATIONS
    label = np.zeros(problem.n_points, dtype=np.int64)
    if len(observed) > most:
        load = np.bincount(observed.image, minlength=len(problem.images))
        group = halved(image_places(problem.images), load, most)
        seen, first = np.unique(observed.point, return_index=True)
        # Points that no image observes any more go with the first part.
        label[:] = group[observed.image[first[0]]]
        label[seen] = group[observed.image[first]]
        label = np.unique(label, return_inverse=True)[1].astype(np.int64)
    return Parts(problem, label, work or Work(), seed)


def image_places(images: Sequence[AdjustableImage]) -> Array:
    """Middles (n, 2) of images on the ground, in degrees of latitude."""
    ground = np.empty((len(images), 3))
    for row, image in enumerate(images):
        middle = (np.array([image.shape], dtype=np.float64) - 1.0) / 2.0
        ground[row] = image.model.locate(middle, np.array([np.mean(image.model.height_range_m)]))[0]
    place = continuous(np.nan_to_num(ground))[:, :2]
    place[:, 0] *= np.cos(np.radians(place[:, 1].mean()))
    return place


def _pairs_of(problem: BlockProblem) -> Arrays:
    """Pairs of a part."""
    return {"start": problem.pairs.start, "other": problem.pairs.other}
