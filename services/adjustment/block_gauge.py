"""What tie points leave open: place and linear shape of connected images, left to the priors alone."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from services.adjustment.normal_equations import Equations
from services.geodesy import continuous
from services.types import Array, BoolArray, IntArray

MIN_COMMON = 3
"""Number of points in common that ties two images: as many as a translation has coordinates."""


@dataclass(frozen=True)
class Gauge:
    """What the observations of a block do not tell, as changes of its parameters.

    Attributes:
        group: (n,) int64, of every block of parameters; -1 for those without an observation.
        move: (n k, 3 g) change of the parameters when a group moves by a metre east, north, up.
        moves: (n k, t) orthonormal, of the same space.
        basis: (n k, r) orthonormal, of that space and of the linear deformations of groups.
    """

    group: IntArray
    move: Array
    moves: Array
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


def block_gauge(equations: Equations, group: IntArray, lon_lat_h: Array, deformable: BoolArray) -> Gauge:
    """The effect of translations and linear deformations of each group on its parameters.

    Tie points do not determine the position of a block. Its images see it under slightly different
    angles from edge to edge, though, and a distortion of 0.1 px would pass for a translation by metres:
    what observations seem to tell of a translation is not used. The same holds for a ground that is
    sheared, stretched or tilted as a whole, where the images may drift and skew: all of them would
    together, and only relief, seen under different angles, shows it.

    Args:
        equations: the observations.
        group: (n,) of every block of parameters.
        lon_lat_h: (p, 3) the points.
        deformable: (n,) blocks of parameters that follow linear deformations. A group does when all of
            its members do: known ground tells how it is deformed.
    """
    n, groups = len(group), int(group.max()) + 1
    used = equations.weight > 0.0
    east_north = continuous(lon_lat_h[equations.point[used], :2])
    east_north -= east_north.mean(axis=0)
    place = np.zeros((len(used), 2))
    place[used] = east_north / (2.0 * east_north.std(axis=0) + 1e-12)
    east, north = place.T[:, :, None, None]
    ground = equations.by_ground
    move, *linear = (_fitted(equations, n, part) for part in (ground, ground * east, ground * north))
    of_groups = np.stack([group == g for g in range(groups)])
    bends = [members for members in of_groups if deformable[members].all()]
    columns = _by_group(move, of_groups)
    bent = [_by_group(mode, bends) for mode in linear]
    return Gauge(group, columns, _orthonormal(columns), _orthonormal(np.hstack([columns, *bent])))


def _fitted(equations: Equations, n: int, displaced: Array) -> Array:
    """Change (n, k, 3) of the parameters that explains displacements (m, 2, 3) of observations best."""
    k = equations.by_parameters.shape[2]
    normal, right = np.zeros((n, k, k)), np.zeros((n, k, 3))
    weighted = equations.by_parameters * equations.weight[:, None, None]
    for q in range(k):
        for s in range(k):
            product = (weighted[:, :, q] * equations.by_parameters[:, :, s]).sum(axis=1)
            normal[:, q, s] = np.bincount(equations.block, product, n)
        for c in range(3):
            product = (weighted[:, :, q] * displaced[:, :, c]).sum(axis=1)
            right[:, q, c] = np.bincount(equations.block, product, n)
    ridge = np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-300)[:, None, None] * 1e-9
    return np.asarray(np.linalg.solve(normal + ridge * np.eye(k), right))


def _by_group(change: Array, members: Sequence[BoolArray] | BoolArray) -> Array:
    """Columns (n k, 3 g) of changes (n, k, 3), three for each group."""
    n, k, _ = change.shape
    parts = [np.where(own[:, None, None], change, 0.0).reshape(n * k, 3) for own in members]
    return np.hstack([np.zeros((n * k, 0)), *parts])


def _orthonormal(columns: Array) -> Array:
    u, values, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, values > 1e-9 * values[0]])
