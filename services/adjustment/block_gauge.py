"""What tie points leave open: the place of every connected group of images, left to the priors alone."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from services.adjustment.normal_equations import Equations
from services.types import Array, IntArray

MIN_COMMON = 3
"""Number of points in common that ties two images: as many as a translation has coordinates."""


@dataclass(frozen=True)
class Gauge:
    """The translations of the groups of a block.

    Attributes:
        group: (n,) int64, of every block of parameters; -1 for those without an observation.
        move: (n k, 3 g) change of the parameters when a group moves by a metre east, north, up.
        basis: (n k, r) orthonormal, of the same space.
    """

    group: IntArray
    move: Array
    basis: Array


def connected_groups(equations: Equations, n_images: int, n_blocks: int) -> IntArray:
    """Group (n,) of images and frames of control that points tie together; -1 for the unseen."""
    used = equations.weight > 0.0
    common = _common_points(equations.point[used], equations.block[used], n_blocks)
    tied = common >= MIN_COMMON
    tied[n_images:] = tied[:, n_images:] = False
    tied[:n_images, n_images:] = common[:n_images, n_images:] > 0
    count, label = connected_components(sparse.csr_matrix(tied), directed=False)
    seen = np.diagonal(common) > 0
    number = np.full(count, -1)
    for i in np.flatnonzero(seen):
        if number[label[i]] < 0:
            number[label[i]] = number.max() + 1
    return np.where(seen, number[label], -1).astype(np.int64)


@njit(cache=True)
def _common_points(point: IntArray, block: IntArray, n_blocks: int) -> IntArray:
    common = np.zeros((n_blocks, n_blocks), dtype=np.int64)
    first = 0
    for i in range(len(point)):
        if point[i] != point[first]:
            first = i
        common[block[i], block[i]] += 1
        for j in range(first, i):
            if block[i] != block[j]:
                common[min(block[i], block[j]), max(block[i], block[j])] += 1
    return common


def block_gauge(equations: Equations, group: IntArray) -> Gauge:
    """The effect of a translation of each group on its parameters.

    Tie points do not determine the position of a block. Its images see it under slightly different
    angles from edge to edge, though, and a distortion of 0.1 px would pass for a translation by metres:
    what observations seem to tell of a translation is not used.
    """
    k, n = equations.by_parameters.shape[2], len(group)
    normal, right = np.zeros((n, k, k)), np.zeros((n, k, 3))
    weighted = equations.by_parameters * equations.weight[:, None, None]
    for q in range(k):
        for s in range(k):
            product = (weighted[:, :, q] * equations.by_parameters[:, :, s]).sum(axis=1)
            normal[:, q, s] = np.bincount(equations.block, product, n)
        for c in range(3):
            product = (weighted[:, :, q] * equations.by_ground[:, :, c]).sum(axis=1)
            right[:, q, c] = np.bincount(equations.block, product, n)
    ridge = np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-300)[:, None, None] * 1e-9
    move = np.linalg.solve(normal + ridge * np.eye(k), right).reshape(n * k, 3)
    groups = int(group.max()) + 1
    columns = np.zeros((n * k, 3 * groups))
    for g in range(groups):
        rows = np.repeat(group == g, k)
        columns[rows, 3 * g : 3 * g + 3] = move[rows]
    u, values, _ = np.linalg.svd(columns, full_matrices=False)
    return Gauge(group, columns, u[:, values > 1e-9 * values[0]])
