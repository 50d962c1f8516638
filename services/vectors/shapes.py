"""Geometries as arrays of vertices without duplicates, and the conversion back."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import shapely

from amers.services.errors import InputError
from amers.services.types import Array, BoolArray, IntArray

Geometries = npt.NDArray[np.object_]
"""Geometries (n,) of shapely; None where a feature has none."""

_MULTI = {4: shapely.multipoints, 5: shapely.multilinestrings, 6: shapely.multipolygons}
_NO_HEIGHT = -1e30
_KINDS = "points, lines, polygons and several of these expected"


@dataclass(frozen=True)
class Shapes:
    """n geometries as paths of vertices: a point, a line, or a ring of a polygon is one path.

    Attributes:
        geometries: (n,) that they were made of, for their types.
        vertices: (v, 2) or (v, 3) distinct positions, in the order of their coordinates.
        index: (m,) rows of `vertices`, path after path.
        path_size: (p,) vertices of each path.
        path_part: (p,) rows of `parts`.
        parts: (k,) points, lines and polygons that the geometries consist of.
        part_geometry: (k,) rows of `geometries`.
    """

    geometries: Geometries
    vertices: Array
    index: IntArray
    path_size: IntArray
    path_part: IntArray
    parts: Geometries
    part_geometry: IntArray

    def __len__(self) -> int:
        return len(self.geometries)

    @property
    def geometry_of(self) -> IntArray:
        """Rows of `geometries` (m,) that the entries of `index` belong to."""
        return np.repeat(self.part_geometry[self.path_part], self.path_size)

    @property
    def vertex_of(self) -> IntArray:
        """Numbers (m,) of the entries of `index` within their geometries, from 1."""
        geometry = self.geometry_of
        start = np.flatnonzero(np.r_[True, geometry[1:] != geometry[:-1]][: len(geometry)])
        run = np.diff(np.r_[start, len(geometry)])
        return np.arange(len(geometry)) - np.repeat(start, run) + 1

    def with_vertices(self, vertices: Array) -> "Shapes":
        """The same shapes at other positions (v, d)."""
        return replace(self, vertices=vertices)

    def having(self, of_vertex: BoolArray) -> BoolArray:
        """Which geometries (n,) have a vertex of a mask (v,)."""
        out = np.zeros(len(self), dtype=bool)
        out[self.geometry_of[of_vertex[self.index]]] = True
        return out

    def largest(self, of_vertex: Array) -> Array:
        """The largest value (n,) of the vertices (v,) of each geometry; NaN with one or without any."""
        out = np.full(len(self), -np.inf)
        with np.errstate(invalid="ignore"):
            np.maximum.at(out, self.geometry_of, of_vertex[self.index])
        return np.where(np.isfinite(out), out, np.nan)


def shapes_of(geometries: Geometries) -> Shapes:
    """Geometries as vertices; those without coordinates have none.

    Raises:
        InputError: a geometry is of another type, or a coordinate is no finite number; the message
            names the feature, counted from 1.
    """
    kinds = shapely.get_type_id(geometries)
    other = np.flatnonzero(~np.isin(kinds, (-1, 0, 1, 3, 4, 5, 6)))
    if len(other):
        raise InputError(f"feature {other[0] + 1}: {geometries[other[0]].geom_type} found, {_KINDS}")
    parts, part_geometry = shapely.get_parts(geometries, return_index=True)
    is_polygon = shapely.get_type_id(parts) == shapely.GeometryType.POLYGON
    rings, ring_part = shapely.get_rings(parts[is_polygon], return_index=True)
    path_part = np.r_[np.flatnonzero(is_polygon)[ring_part], np.flatnonzero(~is_polygon)]
    paths = np.concatenate([rings, parts[~is_polygon]])
    order = np.argsort(path_part, kind="stable")
    has_z = bool(shapely.has_z(geometries).any())
    positions, path = shapely.get_coordinates(paths[order], include_z=has_z, return_index=True)
    shapes = Shapes(
        geometries,
        positions,
        np.arange(len(positions)),
        np.bincount(path, minlength=len(paths)),
        path_part[order].astype(np.int64),
        parts,
        part_geometry.astype(np.int64),
    )
    lost = np.flatnonzero(~np.isfinite(positions[:, :2]).all(axis=1))
    if len(lost):
        raise InputError(
            f"{place_of(shapes, int(lost[0]))}: a coordinate that is no finite number found"
        )
    vertices, index = _distinct(positions)
    return replace(shapes, vertices=vertices, index=index)


def geometries_of(shapes: Shapes) -> Geometries:
    """The geometries (n,) of shapes, of the types that they were made of."""
    parts = shapes.parts.copy()
    positions = shapes.vertices[shapes.index]
    kind = shapely.get_type_id(shapes.parts)[shapes.path_part]
    filled = shapes.path_size > 0
    of_path = np.repeat(np.arange(len(shapes.path_size)), shapes.path_size)
    for type_id, build in ((0, _points), (1, shapely.linestrings), (3, shapely.linearrings)):
        paths = np.flatnonzero((kind == type_id) & filled)
        if not len(paths):
            continue
        rows = (kind == type_id)[of_path]
        built = build(positions[rows], indices=np.repeat(np.arange(len(paths)), shapes.path_size[paths]))
        part = shapes.path_part[paths]
        if type_id == shapely.GeometryType.POLYGON:
            polygons, of_ring = np.unique(part, return_inverse=True)
            parts[polygons] = shapely.polygons(built, indices=of_ring)
        else:
            parts[part] = built
    out = shapes.geometries.copy()
    kinds = shapely.get_type_id(out)[shapes.part_geometry]
    single = kinds < min(_MULTI)
    out[shapes.part_geometry[single]] = parts[single]
    for type_id, collect in _MULTI.items():
        rows = kinds == type_id
        if rows.any():
            geometries, owner = np.unique(shapes.part_geometry[rows], return_inverse=True)
            out[geometries] = collect(parts[rows], indices=owner)
    return out


def place_of(shapes: Shapes, entry: int) -> str:
    """The feature and the vertex of an entry of `index`, counted from 1, for people."""
    return f"feature {shapes.geometry_of[entry] + 1}, vertex {shapes.vertex_of[entry]}"


def _points(positions: Array, indices: IntArray) -> Geometries:
    return np.asarray(shapely.points(positions))


def _distinct(positions: Array) -> tuple[Array, IntArray]:
    """The distinct rows of (m, 2) or (m, 3) positions, ordered, and the row of each."""
    keys = positions[:, 0] + 1j * positions[:, 1]
    if positions.shape[1] == 3:
        place = np.unique(keys, return_inverse=True)[1]
        keys = place + 1j * np.nan_to_num(positions[:, 2], nan=_NO_HEIGHT)
    _, first, index = np.unique(keys, return_index=True, return_inverse=True)
    return positions[first], index.astype(np.int64)
