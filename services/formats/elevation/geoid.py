"""Geoids: heights of vertical datums above the WGS 84 ellipsoid, from grids that PROJ reads."""

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj._context import get_user_data_dir
from pyproj.crs import CompoundCRS
from pyproj.datadir import get_data_dir
from pyproj.exceptions import ProjError
from rasterio._env import get_proj_data_search_paths

from amers.services.datums import area_of, missing_grids, transformations
from amers.services.errors import InputError, MissingGeoid, VerticalDatumError
from amers.services.map_grid import crs_of_code
from amers.services.terrain import Geoid
from amers.services.types import Array

NAMED = {"EGM84": "EPSG:5798", "EGM96": "EPSG:5773", "EGM2008": "EPSG:3855"}
"""Codes of vertical reference systems, by their common names."""

GRIDS = {
    "EGM96": ("us_nga_egm96_15.tif", "egm96_15.gtx"),
    "EGM2008": ("us_nga_egm08_25.tif", "egm08_25.gtx"),
}
"""Published grids of PROJ, by its present and its former names."""
_POLES_M = {"EGM96": (13.606, -29.535), "EGM2008": (14.899, -30.150)}
"""Heights of the north and the south pole. Source: the grids of the NGA."""
_SAME_POLES_M = 0.1
_MAX_GEOID_M = 120.0
"""Largest height of a geoid above or below the ellipsoid: EGM2008 ranges from -107 to 86 m."""


def geoid_of_grid(path: Path) -> Geoid:
    """The geoid in a grid file, GTX or GeoTIFF, with bilinear interpolation.

    Args:
        path: of the file, or its name alone where it lies in one of the `grid_folders`.

    Raises:
        VerticalDatumError: there is no such file, PROJ cannot read it, or it does not contain a geoid.
    """
    path = find_grid(path)
    name = str(path.resolve())
    if any(letter in name for letter in '",'):
        raise VerticalDatumError(f'{path}: expected a grid file of a geoid without , or " in its name')
    pipeline = f'+proj=vgridshift +grids="{name}" +multiplier=1'
    try:
        transformer = Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step {pipeline} "
            "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
    except ProjError as error:
        raise VerticalDatumError(f"{path}: PROJ cannot read a geoid from this file: {error}") from error
    geoid = _TransformedGeoid(transformer)
    axes = np.meshgrid(np.arange(-179.5, 180.0, 1.0), np.arange(-89.5, 90.0, 1.0))
    heights = geoid(np.column_stack([axis.ravel() for axis in axes]))
    if np.isnan(heights).all() or np.nanmax(np.abs(heights)) > _MAX_GEOID_M:
        raise VerticalDatumError(
            f"{path}: no geoid found, a grid of heights within {_MAX_GEOID_M:g} m of the ellipsoid "
            "expected"
        )
    return geoid


def geoid_of_crs(vertical: CRS, place: Array) -> Geoid:
    """The height above the ellipsoid of the zero of a vertical reference system.

    Args:
        vertical: the reference system; its unit does not matter.
        place: (2,) longitude and latitude, by which PROJ chooses one of several operations.

    Raises:
        MissingGeoid: PROJ has no transformation to the ellipsoid with an installed grid.
    """
    compound = CompoundCRS("position and height", ["EPSG:4326", vertical])
    area = area_of(place)
    group = transformations(compound, area)
    if group.transformers:
        # A transformer of a group cannot be pickled, one of its pipeline can.
        return _TransformedGeoid(Transformer.from_pipeline(group.transformers[0].definition))
    wanted = [GRIDS[name] for name, code in NAMED.items() if vertical == CRS(code) and name in GRIDS]
    for grid in [grid for names in wanted for grid in names]:
        if found_grid(grid) is not None:
            return geoid_of_grid(Path(grid))
    raise MissingGeoid(
        f"heights in {vertical.name} cannot be converted to heights above the ellipsoid"
        f"{missing_grids(compound, area) or missing_grids(compound)}; or give the grid file of the geoid"
    )


def grid_folders() -> list[Path]:
    """Where grids of PROJ are kept: its data, those that `pyproj sync` gets, PROJ_DATA, the system's."""
    texts = [get_data_dir(), get_user_data_dir(), *get_proj_data_search_paths()]
    folders = [Path(part) for text in texts for part in text.split(os.pathsep) if part]
    system = [Path(sys.prefix) / "share/proj", Path("/usr/local/share/proj"), Path("/usr/share/proj")]
    return list(dict.fromkeys(folders + system))


def found_grid(name: str) -> Path | None:
    """The file of this name in the first of the `grid_folders` that has it; None without."""
    return next((folder / name for folder in grid_folders() if (folder / name).is_file()), None)


def find_grid(path: Path) -> Path:
    """The grid file at a path, or of this name where PROJ keeps its grids.

    Raises:
        VerticalDatumError: there is none; the message says how to get it.
    """
    if path.is_file():
        return path
    found = found_grid(path.name) if path == Path(path.name) else None
    if found is not None:
        return found
    folders = ", ".join(str(folder) for folder in grid_folders() if folder.is_dir())
    published = next((names[0] for names in GRIDS.values() if path.name in names), None)
    how = "correct --geoid" if published is None else f"run: pyproj sync --file {published}"
    if path.name in GRIDS["EGM96"]:
        how += ", or install the package proj-data of Debian, which has egm96_15.gtx"
    raise VerticalDatumError(
        f"{path}: expected the grid file of a geoid, found no such file here or, by its name alone, in "
        f"{folders}; {how}"
    )


def geoid_model(path: Path) -> str | None:
    """Which of the `NAMED` geoids a grid file contains; None for any other.

    By the names of published files, else by the heights of the poles, which differ by 0.6 m or more.
    """
    for name in NAMED:
        if re.search(rf"egm_?({name[3:]}|{name[-2:]})(?!\d|.*rednap)", path.name, re.IGNORECASE):
            return name
    poles_m = geoid_of_grid(path)(np.array([[0.0, 90.0], [0.0, -90.0]]))
    for name, expected_m in _POLES_M.items():
        if np.abs(poles_m - expected_m).max() < _SAME_POLES_M:
            return name
    return None


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


@dataclass(frozen=True)
class _TransformedGeoid:
    """A geoid that PROJ transforms; other processes can have it too."""

    transformer: Transformer

    def __call__(self, lon_lat: Array) -> Array:
        zero = np.zeros(len(lon_lat))
        above = np.asarray(self.transformer.transform(lon_lat[:, 0], lon_lat[:, 1], zero)[2])
        return np.where(np.isfinite(above), above, np.nan)
