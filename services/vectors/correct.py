"""Map positions of vectors digitised on a raw image, through its model and a terrain."""

import math
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m
from amers.services.lines_of_sight import ground_in_sight, intersect_terrain
from amers.services.map_grid import MapGrid, xy_of_lon_lat
from amers.services.terrain import Terrain
from amers.services.types import Array, BoolArray
from amers.services.vectors.accuracy import ErrorSources, VertexAccuracy, predict_vertices
from amers.services.vectors.curves import Transformation, curved
from amers.services.vectors.shapes import Shapes, place_of

FINEST_PIECE_PX = 0.5
"""Edges are not cut into shorter pieces, however fine the terrain is."""


@dataclass(frozen=True)
class CorrectedVectors:
    """Vectors on the map.

    Attributes:
        shapes: with map positions and heights (v, 3), easting or longitude first; NaN where a line of
            sight meets no ground. Heights have the vertical datum of the terrain, or are above the
            ellipsoid where the reference system has heights.
        line_sample: (v, 2) the vertices in the image.
        accuracy: of the vertices.
        missed: (n,) geometries with a place that meets no ground.
        added: vertices that were added to edges.
        height_sigma_m: of the heights of the terrain there, the median; NaN without any.
    """

    shapes: Shapes
    line_sample: Array
    accuracy: VertexAccuracy
    missed: BoolArray
    added: int
    height_sigma_m: float


def correct_vectors(
    shapes: Shapes,
    scene: Scene,
    terrain: Terrain,
    crs: str,
    *,
    sources: ErrorSources,
    tolerance_px: float,
) -> CorrectedVectors:
    """Vectors of a raw image on the map: where lines of sight first meet the ground.

    Args:
        shapes: with image positions (v, 2), line and sample.
        scene: whose image they were digitised on, with its registered model.
        terrain: the ground.
        crs: code of the reference system of the map.
        sources: of the errors of the vertices.
        tolerance_px: vertices are added where the ground bends an edge by more, pixels.

    Raises:
        CoverageError: no vertex comes near the terrain.
    """
    gsd_m, posting_m = scene_gsd_m(scene), terrain.posting_m
    if len(shapes.vertices):
        terrain = ground_in_sight(scene.model, shapes.vertices, terrain)

    def ground(line_sample: Array) -> Array:
        """x, y, longitude, latitude and height."""
        met = intersect_terrain(scene.model, line_sample, terrain)
        return np.column_stack([xy_of_lon_lat(crs, met[:, :2]), met])

    def pieces(start: Array, end: Array) -> Array:
        return np.minimum(finest(start, end), np.hypot(*(end - start).T) * gsd_m / posting_m)

    def finest(start: Array, end: Array) -> Array:
        return np.asarray(np.hypot(*(end - start).T) / FINEST_PIECE_PX)

    units = units_per_metre(crs, scene_centre(scene))
    tolerance = np.r_[tolerance_px * gsd_m * units, 0.0, 0.0, 0.0]
    curves = curved(shapes, Transformation(ground, pieces, finest, tolerance))
    line_sample, met = curves.source.vertices, curves.target.vertices[:, 2:]
    known = np.asarray(np.isfinite(met).all(axis=1))
    accuracy, height_sigma_m = _unknown_accuracy(len(met)), math.nan
    if known.any():
        predicted = predict_vertices(scene.model, terrain, line_sample[known], met[known], sources)
        accuracy.relative_m2[known] = predicted.relative_m2
        accuracy.on_the_earth_m2[known] = predicted.on_the_earth_m2
        height_sigma_m = float(np.median(terrain.sigma_m(met[known])))
    height_m = met[:, 2].copy()
    if terrain.geoid is not None and not has_heights(crs) and known.any():
        height_m[known] -= terrain.geoid(met[known, :2])
    return CorrectedVectors(
        curves.source.with_vertices(np.column_stack([curves.target.vertices[:, :2], height_m])),
        line_sample,
        accuracy,
        curves.broken | curves.source.having(~known),
        len(curves.source.index) - len(shapes.index),
        height_sigma_m,
    )


def has_heights(crs: str) -> bool:
    """Whether positions in a reference system have a height above the ellipsoid."""
    return len(CRS.from_user_input(crs).axis_info) == 3


def units_per_metre(crs: str, lon_lat_h: Array) -> Array:
    """Map units (2,) per metre, along x and y, at a place (3,)."""
    grid = MapGrid(crs, np.zeros(2), np.eye(2), (1, 1))
    return np.asarray(np.linalg.norm(grid.derivative(lon_lat_h[None, :])[0], axis=1))


def missed_place(corrected: CorrectedVectors) -> str:
    """The first place that meets no ground, for people; "" when there is none."""
    index = corrected.shapes.index
    entries = np.flatnonzero(np.isnan(corrected.shapes.vertices[index]).any(axis=1))
    if len(entries):
        line, sample = corrected.line_sample[index[entries[0]]]
        place = place_of(corrected.shapes, int(entries[0]))
        return f"{place}, at line {line:.1f}, sample {sample:.1f}"
    if corrected.missed.any():
        return f"feature {int(np.argmax(corrected.missed)) + 1}, between two of its vertices"
    return ""


def _unknown_accuracy(count: int) -> VertexAccuracy:
    return VertexAccuracy(*(np.full((count, 2, 2), math.nan) for _ in range(2)))
