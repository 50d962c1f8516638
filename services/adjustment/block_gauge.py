"""The gauge of a block: position and linear deformation, set by priors, not by tie points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from amers.services.adjustment.normal_equations import Equations, Pairs
from amers.services.types import Array, BoolArray, IntArray

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


def connected_groups(pairs: Pairs, common: IntArray, n_images: int) -> IntArray:
    """Group (n,) of images and frames of control that points tie together; -1 for the unseen.

    A frame whose points no image shows belongs to no group.

    Args:
        pairs: of blocks of parameters.
        common: (s,) pairs of observations of one point that they have.
        n_images: blocks of images; frames are behind.
    """
    n_blocks = len(pairs.start) - 1
    first, second = np.repeat(np.arange(n_blocks), np.diff(pairs.start)), pairs.other
    tied = np.where(second < n_images, common >= MIN_COMMON, (first < n_images) & (common > 0))
    graph = sparse.coo_matrix((np.ones(tied.sum()), (first[tied], second[tied])), (n_blocks, n_blocks))
    _, label = connected_components(graph, directed=False)
    seen = common[pairs.start[:-1]] > 0
    seen &= np.isin(label, label[:n_images][seen[:n_images]])
    # Groups are numbered in the order of their first members.
    of_seen, first_member = np.unique(label[seen], return_index=True)
    number = np.full(n_blocks, -1)
    number[of_seen[np.argsort(first_member)]] = np.arange(len(of_seen))
    return np.where(seen, number[label], -1).astype(np.int64)


def block_gauge(
    group: IntArray, own: Array, followed: Array, deformable: BoolArray, sigma: Array
) -> Gauge:
    """The effect of translations and linear deformations of each group on its parameters.

    Tie points do not determine the position of a block. Its images see it under slightly different
    angles from edge to edge, though, and a distortion of 0.1 px would look like a translation by metres.
    So the observations are not used to estimate a translation. Where the images may drift and skew, the
    observations are not used for a shear, a stretch or a tilt of the whole ground either: a change of
    all images together has the same effect, and only relief, seen under different angles, differs.

    Args:
        group: (n,) of every block of parameters.
        own, followed: (n, k, k) and (n, k, 9), `followed_ground`.
        deformable: (n,) blocks of parameters that follow linear deformations. A group does when all of
            its members do: known ground tells how it is deformed.
        sigma: (n, k) a priori standard deviations.
    """
    groups = int(group.max()) + 1
    told = np.maximum((np.diagonal(own, 0, 1, 2) * sigma**2).sum(axis=1), 1e-300)
    ridge = 1e-9 * told[:, None] * sigma**-2.0
    change = np.linalg.solve(own + ridge[:, :, None] * np.eye(own.shape[1]), followed)
    move, *linear = np.split(change, 3, axis=2)
    of_groups = np.stack([group == g for g in range(groups)])
    bends = [members for members in of_groups if deformable[members].all()]
    columns = _by_group(move, of_groups)
    bent = [_by_group(mode, bends) for mode in linear]
    return Gauge(group, columns, _orthonormal(columns), _orthonormal(np.hstack([columns, *bent])))


@njit(cache=True)
def followed_ground(equations: Equations, place: Array, n: int) -> tuple[Array, Array]:
    """Normal matrices (n, k, k) and right sides (n, k, 9) of the parameters that follow the ground best.

    It moves by a metre east, north and up; then by so much times each coordinate of the place (m, 2).
    """
    k = equations.by_parameters.shape[2]
    normal, right = np.zeros((n, k, k)), np.zeros((n, k, 9))
    for i in range(len(equations.point)):
        w, b = equations.weight[i], equations.block[i]
        if w == 0.0:
            continue
        for r in range(2):
            for q in range(k):
                scaled = w * equations.by_parameters[i, r, q]
                for s in range(k):
                    normal[b, q, s] += scaled * equations.by_parameters[i, r, s]
                for c in range(3):
                    moved = scaled * equations.by_ground[i, r, c]
                    right[b, q, c] += moved
                    right[b, q, 3 + c] += moved * place[i, 0]
                    right[b, q, 6 + c] += moved * place[i, 1]
    return normal, right


def _by_group(change: Array, members: Sequence[BoolArray] | BoolArray) -> Array:
    """Columns (n k, 3 g) of changes (n, k, 3), three for each group."""
    n, k, _ = change.shape
    parts = [np.where(own[:, None, None], change, 0.0).reshape(n * k, 3) for own in members]
    return np.hstack([np.zeros((n * k, 0)), *parts])


def _orthonormal(columns: Array) -> Array:
    u, values, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, values > 1e-9 * values[0]])
