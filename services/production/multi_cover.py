"""Weighted multi-cover: the smallest set of images that covers every cell as often as it needs.

An image covers cells; a cell needs a number of images. `greedy_cover` takes, one after the other, the
image of the largest gain; `without_excess` takes images out again that became unnecessary; `lower_bound`
gives a number of images that no cover falls below, whatever the method.
"""

from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from amers.services.types import Array, BoolArray, IntArray

Counts = npt.NDArray[np.int16]
CellNumbers = npt.NDArray[np.int32]
Classes = npt.NDArray[np.uint8]

_PROGRESS = 1e-4
_PATIENCE = 60
_SHORTER = 0.7
_SHORTEST = 1e-3
_MOMENTUM = 0.5
_ABOVE = 1.05
"""Steps of the lower bound aim this much above the known cover, so that they never vanish."""
_ROUNDING = 1e-12
"""Error of the sums of a bound, as a share of its terms."""


class _Incidence(NamedTuple):
    """Cells of the images and the need of the cells, as `CoverProblem` has them."""

    start: IntArray
    cell: CellNumbers
    need: Counts


class _State(NamedTuple):
    """Images that each cell (c,) still needs, and the classes (c, k) that it has."""

    missing: Counts
    seen: Classes


@dataclass(frozen=True)
class CoverProblem:
    """Cells to be covered by n images.

    Attributes:
        start: (n + 1,) int64; the cells of image i are the rows `start[i]` to `start[i + 1]`.
        cell: (m,) int32, 0 to c - 1; a cell once an image.
        need: (c,) int16, how many images each cell needs; at most as many as cover it.
        classes: (n, k) uint8, bits of the classes of each image in k ways of variety; 0 is in none.
        preference: (n,) greater than 0; of images that cover the same, the greatest is taken.
    """

    start: IntArray
    cell: CellNumbers
    need: Counts
    classes: Classes
    preference: Array

    @property
    def incidence(self) -> _Incidence:
        """The arrays that compiled functions need."""
        return _Incidence(self.start, self.cell, self.need)

    def covers(self, chosen: BoolArray) -> Counts:
        """How many of the chosen images (n,) cover each cell (c,)."""
        return _covers(self.incidence, chosen)


@njit(cache=True)
def _covers(images: _Incidence, chosen: BoolArray) -> Counts:
    covers = np.zeros_like(images.need)
    for i in range(len(chosen)):
        if chosen[i]:
            for c in images.cell[images.start[i] : images.start[i + 1]]:
                covers[c] += 1
    return covers


def greedy_cover(problem: CoverProblem, weight: Array, variety: float) -> BoolArray:
    """Images (n,) that cover every cell as often as it needs.

    The gain of an image is its preference times the sum, over its cells that need more images, of the
    cell's weight times (1 + `variety` x the ways in which the image is of a class that the cell lacks).
    Gains only fall as images are taken, so that a heap of old gains finds the largest (lazy greedy:
    Minoux 1978). Ties go to the first image.

    Args:
        problem: to be solved.
        weight: (c,) of the cells, greater than 0.
        variety: share of a cell's weight that a new class is worth.
    """
    return _greedy(problem.incidence, problem.classes, problem.preference, weight, variety)


@njit(cache=True)
def _greedy(
    images: _Incidence, classes: Classes, preference: Array, weight: Array, variety: float
) -> BoolArray:
    n, ways = classes.shape
    missing = images.need.copy()
    seen = np.zeros((len(missing), ways), dtype=np.uint8)
    state = _State(missing, seen)
    chosen = np.zeros(n, dtype=np.bool_)
    heap = [(-np.inf, i) for i in range(n)]
    heapify(heap)
    while len(heap) > 0:
        _, i = heappop(heap)
        cells = images.cell[images.start[i] : images.start[i + 1]]
        gain = preference[i] * _gain(cells, classes[i], state, weight, variety)
        if gain <= 0.0:
            continue
        if len(heap) > 0 and (-gain, i) > heap[0]:
            heappush(heap, (-gain, i))
            continue
        chosen[i] = True
        for c in cells:
            missing[c] -= 1
            for way in range(ways):
                seen[c, way] |= classes[i, way]
    return chosen


