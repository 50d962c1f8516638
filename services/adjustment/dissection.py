"""Nested dissection: a large system is solved in groups of blocks, then for the separators."""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from amers.services.adjustment.normal_equations import Pairs
from amers.services.adjustment.selected_inverse import selected_inverse
from amers.services.tasks import Arrays, Work
from amers.services.types import Array, IntArray

GROUP_ROWS = 3000
"""Rows of a group: those of 500 images with six parameters."""
DIRECT_ROWS = 6000
"""Largest system that is solved at once: separators of a few groups have entries with most others."""
_MOST_SEPARATING = 0.6
"""Share of the blocks that separate groups from which on groups would save nothing."""
_NO_BLOCKS = np.empty(0, dtype=np.int64)
_AT_ONCE = 500
"""Pairs whose products are in memory together."""


def factored(matrix: sparse.csc_matrix) -> SuperLU:
    """The factor of a symmetric positive definite matrix, with diagonal pivots."""
    return splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )


def halved(place: Array, load: IntArray, most: int) -> IntArray:
    """Group (n,) of every place, of at most so much load: all are halved across their longer side.

    Args:
        place: (n, 2).
        load: (n,) of each.
        most: of a group that has more than one place.
    """
    group, number, pending = np.zeros(len(place), dtype=np.int64), 0, [np.arange(len(place))]
    while pending:
        members = pending.pop()
        if load[members].sum() <= most or len(members) == 1:
            group[members], number = number, number + 1
            continue
        axis = int(np.argmax(np.ptp(place[members], axis=0)))
        order = members[np.argsort(place[members, axis], kind="stable")]
        pending += [order[len(order) // 2 :], order[: len(order) // 2]]
    return group


@dataclass(frozen=True)
class Dissection:
    """How a symmetric positive definite system of blocks is solved.

    The blocks of each group have entries among themselves and with some that separate it from others.
    They are eliminated, which leaves a smaller system of the separators (Schur complement); this is
    solved in the same way, and gives the solution of every group back, and blocks of the inverse. It is
    the elimination of one matrix in another order.

    Source: George (1973), Nested dissection of a regular finite element mesh.

    Attributes:
        place: (n, 2) of every block, any unit; NaN for those without one, which join a group where all
            that they have entries with belong to it.
        size: rows of a block.
        work: computes the groups.
    """

    place: Array
    size: int
    work: Work

    def solution(
        self, matrix: sparse.csc_matrix, columns: Array, pairs: Pairs | None = None
    ) -> tuple[Array, Array]:
        """The solution of a system, and blocks of the inverse of its matrix.

        Args:
            matrix: (K, K), with entries other than 0 in every block of `pairs`.
            columns: (K, c) right sides.
            pairs: blocks of the inverse that are wanted; none by default.

        Returns:
            (K, c), and (s, k, k) of the pairs.
        """
        label, graph = np.zeros(len(self.place), dtype=np.int64), (_NO_BLOCKS, _NO_BLOCKS)
        if len(columns) > DIRECT_ROWS:
            graph = _graph(matrix, self.size)
            label = self._groups(*graph)
        if label.max(initial=-1) < 1 or (label < 0).mean() > _MOST_SEPARATING:
            factor = factored(matrix)
            found = np.empty((0, self.size, self.size))
            if pairs is not None:
                found = selected_inverse(factor, pairs, self.size)
            return np.asarray(factor.solve(columns)), found
        return _level(self, matrix, columns, label, graph).solution(pairs)

    def _groups(self, first: IntArray, second: IntArray) -> IntArray:
        """Group (n,) of every block; -1 for those that separate groups."""
        n = len(self.place)
        placed = np.isfinite(self.place[:, 0])
        label = np.full(n, -1)
        most = max(GROUP_ROWS // self.size, 1)
        label[placed] = halved(self.place[placed], np.ones(int(placed.sum()), dtype=np.int64), most)
        near = ~placed[first] & placed[second]
        low, high = np.full(n, n), np.full(n, -1)
        np.minimum.at(low, first[near], label[second[near]])
        np.maximum.at(high, first[near], label[second[near]])
        label[~placed] = np.where(low == high, high, -1)[~placed]
        across = (label[second] >= 0) & (label[first] > label[second])
        label[first[across]] = -1
        return label


class _Group(NamedTuple):
    """Blocks inside a group, and the separator blocks beside it; both ascending."""

    inside: IntArray
    boundary: IntArray


def _level(
    of: Dissection,
    matrix: sparse.csc_matrix,
    columns: Array,
    label: IntArray,
    graph: tuple[IntArray, IntArray],
) -> "_Level":
    """The level of a system whose blocks have a `label` (n,), -1 where they separate."""
    first, second = graph
    n = len(label)
    inside = np.flatnonzero(label >= 0)
    numbers, label[inside] = np.unique(label[inside], return_inverse=True)
    across = (label[first] >= 0) & (label[second] < 0)
    boundary = np.unique(label[first[across]] * n + second[across])
    of_blocks = np.arange(len(numbers) + 1)
    inside = inside[np.argsort(label[inside], kind="stable")]
    own = np.split(inside, np.searchsorted(label[inside], of_blocks[1:-1]))
    beside = np.split(boundary % n, np.searchsorted(boundary, of_blocks[1:-1] * n))
    groups = [_Group(*both) for both in zip(own, beside, strict=True)]
    # The matrix is symmetric: its transpose is itself, by rows.
    return _Level(of, matrix.T, columns, label, groups)


@dataclass(frozen=True)
class _Level:
    """One level of a dissection: the system, the group (n,) of every block, and the groups."""

    of: Dissection
    matrix: sparse.csr_matrix
    columns: Array
    label: IntArray
    groups: list[_Group]

    @cached_property
    def separators(self) -> IntArray:
        """Blocks that separate the groups, ascending."""
        return np.flatnonzero(self.label < 0)

    def solution(self, pairs: Pairs | None) -> tuple[Array, Array]:
        """As `Dissection.solution`."""
        each = self.of.work.each
        schur, right = self._complement(
            each("adjust", eliminated_group, [partial(self._system, group) for group in self.groups])
        )
        above = replace(self.of, place=self.of.place[self.separators])
        # What separates one group has entries of the inverse that the group needs.
        needed = None if pairs is None else _upper(schur, self.of.size)
        solution = np.empty_like(self.columns)
        of_separators = self._rows(self.separators)
        solution[of_separators], told = above.solution(schur, right, needed)

        def back(group: _Group) -> tuple[Any, ...]:
            return (*self._system(group), solution[self._rows(group.boundary)])

        found = each("adjust", returned_group, [partial(back, group) for group in self.groups])
        for group, one in zip(self.groups, found, strict=True):
            solution[self._rows(group.inside)] = one["solution"]
        if pairs is None or needed is None:
            return solution, told
        return solution, self._inverse(pairs, needed, told)

    def _rows(self, blocks: IntArray) -> IntArray:
        return np.asarray((blocks[:, None] * self.of.size + np.arange(self.of.size)).ravel())

    def _system(self, group: _Group) -> tuple[Any, ...]:
        """The rows of a group: among themselves, with the separators, and of the right sides."""
        inside = self._rows(group.inside)
        rows = self.matrix[inside]
        own, across = rows[:, inside].tocsc(), rows[:, self._rows(group.boundary)].tocsc()
        return own, across, self.columns[inside]

    def _complement(self, found: list[dict[str, Any]]) -> tuple[sparse.csc_matrix, Array]:
        """The system that is left for the separators."""
        rows = self._rows(self.separators)
        right, whole = self.columns[rows], self.matrix[rows][:, rows].tocoo()
        count = whole.nnz + sum(one["schur"].size for one in found)
        data = np.empty(count)
        row, column = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int32)
        data[: whole.nnz], row[: whole.nnz], column[: whole.nnz] = whole.data, whole.row, whole.col
        at = whole.nnz
        for group, one in zip(self.groups, found, strict=True):
            own = np.searchsorted(rows, self._rows(group.boundary))
            right[own] -= one["right"]
            here = np.s_[at : at + len(own) ** 2]
            data[here], at = -one.pop("schur").ravel(), here.stop
            row[here], column[here] = np.repeat(own, len(own)), np.tile(own, len(own))
        return sparse.coo_matrix((data, (row, column)), whole.shape).tocsc(), right

    def _inverse(self, pairs: Pairs, needed: Pairs, told: Array) -> Array:
        """Blocks (s, k, k) of the inverse, of those `told` of the pairs of separators."""
        first, other = _blocks(pairs), pairs.other
        group = np.maximum(self.label[first], self.label[other])
        place = np.searchsorted(self.separators, np.arange(len(self.label)))
        keys, n = _blocks(needed) * len(self.separators) + needed.other, len(self.separators)
        out = np.empty((len(other), self.of.size, self.of.size))
        apart = group < 0
        out[apart] = told[np.searchsorted(keys, place[first[apart]] * n + place[other[apart]])]
        by_group = np.argsort(group, kind="stable")
        ends = np.searchsorted(group[by_group], np.arange(len(self.groups) + 1))
        rows = np.split(by_group, ends)[1:-1]

        def wanted(number: int) -> tuple[Any, ...]:
            own, across, _ = self._system(self.groups[number])
            inside, boundary = self.groups[number]
            at = place[boundary]
            one, two = np.triu_indices(len(at))
            square = np.empty((len(at), len(at), self.of.size, self.of.size))
            square[one, two] = told[np.searchsorted(keys, at[one] * n + at[two])]
            square[two, one] = square[one, two].transpose(0, 2, 1)
            # Separators are numbered behind the blocks of the group.
            of_group = np.zeros(len(self.label), dtype=np.int64)
            of_group[inside] = np.arange(len(inside))
            of_group[boundary] = len(inside) + np.arange(len(boundary))
            inverse = square.transpose(0, 2, 1, 3).reshape(2 * (across.shape[1],))
            of_pairs = of_group[first[rows[number]]], of_group[other[rows[number]]]
            return own, across, inverse, of_pairs, self.of.size

        tasks = [partial(wanted, number) for number in range(len(self.groups))]
        for own, one in zip(rows, self.of.work.each("adjust", inverse_group, tasks), strict=True):
            out[own] = one.pop("blocks")
        return out


def eliminated_group(own: sparse.csc_matrix, across: sparse.csc_matrix, columns: Array) -> Arrays:
    """What a group takes from the system of its separators: `schur` (b, b) and `right` (b, c)."""
    solved = factored(own).solve(np.hstack([across.toarray(), columns]))
    both = across.T @ solved
    return {"schur": both[:, : across.shape[1]], "right": both[:, across.shape[1] :]}


def returned_group(
    own: sparse.csc_matrix, across: sparse.csc_matrix, columns: Array, at_separators: Array
) -> Arrays:
    """The `solution` (r, c) of a group, from that of its separators (b, c)."""
    return {"solution": factored(own).solve(columns - across @ at_separators)}


def inverse_group(
    own: sparse.csc_matrix,
    across: sparse.csc_matrix,
    at_separators: Array,
    wanted: tuple[IntArray, IntArray],
    size: int,
) -> Arrays:
    """Blocks of the inverse of a group and its separators.

    With the rows A of the group and its entries B with the separators, and the inverse C at these,
    W = A^-1 B gives A^-1 + W C W^T within the group, and -W C with the separators.

    Args:
        own: (r, r) A.
        across: (r, b) B.
        at_separators: (b, b) C.
        wanted: (s,) and (s,) blocks of pairs; separators are numbered behind those of the group.
        size: rows k of a block.

    Returns:
        `blocks` (s, k, k).
    """
    first, other = wanted
    factor = factored(own)
    follow = np.asarray(factor.solve(across.toarray()))
    carried = follow @ at_separators
    n = own.shape[0] // size
    by_block, carried_by = (part.reshape(n, size, -1) for part in (follow, carried))
    out = np.empty((len(first), size, size))
    within = np.flatnonzero((first < n) & (other < n))
    keys = first[within] * n + other[within]
    within, keys = within[np.argsort(keys)], np.sort(keys)
    inside = Pairs(np.searchsorted(keys, np.arange(n + 1) * n).astype(np.int64), keys % n)
    out[within] = selected_inverse(factor, inside, size)
    for rows in np.split(within, range(_AT_ONCE, len(within), _AT_ONCE)):
        out[rows] += carried_by[first[rows]] @ by_block[other[rows]].transpose(0, 2, 1)
    # (n, k, b, k): with every block of the separators.
    with_separators = -carried.reshape(n, size, -1, size).transpose(0, 2, 1, 3)
    ahead, behind = np.flatnonzero(other >= n), np.flatnonzero(first >= n)
    out[ahead] = with_separators[first[ahead], other[ahead] - n]
    out[behind] = with_separators[other[behind], first[behind] - n].transpose(0, 2, 1)
    return {"blocks": out}


def _graph(matrix: sparse.csc_matrix, size: int) -> tuple[IntArray, IntArray]:
    """Blocks (e,) and (e,) that have entries, in the order of the first."""
    blocks = matrix.tobsr((size, size))
    first = np.repeat(np.arange(len(blocks.indptr) - 1), np.diff(blocks.indptr))
    return first, blocks.indices.astype(np.int64)


def _blocks(pairs: Pairs) -> IntArray:
    """First block (s,) of every pair."""
    return np.repeat(np.arange(len(pairs.start) - 1), np.diff(pairs.start))


def _upper(matrix: sparse.csc_matrix, size: int) -> Pairs:
    """The pairs of blocks of a symmetric matrix that have entries."""
    first, other = _graph(matrix, size)
    n = matrix.shape[0] // size
    keys = np.unique((first * n + other)[first <= other])
    return Pairs(np.searchsorted(keys, np.arange(n + 1) * n).astype(np.int64), keys % n)
