"""Image positions of vectors of a map, through the model of a raw image and a terrain."""

from dataclasses import dataclass

import numpy as np
import shapely

from amers.services.errors import InputError
from amers.services.geodesy import continuous
from amers.services.imagery.scene import Scene, scene_centre, scene_footprint, scene_gsd_m
from amers.services.lines_of_sight import intersect_terrain
from amers.services.map_grid import lon_lat_of_xy, xy_of_lon_lat
from amers.services.terrain import Terrain
from amers.services.types import Array, BoolArray
from amers.services.vectors.correct import FINEST_PIECE_PX, has_heights, units_per_metre
from amers.services.vectors.curves import Transformation, curved
from amers.services.vectors.shapes import Geometries, Shapes

HIDDEN_M = 0.1
"""A vertex is hidden where the line of sight first meets ground that is higher by more than this."""


@dataclass(frozen=True)
class ProjectedVectors:
    """Vectors in the image.

    Attributes:
        shapes: with image positions (v, 2), line and sample; NaN where there is no height of the ground,
            or far from the image.
        lon_lat_h: (v, 3) the vertices on the ground.
        hidden: (v,) whether other ground hides the vertex from the sensor.
        missed: (n,) geometries with a place that has no position in the image.
        added: vertices that were added to edges.
    """

    shapes: Shapes
    lon_lat_h: Array
    hidden: BoolArray
    missed: BoolArray
    added: int


def project_vectors(
    shapes: Shapes, scene: Scene, terrain: Terrain, crs: str, *, tolerance_px: float
) -> ProjectedVectors:
    """Vectors of a map in a raw image.

    Args:
        shapes: with map positions (v, 2), easting or longitude first, or with heights (v, 3), which have
            the vertical datum of the terrain, or are above the ellipsoid where the reference system has
            heights. The terrain has the heights that are missing or NaN.
        scene: with its registered model.
        terrain: the ground.
        crs: code or WKT of the reference system of the map.
        tolerance_px: vertices are added where an edge of the map is bent in the image by more.
    """
    piece_m, posting_m = FINEST_PIECE_PX * scene_gsd_m(scene), terrain.posting_m
    units = units_per_metre(crs, scene_centre(scene))
    above_ellipsoid = has_heights(crs)

    def seen(positions: Array) -> Array:
        """Line, sample, longitude, latitude and height."""
        lon_lat = lon_lat_of_xy(crs, positions[:, :2])
        height_m = np.full(len(positions), np.nan)
        if positions.shape[1] == 3:
            height_m = positions[:, 2].copy()
            if terrain.geoid is not None and not above_ellipsoid:
                height_m += terrain.geoid(lon_lat)
        flat = np.isnan(height_m) & np.isfinite(lon_lat).all(axis=1)
        height_m[flat] = terrain.height_m(lon_lat[flat])
        ground = np.column_stack([lon_lat, height_m])
        return np.column_stack([scene.model.project(ground), ground])

    def pieces(start: Array, end: Array) -> Array:
        return np.minimum(finest(start, end), finest(start, end) * piece_m / posting_m)

    def finest(start: Array, end: Array) -> Array:
        return np.asarray(np.hypot(*((end - start)[:, :2] / units).T) / piece_m)

    tolerance = np.array([tolerance_px, tolerance_px, 0.0, 0.0, 0.0])
    curves = curved(shapes, Transformation(seen, pieces, finest, tolerance))
    line_sample, ground = np.split(curves.target.vertices, [2], axis=1)
    known = np.asarray(np.isfinite(line_sample).all(axis=1))
    hidden = np.zeros(len(ground), dtype=bool)
    inside = known & _inside(line_sample, scene.image.shape)
    if inside.any():
        met = intersect_terrain(scene.model, line_sample[inside], terrain)
        hidden[inside] = met[:, 2] > ground[inside, 2] + HIDDEN_M
    return ProjectedVectors(
        curves.source.with_vertices(line_sample),
        ground,
        hidden,
        curves.broken | curves.source.having(~known),
        len(curves.source.index) - len(shapes.index),
    )


def hidden_share(projected: ProjectedVectors) -> Array:
    """Share (n,) of the vertices of each geometry that are hidden; NaN without vertices."""
    geometry = projected.shapes.geometry_of
    count = np.bincount(geometry, minlength=len(projected.shapes)).astype(np.float64)
    hidden = np.bincount(
        geometry, projected.hidden[projected.shapes.index], minlength=len(projected.shapes)
    )
    return np.divide(hidden, count, out=np.full(len(count), np.nan), where=count > 0.0)


def ground_outline(scene: Scene, terrain: Terrain, crs: str) -> shapely.Polygon:
    """Outline on a map of the ground that an image can show, with a hundredth of its size around it.

    Raises:
        CoverageError: the terrain is elsewhere.
    """
    heights_m = terrain.around(scene_footprint(scene)).range_m()
    outline = continuous(scene_footprint(scene, heights_m))
    centre = outline.mean(axis=0)
    xy = xy_of_lon_lat(crs, centre + 1.01 * (outline - centre))
    return shapely.convex_hull(shapely.multipoints(xy[np.isfinite(xy).all(axis=1)]))


def image_outline(shape: tuple[int, int]) -> shapely.Polygon:
    """Outline of an image with lines and samples, as line and sample."""
    return shapely.box(-0.5, -0.5, shape[0] - 0.5, shape[1] - 0.5)


def cut(geometries: Geometries, outline: shapely.Polygon) -> Geometries:
    """The parts (n,) of geometries inside an outline, of the same dimension; None where there are none.

    Raises:
        InputError: the outline of a polygon crosses itself; the message names the feature.
    """
    out = geometries.copy()
    rows = np.flatnonzero(~shapely.is_missing(geometries) & ~shapely.is_empty(geometries))
    rows = rows[~shapely.within(geometries[rows], outline)]
    invalid = rows[~shapely.is_valid(geometries[rows])]
    if len(invalid):
        reason = shapely.is_valid_reason(geometries[invalid[0]])
        raise InputError(
            f"feature {invalid[0] + 1}: {reason}; it cannot be cut at the border of the image. Mend it, "
            "or do without --clip"
        )
    dimension = shapely.get_dimensions(geometries[rows])
    parts, owner = shapely.get_parts(shapely.intersection(geometries[rows], outline), return_index=True)
    same = (shapely.get_dimensions(parts) == dimension[owner]) & ~shapely.is_empty(parts)
    out[rows] = None
    for row in np.unique(owner[same]):
        kept = parts[same & (owner == row)]
        out[rows[row]] = kept[0] if len(kept) == 1 else shapely.union_all(kept)
    return out


def _inside(line_sample: Array, shape: tuple[int, int]) -> BoolArray:
    low, high = -0.5, np.array(shape) - 0.5
    return np.asarray(((line_sample >= low) & (line_sample <= high)).all(axis=1))
