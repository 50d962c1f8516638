"""Geoids: heights of vertical datums above the WGS 84 ellipsoid, from grids that PROJ reads."""

from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import ProjError

from amers.services.datums import missing_grids, transformations
from amers.services.errors import InputError, MissingGeoid, VerticalDatumError
from amers.services.map_grid import crs_of_code
from amers.services.terrain import Geoid
from amers.services.types import Array

NAMED = {"EGM84": "EPSG:5798", "EGM96": "EPSG:5773", "EGM2008": "EPSG:3855"}
"""Codes of vertical reference systems, by their common names."""

_MAX_GEOID_M = 120.0
"""Largest height of a geoid above or below the ellipsoid: EGM2008 ranges from -107 to 86 m."""


def geoid_of_grid(path: Path) -> Geoid:
    """The geoid in a grid file, GTX or GeoTIFF, with bilinear interpolation.

    Raises:
        VerticalDatumError: PROJ cannot read the file, or it does not contain a geoid.
    """
    name = str(path.resolve())
    if not path.is_file() or any(letter in name for letter in '",'):
        raise VerticalDatumError(
            f'{path}: expected an existing grid file of a geoid, without , or " in its name'
        )
    pipeline = f'+proj=vgridshift +grids="{name}" +multiplier=1'
    try:
        transformer = Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step {pipeline} "
            "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
    except ProjError as error:
        raise VerticalDatumError(f"{path}: PROJ cannot read a geoid from this file: {error}") from error
    geoid = _geoid(transformer)
    axes = np.meshgrid(np.arange(-179.5, 180.0, 1.0), np.arange(-89.5, 90.0, 1.0))
    heights = geoid(np.column_stack([axis.ravel() for axis in axes]))
    if np.isnan(heights).all() or np.nanmax(np.abs(heights)) > _MAX_GEOID_M:
        raise VerticalDatumError(
            f"{path}: no geoid found, a grid of heights within {_MAX_GEOID_M:g} m of the ellipsoid "
            "expected"
        )
    return geoid


def geoid_of_crs(vertical: CRS) -> Geoid:
    """The height above the ellipsoid of the zero of a vertical reference system.

    Raises:
        MissingGeoid: PROJ has no transformation to the ellipsoid with an installed grid.
    """
    compound = CompoundCRS("position and height", ["EPSG:4326", vertical])
    group = transformations(compound)
    if not group.transformers:
        raise MissingGeoid(
            f"heights in {vertical.name} cannot be converted to heights above the ellipsoid"
            f"{missing_grids(compound)}; or give the grid file of the geoid"
        )
    return _geoid(group.transformers[0])


def vertical_crs(name: str) -> CRS | None:
    """The vertical reference system with a name; None for the ellipsoid.

    Args:
        name: "ellipsoid", "EGM84", "EGM96", "EGM2008", or a code such as "EPSG:5720".

    Raises:
        VerticalDatumError: the name is none of these.
    """
    if name.lower() in ("ellipsoid", "wgs84", "wgs 84"):
        return None
    try:
        crs = crs_of_code(NAMED.get(name.upper(), name))
    except InputError:
        crs = None
    if crs is None or not crs.is_vertical or crs.is_compound:
        raise VerticalDatumError(
            f"vertical datum: {name[:80]} given; expected ellipsoid, {', '.join(NAMED)} or the code of "
            "a vertical reference system"
        )
    return crs


def _geoid(transformer: Transformer) -> Geoid:
    def height_m(lon_lat: Array) -> Array:
        zero = np.zeros(len(lon_lat))
        above = np.asarray(transformer.transform(lon_lat[:, 0], lon_lat[:, 1], zero)[2])
        return np.where(np.isfinite(above), above, np.nan)

    return height_m
