"""Reference systems that coordinates can be asked for in, named as OGC names them."""

from dataclasses import dataclass

import numpy as np

from services.types import Array

EARTH_RADIUS_M = 6_378_137.0
"""Of the sphere that EPSG:3857 takes the Earth for."""
OGC = "http://www.opengis.net/def/crs/"


@dataclass(frozen=True)
class Crs:
    """A reference system of replies and of questions.

    Attributes:
        uri: as OGC names it.
        srid: of the same in PostGIS, whose order of axes is always longitude or east first.
        lat_first: whether its own order is latitude first.
        has_height: whether positions carry the height above the ellipsoid.
        in_degrees: whether horizontal coordinates are angles; metres otherwise.
    """

    uri: str
    srid: int
    lat_first: bool = False
    has_height: bool = False
    in_degrees: bool = True


CRS84 = Crs(f"{OGC}OGC/1.3/CRS84", 4326)
CRS84H = Crs(f"{OGC}OGC/0/CRS84h", 4979, has_height=True)
EPSG_4326 = Crs(f"{OGC}EPSG/0/4326", 4326, lat_first=True)
EPSG_4979 = Crs(f"{OGC}EPSG/0/4979", 4979, lat_first=True, has_height=True)
EPSG_3857 = Crs(f"{OGC}EPSG/0/3857", 3857, in_degrees=False)

FLAT = (CRS84, EPSG_4326, EPSG_3857)
WITH_HEIGHT = (CRS84H, CRS84, EPSG_4979, EPSG_4326, EPSG_3857)
EVERY = {crs.uri: crs for crs in WITH_HEIGHT}


def from_storage(geometry: str, crs: Crs) -> str:
    """SQL of a stored geometry (longitude, latitude and perhaps height) in a reference system.

    Args:
        geometry: SQL of the geometry.
        crs: asked for.
    """
    if not crs.has_height:
        geometry = f"st_setsrid(st_force2d({geometry}), 4326)"
    if crs.srid == EPSG_3857.srid:
        geometry = f"st_transform({geometry}, 3857)"
    return geometry


def in_own_order(geometry: str, crs: Crs) -> str:
    """SQL of a geometry with the axes in the order of the reference system itself."""
    return f"st_flipcoordinates({geometry})" if crs.lat_first else geometry


def lon_lat_from_mercator(east_north_m: Array) -> Array:
    """Positions (n, 2) in EPSG:3857 as longitude and latitude; longitudes go on beyond 180 degrees."""
    east, north = (east_north_m / EARTH_RADIUS_M).T
    lon_lat: Array = np.degrees(np.column_stack([east, np.arctan(np.sinh(north))]))
    return lon_lat
