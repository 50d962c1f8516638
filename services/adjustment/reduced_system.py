"""The reduced normal matrix of a block: dense for some hundred images, sparse for thousands."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve, lapack
from scipy.sparse.linalg import splu

from services.adjustment.block_gauge import Gauge
from services.adjustment.parameters import BlockPriors
from services.types import Array, IntArray

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
        basis, moves, shape = self.gauge.basis, self.gauge.moves, self.priors.shape * at
        observed = observed - basis @ (basis.T @ observed)
        return np.asarray(observed - shape + moves @ (moves.T @ shape) - self.priors.locating @ at)

    def dense(self) -> Array:
        """The matrix (K, K)."""
        left, right = self._removed
        return np.asarray(self._whole.toarray() - left @ right.T)

    def times(self, columns: Array) -> Array:
        """The product (K, c) with columns."""
        left, right = self._removed
        return np.asarray(self._whole @ columns - left @ (right.T @ columns))

    def solve(self, right: Array) -> Array:
        """The solution (K,)."""
        if len(right) <= DENSE_ROWS:
            return np.asarray(cho_solve(cho_factor(self.dense()), right))
        factor = splu(
            self._whole,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        # Woodbury for the few columns of the gauge.
        left, other = self._removed
        solved = factor.solve(np.column_stack([right, left]))
        inner = np.eye(left.shape[1]) - other.T @ solved[:, 1:]
        return np.asarray(solved[:, 0] + solved[:, 1:] @ np.linalg.solve(inner, other.T @ solved[:, 0]))

    def inverse(self, root: Array) -> Array:
        """The inverse (K, K), dense, of the matrix and the squares of columns (K, c) together."""
        factor, failed = lapack.dpotrf((self.dense() + root @ root.T).T, lower=1, overwrite_a=1)
        inverse, failed_too = lapack.dpotri(factor, lower=1, overwrite_c=1)
        if failed or failed_too:
            raise np.linalg.LinAlgError(
                "the reduced normal matrix of the block is not positive definite"
            )
        lower = np.tril(inverse, -1)
        inverse = np.tril(inverse)
        inverse += lower.T
        return np.asarray(inverse)


def reduced_system(values: Array, slot: IntArray, priors: BlockPriors, gauge: Gauge) -> ReducedSystem:
    """The system of blocks (s, k, k) of the normal matrix.

    Args:
        values: of every pair of images.
        slot: (n, n) rows of `values`, the smaller image first; -1 where two have nothing in common.
        priors: of the parameters.
        gauge: of the block.
    """
    first, second = np.nonzero(slot >= 0)
    n, k = len(slot), priors.size
    ordered = values[slot[first, second]]
    apart = first != second
    rows = np.concatenate([first, second[apart]])
    columns = np.concatenate([second, first[apart]])
    blocks = np.concatenate([ordered, ordered[apart].transpose(0, 2, 1)])
    row = (rows[:, None, None] * k + np.arange(k)[:, None]) + np.zeros((1, 1, k), dtype=np.int64)
    column = (columns[:, None, None] * k + np.arange(k)[None, :]) + np.zeros((1, k, 1), dtype=np.int64)
    observed = sparse.coo_matrix((blocks.ravel(), (row.ravel(), column.ravel())), (n * k, n * k))
    return ReducedSystem(observed.tocsc(), priors, gauge)