@njit(cache=True)
def _gain(cells: CellNumbers, own: Classes, state: _State, weight: Array, variety: float) -> float:
    """Gain of an image with some cells and its own classes (k,), before its preference."""
    gain = 0.0
    for c in cells:
        if state.missing[c] > 0:
            new = 0
            for way in range(len(own)):
                new += (own[way] & ~state.seen[c, way]) != 0
            gain += weight[c] * (1.0 + variety * new)
    return gain


def without_excess(problem: CoverProblem, chosen: BoolArray, last: IntArray) -> BoolArray:
    """The chosen images (n,) without those that no cell needs.

    Args:
        problem: that they cover.
        chosen: (n,) a cover.
        last: images in the order in which they may be taken out.
    """
    return _reverse_delete(problem.incidence, problem.covers(chosen), chosen, last)


@njit(cache=True)
def _reverse_delete(images: _Incidence, covers: Counts, chosen: BoolArray, order: IntArray) -> BoolArray:
    kept = chosen.copy()
    for i in order:
        cells = images.cell[images.start[i] : images.start[i + 1]]
        if kept[i] and (covers[cells] > images.need[cells]).all():
            kept[i] = False
            covers[cells] -= 1
    return kept


@dataclass(frozen=True)
class LowerBound:
    """A number of images that no cover falls below, with the prices that prove it.

    Attributes:
        images: the bound.
        price: (c,) at least 0.
    """

    images: float
    price: Array


def bound_of(problem: CoverProblem, price: Array) -> float:
    """The lower bound that prices (c,) prove, by weak duality of the linear relaxation.

    For prices u >= 0 of the cells, every cover x satisfies
    sum_i x_i >= sum_c need_c u_c + sum_i min(0, 1 - sum of u_c over the cells of image i).
    What rounding may add to the difference is taken off.
    """
    asked = float(problem.need @ price)
    taken_off = float(np.minimum(_reduced(problem.incidence, price), 0.0).sum())
    return asked + taken_off - _ROUNDING * (asked - taken_off)


def lower_bound(problem: CoverProblem, upper: int, iterations: int) -> LowerBound:
    """The best lower bound that subgradient steps find (Held, Wolfe, Crowder 1974).

    Args:
        problem: that every cover is bounded for.
        upper: number of images of a known cover; it sets the length of the steps.
        iterations: most steps.
    """
    price = _subgradient(problem.incidence, float(upper), iterations)
    return LowerBound(bound_of(problem, price), price)


@njit(cache=True)
def _reduced(images: _Incidence, price: Array) -> Array:
    """One minus the prices of the cells of each image (n,)."""
    reduced = np.ones(len(images.start) - 1)
    for i in range(len(reduced)):
        for c in images.cell[images.start[i] : images.start[i + 1]]:
            reduced[i] -= price[c]
    return reduced


@njit(cache=True)
def _subgradient(images: _Incidence, upper: float, iterations: int) -> Array:
    """Prices (c,) of the best bound: Polyak steps with momentum, shorter after each standstill."""
    need, start = images.need, images.start
    price = np.ones(len(need))
    # A cell starts with the least share of an image's cost: no image is then worth more than it costs.
    for i in range(len(start) - 1):
        for c in images.cell[start[i] : start[i + 1]]:
            price[c] = min(price[c], 1.0 / (start[i + 1] - start[i]))
    best, best_price = 0.0, price.copy()
    step, standstill = 1.0, 0
    direction = np.zeros(len(need))
    for _ in range(iterations):
        reduced = _reduced(images, price)
        asked, taken_off = (need * price).sum(), 0.0
        missing = need.astype(np.float64)
        for i in range(len(reduced)):
            if reduced[i] < 0.0:
                taken_off += reduced[i]
                for c in images.cell[start[i] : start[i + 1]]:
                    missing[c] -= 1.0
        value = asked + taken_off - _ROUNDING * (asked - taken_off)
        standstill = 0 if value > best * (1.0 + _PROGRESS) else standstill + 1
        if value > best:
            best = value
            best_price[:] = price
        if standstill >= _PATIENCE:
            step *= _SHORTER
            standstill = 0
            price[:] = best_price
            direction[:] = 0.0
            continue
        missing[(price == 0.0) & (missing < 0.0)] = 0.0
        direction = missing + _MOMENTUM * direction
        norm = (direction * direction).sum()
        if norm == 0.0 or step < _SHORTEST or best >= upper:
            break
        price = np.maximum(0.0, price + step * (_ABOVE * upper - value) / norm * direction)
    return best_price
