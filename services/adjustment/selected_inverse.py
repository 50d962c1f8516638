"""Selected inverse of a sparse matrix: its entries at the non-zero entries of the matrix."""

from typing import NamedTuple

import numpy as np
from numba import njit
from scipy import sparse
from scipy.sparse.linalg import SuperLU

from amers.services.adjustment.normal_equations import Pairs
from amers.services.types import Array, IntArray


class _Inverse(NamedTuple):
    """Entries of the inverse in the pattern of the factor: below the diagonal by column, and on it."""

    start: IntArray
    row: IntArray
    values: Array
    diagonal: Array


def selected_inverse(factor: SuperLU, pairs: Pairs, size: int) -> Array:
    """Blocks (s, k, k) of the inverse of a symmetric positive definite matrix, where it has blocks.

    The recursion of Takahashi, from the last column of the factor to the first: an entry needs only
    entries of the pattern of the factor, which fill-in has closed.

    Args:
        factor: of the matrix, with diagonal pivots.
        pairs: of blocks.
        size: rows of a block.
    """
    if not np.array_equal(factor.perm_r, factor.perm_c):
        raise np.linalg.LinAlgError("the reduced normal matrix of the block is not positive definite")
    lower = sparse.tril(factor.L, -1).tocsc()
    lower.sort_indices()
    start, row = lower.indptr.astype(np.int64), lower.indices.astype(np.int64)
    inverse = _takahashi(start, row, lower.data, factor.U.diagonal())
    return _gathered(inverse, factor.perm_c.astype(np.int64), pairs, size)


@njit(cache=True)
def _takahashi(start: IntArray, row: IntArray, lower: Array, pivot: Array) -> _Inverse:
    n = len(pivot)
    values, diagonal = np.zeros(len(row)), np.empty(n)
    place = np.full(n, -1)
    for j in range(n - 1, -1, -1):
        first, last = start[j], start[j + 1]
        for i in range(first, last):
            place[row[i]] = i
        for i in range(first, last):
            k, factor = row[i], lower[i]
            total = -diagonal[k] * factor
            for q in range(start[k], start[k + 1]):
                other = place[row[q]]
                if other >= 0:
                    total -= values[q] * lower[other]
                    values[other] -= values[q] * factor
            values[i] += total
        diagonal[j] = 1.0 / pivot[j]
        for i in range(first, last):
            diagonal[j] -= lower[i] * values[i]
            place[row[i]] = -1
    return _Inverse(start, row, values, diagonal)


@njit(cache=True)
def _gathered(inverse: _Inverse, place: IntArray, pairs: Pairs, k: int) -> Array:
    out = np.zeros((len(pairs.other), k, k))
    for a in range(len(pairs.start) - 1):
        for s in range(pairs.start[a], pairs.start[a + 1]):
            for q in range(k):
                for r in range(k):
                    one, other = place[a * k + q], place[pairs.other[s] * k + r]
                    out[s, q, r] = _entry(inverse, min(one, other), max(one, other))
    return out


@njit(cache=True)
def _entry(inverse: _Inverse, column: int, below: int) -> float:
    if column == below:
        return float(inverse.diagonal[column])
    low, high = inverse.start[column], inverse.start[column + 1]
    at = low + np.searchsorted(inverse.row[low:high], below)
    return float(inverse.values[at]) if at < high and inverse.row[at] == below else 0.0
