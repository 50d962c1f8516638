"""Curved edges: vertices that are added where a transformation bends a straight edge.

An edge is transformed at places between its ends, at more of them where it bends, and as few of these
become vertices as keep within the tolerance (Douglas and Peucker 1973). Edges that two geometries
share are treated once, so that neighbours keep a common border.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from amers.services.types import Array, BoolArray, IntArray
from amers.services.vectors.shapes import Shapes

_BATCH = 2_000_000
"""Places that are transformed at once."""
_MOST_PIECES = 1_000_000
_SEEN = 0.5
"""Share of the tolerance for what the places show; the rest is for what lies between them."""
_UNSEEN = (1.0 - _SEEN) / _SEEN


@dataclass(frozen=True)
class Transformation:
    """A transformation that bends straight edges.

    Attributes:
        apply: positions (n, d) of others (n, e); NaN where it is undefined.
        pieces: number (k,), as a float, of pieces that edges between positions (k, e) and (k, e) are
            cut into, so that a piece bends at most once.
        finest: as `pieces`, but never into more, however the edge bends.
        tolerance: (d,) largest distance of a vertex left out from the straight edge, in the units of
            each target coordinate; 0 for coordinates that may bend.
    """

    apply: Callable[[Array], Array]
    pieces: Callable[[Array, Array], Array]
    finest: Callable[[Array, Array], Array]
    tolerance: Array


@dataclass(frozen=True)
class Curves:
    """Shapes with vertices between the given ones, before and after their transformation.

    Attributes:
        source: with all vertices, not transformed.
        target: the same, transformed; NaN where the transformation is undefined.
        broken: (n,) geometries with a place between two vertices where it is undefined.
    """

    source: Shapes
    target: Shapes
    broken: BoolArray


def curved(shapes: Shapes, transformation: Transformation) -> Curves:
    """Shapes under a transformation, with vertices where straight edges miss the bent ones."""
    start = np.cumsum(shapes.path_size) - shapes.path_size
    is_last = np.zeros(len(shapes.index), dtype=bool)
    is_last[(start + shapes.path_size - 1)[shapes.path_size > 0]] = True
    first = np.flatnonzero(~is_last)
    ends = np.column_stack([shapes.index[first], shapes.index[first + 1]])
    is_reversed = ends[:, 0] > ends[:, 1]
    count = len(shapes.vertices)
    key, edge = np.unique(ends.min(axis=1) * count + ends.max(axis=1), return_inverse=True)
    low, high = np.divmod(key, max(count, 1))
    target = _applied(transformation, shapes.vertices)
    between = _between(shapes.vertices, target, (low, high), transformation)
    entries = np.ones(len(shapes.index), dtype=np.int64)
    entries[first] += between.size[edge]
    index = _spliced(shapes.index, entries, first, edge, is_reversed, between.size, len(shapes.vertices))
    path = np.repeat(np.arange(len(shapes.path_size)), shapes.path_size)
    path_size = np.bincount(path, weights=entries, minlength=len(shapes.path_size)).astype(np.int64)
    broken = np.zeros(len(shapes), dtype=bool)
    broken[shapes.geometry_of[first][between.broken[edge]]] = True
    source = replace(
        shapes,
        vertices=np.concatenate([shapes.vertices, between.source]),
        index=index,
        path_size=path_size,
    )
    return Curves(source, source.with_vertices(np.concatenate([target, between.target])), broken)


@dataclass(frozen=True)
class _Between:
    """The new vertices of k edges, edge after edge.

    Attributes:
        size: (k,) new vertices of each edge.
        source, target: of all edges.
        broken: (k,) edges with a place where the transformation is undefined.
    """

    size: IntArray
    source: Array
    target: Array
    broken: BoolArray


def _between(
    vertices: Array, target: Array, edges: tuple[IntArray, IntArray], transformation: Transformation
) -> _Between:
    """The vertices that edges between rows of `vertices` need."""
    low, high = edges
    pieces = np.ceil(np.nan_to_num(transformation.pieces(vertices[low], vertices[high])))
    pieces = np.clip(pieces, 2, _MOST_PIECES).astype(np.int64)
    pieces[low == high] = 1
    finest = np.maximum(pieces, transformation.finest(vertices[low], vertices[high]))
    tolerance = _SEEN * transformation.tolerance
    scale = np.divide(1.0, tolerance, out=np.zeros(len(tolerance)), where=tolerance > 0.0)
    size = np.zeros(len(low), dtype=np.int64)
    broken = np.zeros(len(low), dtype=bool)
    parts = []
    rows = np.arange(len(low))
    known = np.empty((0, len(tolerance)))
    while len(rows):
        rougher, seen, used = [], [], 0
        for batch in np.split(rows, np.flatnonzero(np.diff(np.cumsum(pieces[rows]) // _BATCH)) + 1):
            inner = pieces[batch] - 1
            owner = np.repeat(batch, inner)
            begin = np.cumsum(inner) - inner
            source, number = _places(vertices, low[batch], high[batch], pieces[batch])
            if len(known):
                # Of an edge with twice as many pieces, every second place is known.
                is_new = number % 2 == 1
                moved = np.empty((len(source), len(tolerance)))
                moved[is_new] = _applied(transformation, source[is_new])
                moved[~is_new] = known[used : used + len(source) - int(is_new.sum())]
                used += len(source) - int(is_new.sum())
            else:
                moved = _applied(transformation, source)
            ends = target[low[batch]] * scale, target[high[batch]] * scale
            kept, is_rough = _needed(begin, inner, moved * scale, *ends)
            is_rough &= 2 * pieces[batch] <= finest[batch]
            rougher.append(batch[is_rough])
            seen.append(moved[np.repeat(is_rough, inner)])
            kept &= ~np.repeat(is_rough, inner)
            broken[owner[_undefined(moved)]] = True
            size += np.bincount(owner[kept], minlength=len(low))
            parts.append((owner[kept], source[kept], moved[kept]))
        rows, known = np.concatenate(rougher), np.concatenate(seen)
        pieces[rows] *= 2
    if not parts:
        return _Between(size, vertices[:0], target[:0], broken)
    owner, source, moved = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.argsort(owner, kind="stable")
    return _Between(size, source[order], moved[order], broken)


@njit(cache=True)
def _places(vertices: Array, low: IntArray, high: IntArray, pieces: IntArray) -> tuple[Array, IntArray]:
    """Places (m, d) that cut edges (k,) into equal pieces, and their numbers along the edges, from 1."""
    count = (pieces - 1).sum()
    out, number = np.empty((count, vertices.shape[1])), np.empty(count, dtype=np.int64)
    row = 0
    for e in range(len(low)):
        start, end = vertices[low[e]], vertices[high[e]]
        for k in range(1, pieces[e]):
            for d in range(vertices.shape[1]):
                out[row, d] = start[d] + k / pieces[e] * (end[d] - start[d])
            number[row] = k
            row += 1
    return out, number


@njit(cache=True)
def _undefined(at: Array) -> BoolArray:
    """Positions (n,) of others (n, d) with a coordinate that is not finite."""
    out = np.zeros(len(at), dtype=np.bool_)
    for i in range(len(at)):
        for d in range(at.shape[1]):
            out[i] |= not np.isfinite(at[i, d])
    return out


def _applied(transformation: Transformation, positions: Array) -> Array:
    """As the transformation; it sees no empty arrays."""
    if not len(positions):
        return np.empty((0, len(transformation.tolerance)))
    return transformation.apply(positions)


@njit(cache=True)
def _needed(
    begin: IntArray, inner: IntArray, at: Array, low: Array, high: Array
) -> tuple[BoolArray, BoolArray]:
    """The places (m,) of edges that must become vertices, and the edges (k,) that need more places.

    Distances are in tolerances.

    Args:
        begin, inner: (k,) first place of each edge, and how many it has.
        at: (m, d) the places.
        low, high: (k, d) ends of the edges.
    """
    kept = np.zeros(len(at), dtype=np.bool_)
    is_rough = np.zeros(len(begin), dtype=np.bool_)
    dims = at.shape[1]
    stack = np.empty((64, 2), dtype=np.int64)
    for e in range(len(begin)):
        line = np.empty((inner[e] + 2, dims))
        line[0], line[-1] = low[e], high[e]
        line[1:-1] = at[begin[e] : begin[e] + inner[e]]
        is_rough[e] = _unseen(line) > _UNSEEN
        depth = 0
        stack[0, 0], stack[0, 1] = 0, len(line) - 1
        while depth >= 0:
            first, last = stack[depth]
            depth -= 1
            farthest, place = _farthest(line, first, last)
            if not farthest > 1.0:
                continue
            kept[begin[e] + place - 1] = True
            if depth + 3 > len(stack):
                stack = np.concatenate((stack, stack))
            for a, b in ((first, place), (place, last)):
                if b - a > 1:
                    depth += 1
                    stack[depth, 0], stack[depth, 1] = a, b
    return kept, is_rough


@njit(cache=True)
def _unseen(line: Array) -> float:
    """How far a line (m, d) can be from straight between its places, if it bends once between them.

    A bend at a share f of a piece moves the next place by f of its whole effect, and leaves
    f (1 - f) of it unseen: at most the second difference there, or a quarter of both beside it.
    """
    largest, before = 0.0, -1.0
    for i in range(1, len(line) - 1):
        second = 0.0
        for d in range(line.shape[1]):
            second += (line[i - 1, d] - 2.0 * line[i, d] + line[i + 1, d]) ** 2
        second = np.sqrt(second)
        largest = max(largest, second if before < 0.0 else (before + second) / 4.0)
        before = second
    return max(largest, before)


@njit(cache=True)
def _farthest(line: Array, first: int, last: int) -> tuple[float, int]:
    """The largest squared distance of places between two others from the straight edge, and its row."""
    along = line[last] - line[first]
    length2 = (along**2).sum()
    largest, place = -1.0, first
    for i in range(first + 1, last):
        t, distance2 = 0.0, 0.0
        if length2 > 0.0:
            for d in range(len(along)):
                t += (line[i, d] - line[first, d]) * along[d]
            t = min(max(t / length2, 0.0), 1.0)
        for d in range(len(along)):
            distance2 += (line[i, d] - line[first, d] - t * along[d]) ** 2
        if distance2 > largest:
            largest, place = distance2, i
    return largest, place


def _spliced(  # noqa: PLR0917 - the parts of one array
    index: IntArray,
    entries: IntArray,
    first: IntArray,
    edge: IntArray,
    is_reversed: BoolArray,
    size: IntArray,
    count: int,
) -> IntArray:
    """The index of shapes, with the new vertices of each edge after its first vertex."""
    place = np.cumsum(entries) - entries
    out = np.empty(int(entries.sum()), dtype=np.int64)
    out[place] = index
    begin = count + np.cumsum(size) - size
    added = size[edge]
    step = np.arange(added.sum()) - np.repeat(np.cumsum(added) - added, added)
    backwards = np.repeat(begin[edge] + added - 1, added) - step
    forwards = np.repeat(begin[edge], added) + step
    out[np.repeat(place[first] + 1, added) + step] = np.where(
        np.repeat(is_reversed, added), backwards, forwards
    )
    return out
