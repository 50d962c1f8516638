"""The reduced normal matrix of a block: dense for some hundred images, sparse for thousands."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, lapack

from amers.services.adjustment.block_gauge import Gauge
from amers.services.adjustment.dissection import Dissection
from amers.services.adjustment.normal_equations import Pairs
from amers.services.adjustment.parameters import BlockPriors
from amers.services.types import Array

DENSE_ROWS = 2000
"""Largest matrix that is solved densely."""
_TRACE = 1e-150
"""In place of zero: nothing beside any weight, and far above the smallest number."""
_AT_ONCE = 10_000
"""Pairs whose products are in memory together."""


@dataclass(frozen=True)
class ReducedSystem:
    """Normal matrix of the parameters without what observations seem to tell of the gauge.

    With the normal matrix N of the observations, the projector H that removes the gauge, the priors S of
    drift and skew, the projector G that removes translations alone, and the priors P of what locates
    images, it is H N H + G S G + P.

    Attributes:
        observed: (K, K) sparse, N.
        priors: P and S.
        gauge: what H and G remove.
        dissection: solves large systems.
    """

    observed: sparse.csc_matrix
    priors: BlockPriors
    gauge: Gauge
    dissection: Callable[[], Dissection]

    @cached_property
    def _removed(self) -> tuple[Array, Array]:
        """Columns U, V (K, c): the matrix is N + S + P - U V^T."""
        left, right = [], []
        shape = sparse.diags(self.priors.shape)
        for matrix, basis in ((self.observed, self.gauge.basis), (shape, self.gauge.moves)):
            product = matrix @ basis
            turned = product - 0.5 * basis @ (basis.T @ product)
            left += [basis, turned]
            right += [turned, basis]
        return np.hstack(left), np.hstack(right)

    def right_side(self, observed: Array, at: Array) -> Array:
        """Right side (K,) at parameters (K,), of that of the observations (K,)."""
        basis, moves, off = self.gauge.basis, self.gauge.moves, at - self.priors.mean
        shape = self.priors.shape * off
        observed = observed - basis @ (basis.T @ observed)
        return np.asarray(observed - shape + moves @ (moves.T @ shape) - self.priors.located(off))

    def dense(self) -> Array:
        """The matrix (K, K)."""
        left, right = self._removed
        priors = np.diag(self.priors.shape) + self.priors.locating.toarray()
        return np.asarray(self.observed.toarray() + priors - left @ right.T)

    def times(self, columns: Array) -> Array:
        """The product (K, c) with columns."""
        left, right = self._removed
        priors = self.priors.shape[:, None] * columns + self.priors.located(columns)
        return np.asarray(self.observed @ columns + priors - left @ (right.T @ columns))

    def solve(self, right: Array) -> Array:
        """The solution (K,)."""
        if len(right) <= DENSE_ROWS:
            return np.asarray(cho_solve(cho_factor(self.dense()), right))
        # Woodbury for the few columns of the gauge.
        left, other = self._removed
        solved = self._sparse(np.column_stack([right, left]))[0]
        inner = np.eye(left.shape[1]) - other.T @ solved[:, 1:]
        return np.asarray(solved[:, 0] + solved[:, 1:] @ np.linalg.solve(inner, other.T @ solved[:, 0]))

    def inverse(self, pairs: Pairs, root: Array) -> Array:
        """Blocks (s, k, k) of the inverse of the matrix and the squares of columns (K, c) together."""
        k, first = self.priors.size, np.repeat(np.arange(len(pairs.start) - 1), np.diff(pairs.start))
        if len(root) <= DENSE_ROWS:
            inverse = self.dense_inverse(root).reshape(len(root) // k, k, -1, k)
            return np.asarray(inverse[first, :, pairs.other])
        left, other = (np.hstack(part) for part in zip(self._removed, (-root, root), strict=True))
        both, blocks = self._sparse(np.hstack([left, other]), pairs)
        solved, other_solved = np.hsplit(both, 2)
        inner = np.linalg.inv(np.eye(left.shape[1]) - other.T @ solved)
        one, two = (part.reshape(-1, k, left.shape[1]) for part in (solved @ inner, other_solved))
        for rows in np.array_split(np.arange(len(first)), 1 + len(first) // _AT_ONCE):
            blocks[rows] += one[first[rows]] @ two[pairs.other[rows]].transpose(0, 2, 1)
        return blocks

    def _sparse(self, columns: Array, pairs: Pairs | None = None) -> tuple[Array, Array]:
        """Solution (K, c) of N + S + P, and blocks (s, k, k) of its inverse.

        The errors that passes share are unknowns of their own, so that no pass ties all of its images.
        """
        dissection, shared = self.dissection(), self.priors.shared
        (count, beside), observed = shared.shape, self.observed
        whole = (count + beside, count + beside)
        own = self.priors.apart + sparse.diags(self.priors.shape)
        priors = sparse.bmat([[own, shared], [shared.T, sparse.identity(beside)]]) if beside else own
        # Larger, without a copy.
        ends = np.append(observed.indptr, np.full(beside, observed.indptr[-1], observed.indptr.dtype))
        told = sparse.csc_matrix((observed.data, observed.indices, ends), shape=whole)
        matrix = told + priors.tocsc()
        nowhere = np.full((beside // dissection.size, 2), np.nan)
        augmented = replace(dissection, place=np.vstack([dissection.place, nowhere]))
        right = np.vstack([columns, np.zeros((beside, columns.shape[1]))])
        solution, blocks = augmented.solution(matrix, right, pairs)
        return solution[:count], blocks

    def dense_inverse(self, root: Array) -> Array:
        """The whole inverse (K, K) of the matrix and the squares of columns (K, c) together."""
        return _dense_inverse(self.dense() + root @ root.T)


def _dense_inverse(matrix: Array) -> Array:
    factor, failed = lapack.dpotrf(matrix.T, lower=1, overwrite_a=1)
    inverse, failed_too = lapack.dpotri(factor, lower=1, overwrite_c=1)
    if failed or failed_too:
        raise np.linalg.LinAlgError("the reduced normal matrix of the block is not positive definite")
    return np.asarray(np.tril(inverse) + np.tril(inverse, -1).T)


def reduced_system(
    values: Array,
    pairs: Pairs,
    priors: BlockPriors,
    gauge: Gauge,
    dissection: Callable[[], Dissection],
) -> ReducedSystem:
    """The system of blocks (s, k, k) of the normal matrix.

    Args:
        values: of every pair of images.
        pairs: rows of `values`.
        priors: of the parameters.
        gauge: of the block.
        dissection: returns what solves large systems.
    """
    n, k = len(pairs.start) - 1, priors.size
    first = np.repeat(np.arange(n), np.diff(pairs.start))
    apart = np.flatnonzero(first != pairs.other)
    rows = np.concatenate([first, pairs.other[apart]])
    columns = np.concatenate([pairs.other, first[apart]])
    order = np.lexsort((columns, rows))
    # Entries of zero have entries of the inverse; SuperLU would leave them out.
    blocks = np.concatenate([values, values[apart].transpose(0, 2, 1)])[order]
    blocks[blocks == 0.0] = _TRACE
    start = np.searchsorted(rows[order], np.arange(n + 1))
    observed = sparse.bsr_matrix((blocks, columns[order], start), shape=(n * k, n * k))
    return ReducedSystem(observed.tocsc(), priors, gauge, dissection)
