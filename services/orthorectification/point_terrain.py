"""A terrain through control points, for scenes that come without heights of the ground."""

from contextlib import suppress

import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import QhullError

from amers.services.errors import CoverageError
from amers.services.geodesy import longitudes_near
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.terrain import Terrain
from amers.services.types import Array

_NODES = 129
"""Nodes of the terrain along each side."""


def terrain_of_points(lon_lat_h: Array, around: Array) -> Terrain:
    """A terrain that is linear between points, and as high as the nearest one outside of them.

    Args:
        lon_lat_h: (n, 3) degrees, degrees, metres above the ellipsoid.
        around: (m, 2) longitudes and latitudes, continuous, whose box the terrain covers.

    Raises:
        CoverageError: there are no points.
    """
    if not len(lon_lat_h):
        raise CoverageError(
            "no control points found, at least one is expected for heights of the ground"
        )
    west, south = around.min(axis=0)
    east, north = around.max(axis=0)
    places = np.column_stack([longitudes_near(lon_lat_h[:, 0], (west + east) / 2.0), lon_lat_h[:, 1]])
    step = np.array([east - west, north - south]) / (_NODES - 1)
    lon, lat = np.meshgrid(west + step[0] * np.arange(_NODES), north - step[1] * np.arange(_NODES))
    # Degrees of longitude are shorter: the nearest point is looked for in equal lengths.
    scale = np.array([np.cos(np.radians((south + north) / 2.0)), 1.0])
    nodes = np.column_stack([lon.ravel(), lat.ravel()]) * scale
    heights = np.full(len(nodes), np.nan)
    # Fewer than three points, or points on a line, have no triangles.
    with suppress(QhullError):
        heights = LinearNDInterpolator(places * scale, lon_lat_h[:, 2])(nodes)
    outside = np.isnan(heights)
    heights[outside] = NearestNDInterpolator(places * scale, lon_lat_h[:, 2])(nodes[outside])
    pixels = heights.reshape(_NODES, _NODES).astype(np.float32)
    grid = MapGrid(
        "EPSG:4326",
        np.array([west, north]),
        np.array([[0.0, step[0]], [-step[1], 0.0]]),
        (_NODES, _NODES),
    )
    count = len(lon_lat_h)
    origin = f"interpolated between {count} control points" if count > 1 else "that of one control point"
    return Terrain(grid, ArrayImage(pixels), None, origin)
