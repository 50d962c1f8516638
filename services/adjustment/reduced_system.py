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
    """Normal matrix of the parameters without what observations seem to tell of a translation.

    With the normal matrix N of the observations and of the priors of drift and skew, the projector H
    that removes translations, and the priors P of what locates images, it is H N H + P.

    Attributes:
        observed: (K, K) sparse, N.
        locating: (K, K) sparse, P.
        basis: (K, r) orthonormal, of the translations.
    """

    observed: sparse.csc_matrix
    locating: sparse.csc_matrix
    basis: Array

    @cached_property
    def _turned(self) -> Array:
        """Y (K, r) with H N H = N - Q Y^T - Y Q^T."""
        product = self.observed @ self.basis
        return np.asarray(product - 0.5 * self.basis @ (self.basis.T @ product))

    def projected(self, right: Array) -> Array:
        """H right."""
        return np.asarray(right - self.basis @ (self.basis.T @ right))

    def dense(self) -> Array:
        """The matrix (K, K)."""
        matrix = (self.observed + self.locating).toarray()
        matrix -= self.basis @ self._turned.T
        matrix -= self._turned @ self.basis.T
        return np.asarray(matrix)

    def times(self, columns: Array) -> Array:
        """The product (K, c) with columns."""
        return np.asarray(
            (self.observed + self.locating) @ columns
            - self.basis @ (self._turned.T @ columns)
            - self._turned @ (self.basis.T @ columns)
        )

    def solve(self, right: Array) -> Array:
        """The solution (K,)."""
        if len(right) <= DENSE_ROWS:
            return np.asarray(cho_solve(cho_factor(self.dense()), right))
        factor = splu(
            (self.observed + self.locating).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        # Woodbury for the few columns of the gauge.
        left = np.column_stack([self.basis, self._turned])
        other = np.column_stack([self._turned, self.basis])
        solved = factor.solve(np.column_stack([right, left]))
        inner = np.eye(left.shape[1]) - other.T @ solved[:, 1:]
        return np.asarray(solved[:, 0] + solved[:, 1:] @ np.linalg.solve(inner, other.T @ solved[:, 0]))

    def inverse(self) -> Array:
        """The inverse (K, K), dense."""
        factor, failed = lapack.dpotrf(self.dense().T, lower=1, overwrite_a=1)
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
    return ReducedSystem((observed + sparse.diags(priors.shape)).tocsc(), priors.locating, gauge.basis)
