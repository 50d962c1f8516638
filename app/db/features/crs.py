"""Reference systems of coordinates in requests and replies, named by their OGC URI."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import ColumnElement, func

from amers.app.db.constants import integer_constant
from amers.services.types import Array

EARTH_RADIUS_M = 6_378_137.0
"""Radius of the sphere of EPSG:3857."""
OGC = "http://www.opengis.net/def/crs/"


@dataclass(frozen=True)
class Crs:
    """A reference system of requests and replies.

    Attributes:
        uri: its OGC name.
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


def from_storage(geometry: ColumnElement[Any], crs: Crs) -> ColumnElement[Any]:
    """A stored geometry (longitude, latitude and perhaps height) in a reference system."""
    if not crs.has_height:
        geometry = func.st_setsrid(func.st_force2d(geometry), integer_constant(EPSG_4326.srid))
    if crs.srid == EPSG_3857.srid:
        geometry = func.st_transform(geometry, integer_constant(EPSG_3857.srid))
    return geometry


def in_own_order(geometry: ColumnElement[Any], crs: Crs) -> ColumnElement[Any]:
    """A geometry with the axes in the order of the reference system itself."""
    return func.st_flipcoordinates(geometry) if crs.lat_first else geometry


def lon_lat_from_mercator(east_north_m: Array) -> Array:
    """Positions (n, 2) in EPSG:3857 as longitude and latitude; longitudes may exceed 180 degrees."""
    east, north = (east_north_m / EARTH_RADIUS_M).T
    lon_lat: Array = np.degrees(np.column_stack([east, np.arctan(np.sinh(north))]))
    return lon_lat
