"""The reduced normal matrix of a block: dense for some hundred images, sparse for thousands."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, lapack
from scipy.sparse.linalg import SuperLU, splu

from amers.services.adjustment.block_gauge import Gauge
from amers.services.adjustment.normal_equations import Pairs
from amers.services.adjustment.parameters import BlockPriors
from amers.services.adjustment.selected_inverse import selected_inverse
from amers.services.types import Array

DENSE_ROWS = 2000
"""Largest matrix that is solved densely."""


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
    """

    observed: sparse.csc_matrix
    priors: BlockPriors
    gauge: Gauge

    @cached_property
    def _whole(self) -> sparse.csc_matrix:
        """N + S + P."""
        return (self.observed + sparse.diags(self.priors.shape) + self.priors.locating).tocsc()

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
        return np.asarray(observed - shape + moves @ (moves.T @ shape) - self.priors.locating @ off)

    def dense(self) -> Array:
        """The matrix (K, K)."""
        left, right = self._removed
        return np.asarray(self._whole.toarray() - left @ right.T)

    def times(self, columns: Array) -> Array:
        """The product (K, c) with columns."""
        left, right = self._removed
        return np.asarray(self._whole @ columns - left @ (right.T @ columns))

    @cached_property
    def _factor(self) -> SuperLU:
        return splu(
            self._whole,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    def solve(self, right: Array) -> Array:
        """The solution (K,)."""
        if len(right) <= DENSE_ROWS:
            return np.asarray(cho_solve(cho_factor(self.dense()), right))
        # Woodbury for the few columns of the gauge.
        left, other = self._removed
        solved = self._factor.solve(np.column_stack([right, left]))
        inner = np.eye(left.shape[1]) - other.T @ solved[:, 1:]
        return np.asarray(solved[:, 0] + solved[:, 1:] @ np.linalg.solve(inner, other.T @ solved[:, 0]))

    def inverse(self, pairs: Pairs, root: Array) -> Array:
        """Blocks (s, k, k) of the inverse of the matrix and the squares of columns (K, c) together."""
        k, first = self.priors.size, np.repeat(np.arange(len(pairs.start) - 1), np.diff(pairs.start))
        if len(root) <= DENSE_ROWS:
            inverse = self.dense_inverse(root).reshape(len(root) // k, k, -1, k)
            return np.asarray(inverse[first, :, pairs.other])
        left, other = (np.hstack(part) for part in zip(self._removed, (-root, root), strict=True))
        solved, other_solved = self._factor.solve(left), self._factor.solve(other)
        inner = np.linalg.inv(np.eye(left.shape[1]) - other.T @ solved)
        blocks = selected_inverse(self._factor, pairs, k)
        one, two = (
            (solved @ inner).reshape(-1, k, left.shape[1]),
            other_solved.reshape(-1, k, left.shape[1]),
        )
        return np.asarray(blocks + one[first] @ two[pairs.other].transpose(0, 2, 1))

    def dense_inverse(self, root: Array) -> Array:
        """The whole inverse (K, K) of the matrix and the squares of columns (K, c) together."""
        return _dense_inverse(self.dense() + root @ root.T)


def _dense_inverse(matrix: Array) -> Array:
    factor, failed = lapack.dpotrf(matrix.T, lower=1, overwrite_a=1)
    inverse, failed_too = lapack.dpotri(factor, lower=1, overwrite_c=1)
    if failed or failed_too:
        raise np.linalg.LinAlgError("the reduced normal matrix of the block is not positive definite")
    return np.asarray(np.tril(inverse) + np.tril(inverse, -1).T)


def reduced_system(values: Array, pairs: Pairs, priors: BlockPriors, gauge: Gauge) -> ReducedSystem:
    """The system of blocks (s, k, k) of the normal matrix.

    Args:
        values: of every pair of images.
        pairs: rows of `values`.
        priors: of the parameters.
        gauge: of the block.
    """
    n, k = len(pairs.start) - 1, priors.size
    first, second, ordered = np.repeat(np.arange(n), np.diff(pairs.start)), pairs.other, values
    apart = first != second
    rows = np.concatenate([first, second[apart]])
    columns = np.concatenate([second, first[apart]])
    blocks = np.concatenate([ordered, ordered[apart].transpose(0, 2, 1)])
    row = (rows[:, None, None] * k + np.arange(k)[:, None]) + np.zeros((1, 1, k), dtype=np.int64)
    column = (columns[:, None, None] * k + np.arange(k)[None, :]) + np.zeros((1, k, 1), dtype=np.int64)
    observed = sparse.coo_matrix((blocks.ravel(), (row.ravel(), column.ravel())), (n * k, n * k))
    return ReducedSystem(observed.tocsc(), priors, gauge)
