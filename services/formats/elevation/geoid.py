"""Geoids: how far the zero of a height lies above the ellipsoid, from the grids PROJ reads."""

import warnings
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError, ProjError
from pyproj.transformer import TransformerGroup

from services.errors import VerticalDatumError
from services.terrain import Geoid
from services.types import Array

NAMED = {"EGM84": "EPSG:5798", "EGM96": "EPSG:5773", "EGM2008": "EPSG:3855"}
"""Vertical reference systems that are asked for by name."""

_FURTHEST_M = 120.0
"""No geoid is further from the ellipsoid: EGM2008 reaches from -107 to 86 m."""


def geoid_of_grid(path: Path) -> Geoid:
    """The geoid in a grid file, GTX or GeoTIFF, bilinear between its nodes.

    Raises:
        VerticalDatumError: when PROJ cannot read the file, or it holds no geoid.
    """
    name = str(path.resolve())
    if not path.is_file() or any(letter in name for letter in '",'):
        raise VerticalDatumError(
            f"{path}: expected the file of a geoid's grid, without , or \" in its name"
        )
    pipeline = f'+proj=vgridshift +grids="{name}" +multiplier=1'
    try:
        transformer = Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step {pipeline} "
            "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
    except ProjError as error:
        raise VerticalDatumError(f"{path}: PROJ reads no geoid there: {error}") from error
    geoid = _geoid(transformer)
    axes = np.meshgrid(np.arange(-179.5, 180.0, 1.0), np.arange(-89.5, 90.0, 1.0))
    heights = geoid(np.column_stack([axis.ravel() for axis in axes]))
    if np.isnan(heights).all() or np.nanmax(np.abs(heights)) > _FURTHEST_M:
        raise VerticalDatumError(
            f"{path}: no geoid: it should have heights within {_FURTHEST_M:g} m of the ellipsoid"
        )
    return geoid


def geoid_of_crs(vertical: CRS) -> Geoid:
    """The geoid, or the other zero, of a vertical reference system, when PROJ has its grid installed.

    Raises:
        VerticalDatumError: when no transformation with an installed grid leads to the ellipsoid.
    """
    whole = CompoundCRS("place and height", ["EPSG:4326", vertical])
    with warnings.catch_warnings():
        # That the best way is not installed is told below, or does not matter.
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup(whole, "EPSG:4979", always_xy=True, allow_ballpark=False)
    if not group.transformers:
        missing = sorted({grid.short_name for way in group.unavailable_operations for grid in way.grids})
        hint = f": PROJ misses {' or '.join(missing)}" if missing else ""
        raise VerticalDatumError(
            f"heights in {vertical.name} cannot be turned into heights above the ellipsoid{hint}; "
            "give the grid file of the geoid"
        )
    return _geoid(group.transformers[0])


def vertical_crs(name: str) -> CRS | None:
    """A vertical reference system by its name; None for the ellipsoid.

    Args:
        name: "ellipsoid", "EGM84", "EGM96", "EGM2008", or what PROJ understands, like "EPSG:5720".

    Raises:
        VerticalDatumError: when it is none of those.
    """
    if name.lower() in ("ellipsoid", "wgs84", "wgs 84"):
        return None
    try:
        crs = CRS.from_user_input(NAMED.get(name.upper(), name))
    except CRSError:
        crs = None
    if crs is None or not crs.is_vertical or crs.is_compound:
        raise VerticalDatumError(
            f"{name}: expected ellipsoid, {', '.join(NAMED)} or the code of a vertical reference system"
        )
    return crs


def _geoid(transformer: Transformer) -> Geoid:
    def height_m(lon_lat: Array) -> Array:
        zero = np.zeros(len(lon_lat))
        above = np.asarray(transformer.transform(lon_lat[:, 0], lon_lat[:, 1], zero)[2])
        return np.where(np.isfinite(above), above, np.nan)

    return height_m
