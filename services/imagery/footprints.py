"""Footprints on the ground, across the antimeridian and around the poles.

A footprint on the ground has continuous longitudes, which may go beyond 180 degrees, and includes a pole
as an edge along the latitude of 90 degrees. So every footprint is a plain polygon of two coordinates.
"""

import numpy as np
import shapely

from amers.services.types import Array

_POLAR_LATITUDE_DEG = 75.0
"""Footprints that reach beyond have edges in the plane of the pole, where straight lines are short."""
_POLAR_STEP_DEG = 0.05
"""Longest edge of such a footprint, degrees of latitude: 5.6 km."""


def footprint_on_ground(shape: shapely.Geometry) -> shapely.Geometry:
    """A footprint with continuous longitudes, from a Polygon or MultiPolygon of GeoJSON.

    Edges are straight in longitude and latitude (RFC 7946). Where a ring jumps by more than 180 degrees
    of longitude, it crosses the antimeridian. Beyond 75 degrees of latitude, edges are straight in the
    azimuthal plane of the pole, unless a corner lies at the pole itself; a ring around a pole includes
    it.
    """
    lon_lat = shapely.get_coordinates(shape)
    if (
        len(lon_lat)
        and np.ptp(lon_lat[:, 0]) <= 180.0
        and np.abs(lon_lat[:, 1]).max() <= _POLAR_LATITUDE_DEG
    ):
        return shapely.force_2d(shape)
    parts = [_part_on_ground(part) for part in shapely.get_parts(shape) if not part.is_empty]
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)


def _part_on_ground(polygon: shapely.Geometry) -> shapely.Geometry:
    lon_lat = shapely.get_coordinates(polygon)
    latitude = np.abs(lon_lat[:, 1])
    if latitude.max() >= 90.0:
        return shapely.force_2d(polygon)
    if latitude.max() > _POLAR_LATITUDE_DEG and np.ptp(lon_lat[:, 1]) < 90.0 - _POLAR_LATITUDE_DEG:
        return _polar_part(polygon)
    exterior, *holes = (shapely.get_coordinates(ring) for ring in shapely.get_rings(polygon))
    outer = _unwrapped(exterior)
    middle = float(outer[:, 0].mean())
    inner = [_unwrapped(hole) for hole in holes]
    for hole in inner:
        hole[:, 0] += 360.0 * np.round((middle - hole[:, 0].mean()) / 360.0)
    return shapely.Polygon(outer, inner)


def _polar_part(polygon: shapely.Geometry) -> shapely.Geometry:
    """A polygon near a pole, its edges straight in the azimuthal plane; holes are left out."""
    exterior = shapely.get_coordinates(shapely.get_exterior_ring(polygon))
    sign = 1.0 if exterior[:, 1].mean() > 0.0 else -1.0
    radius, angle = 90.0 - sign * exterior[:, 1], np.radians(exterior[:, 0])
    plane = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    x, y = shapely.get_coordinates(shapely.segmentize(shapely.linestrings(plane), _POLAR_STEP_DEG)).T
    outer = _unwrapped(np.column_stack([np.degrees(np.arctan2(y, x)), sign * (90.0 - np.hypot(x, y))]))
    if abs(outer[-1, 0] - outer[0, 0]) > 180.0:
        pole = [(outer[-1, 0], sign * 90.0), (outer[0, 0], sign * 90.0)]
        outer = np.concatenate([outer, pole])
    return shapely.Polygon(outer)


def _unwrapped(lon_lat: Array) -> Array:
    """Positions (n, 2) along a ring with continuous longitudes."""
    return np.column_stack([np.unwrap(lon_lat[:, 0], period=360.0), lon_lat[:, 1]])
