"""Unit and vertical datum of heights in files, for terrains and for points.

"Above the ellipsoid" means what GNSS receivers give: above the ellipsoid of WGS 84. A caller, or a file
whose reference system has no heights, that states it in a national horizontal system does not mean the
ellipsoid of that system: a datum shift does not move such heights. Only a reference system with three
axes says that its heights are above its own ellipsoid, and these are moved.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import BoundCRS
from pyproj.exceptions import ProjError

from amers.services.datums import DatumShift
from amers.services.errors import VerticalDatumError
from amers.services.formats.elevation.geoid import (
    NAMED,
    find_grid,
    geoid_model,
    geoid_of_crs,
    geoid_of_grid,
    vertical_crs,
)
from amers.services.statements import Statement, Statements, Subject, Use
from amers.services.terrain import Geoid
from amers.services.types import Array

UNITS_M = {
    "m": 1.0,
    "dm": 0.1,
    "cm": 0.01,
    "mm": 0.001,
    "km": 1000.0,
    "ft": 0.3048,
    "us-ft": 1200.0 / 3937.0,
    "yd": 0.9144,
    "fathom": 1.8288,
}
"""Metres of the units of heights."""
_UNIT_NAMES = {
    "m": r"m|met(er|re)s?",
    "dm": r"dm|decimet(er|re)s?",
    "cm": r"cm|centimet(er|re)s?",
    "mm": r"mm|millimet(er|re)s?",
    "km": r"km|kilomet(er|re)s?",
    "ft": r"'|(international|intl|int)?(ft|feet|foot)(international|intl|int)?",
    "us-ft": r"(us|ussurvey|survey)(ft|feet|foot)|(ft|feet|foot)(us|ussurvey|survey)",
    "yd": r"yd|yards?",
    "fathom": r"fathoms?",
}
_NO_DATUM = re.compile(r"unknown|unnamed|undefined|not.specified|\s*$", re.IGNORECASE)
_ELLIPSOID_NAME = re.compile(r"ellipsoid|WGS[ _]?(19)?84", re.IGNORECASE)
_EGM = re.compile(r"EGM[ _-]?(?:20(?=08))?(84|96|08)", re.IGNORECASE)
_NO_SHIFT_M = 1e-3
ELLIPSOID = "the ellipsoid"


@dataclass(frozen=True)
class HeightsByCaller:
    """What a caller states about the heights of a file.

    Attributes:
        vertical: "ellipsoid", "EGM96", "EGM2008" or the code of a vertical reference system.
        geoid: grid file of the geoid.
        by_format: the vertical datum that the documents of the file's format give; it counts where
            neither file nor caller state one.
    """

    vertical: str | None = None
    geoid: Path | None = None
    by_format: str | None = None


@dataclass(frozen=True)
class HeightDatum:
    """How the heights of a file become metres above the ellipsoid of WGS 84.

    Attributes:
        unit_m: metres of their unit.
        zero_m: height of their zero above the ellipsoid of WGS 84; None for that ellipsoid.
        origin: of the datum, one sentence.
        statements: of unit and datum.
    """

    unit_m: float
    zero_m: Geoid | None
    origin: str
    statements: Statements


def unit_m(name: str, source: str, where: str) -> float:
    """Metres of a unit by its name in a file: m, metre, ft, US survey foot, cm …

    Raises:
        VerticalDatumError: it is no known unit of length.
    """
    bare = re.sub(r"[\s._()\[\]-]", "", name).lower()
    for unit, names in _UNIT_NAMES.items():
        if re.fullmatch(names, bare):
            return UNITS_M[unit]
    raise VerticalDatumError(
        f"{source}, {where}: unit: {name[:40]!r} found, one of {', '.join(UNITS_M)} expected; "
        "correct it, such as with gdal_edit.py -units m"
    )


def height_datum(
    crs: CRS,
    shift: DatumShift,
    place: Array,
    caller: HeightsByCaller,
    source: str,
    *,
    band_unit: str = "",
) -> HeightDatum:
    """Unit and datum of the heights of a file.

    Args:
        crs: whole reference system of the file.
        shift: the datum shift of its horizontal part.
        place: (2,) longitude and latitude of the middle of the file.
        caller: what the caller states.
        source: name of the file, for messages.
        band_unit: unit that the file states beside its reference system; it counts before that of the
            vertical reference system, which describes the file less closely.

    Raises:
        VerticalDatumError: the datum is not stated, file and caller contradict each other, the unit is
            unknown, or the grid of the geoid is missing.
    """
    stated = _of_file(crs)
    vertical, by = _vertical(stated, caller, source)
    name = "a geoid" if by == _BY_GRID else _name(vertical)
    found = Statement(source, Subject.VERTICAL_DATUM, Use.USED, name, by)
    others: Statements = ()
    zero_m: Geoid | None = None
    if caller.geoid is not None:
        if vertical is None and by != _BY_GRID:
            raise VerticalDatumError(
                f"{source}: heights are above the ellipsoid, by {_WHO[by]}, and need no geoid; omit "
                f"{caller.geoid.name}"
            )
        grid = find_grid(caller.geoid)
        others = _other_model(vertical, grid, found)
        zero_m = geoid_of_grid(grid)
        found = replace(found, note=f"from {grid.name}")
        origin = f"{name.replace('a geoid', 'the geoid')} by {_WHO[by]}, from {grid.name}"
    elif vertical is not None:
        zero_m = geoid_of_crs(vertical, place)
        origin = f"{vertical.name} by {_WHO[by]}, from the grids of PROJ"
    else:
        origin = f"metres above the ellipsoid, by {_WHO[by]}"
        if stated.is_stated and not crs.is_compound:
            zero_m = _own_ellipsoid(crs, place)
        found = _of_which_ellipsoid(found, shift, is_own=zero_m is not None)
    if by == _BY_FORMAT:
        found = replace(found, use=Use.ASSUMED, note="by the format; state --vertical otherwise")
    factor, units = _unit(crs, stated, vertical, source, band_unit)
    return HeightDatum(factor, zero_m, origin, (found, *others, *units))


def _of_which_ellipsoid(found: Statement, shift: DatumShift, *, is_own: bool) -> Statement:
    """Heights above "the" ellipsoid where that of the horizontal system is another one."""
    if is_own:
        return replace(found, note=f"that of {shift.system}: moved by its datum shift")
    if shift.is_null:
        return found
    note = (
        f"of WGS 84, as GNSS gives: the datum shift of {shift.system} does not move heights; for "
        "heights above its own ellipsoid state a reference system with three axes"
    )
    return replace(found, use=Use.ASSUMED, note=note)


@dataclass(frozen=True)
class _OfFile:
    """What a reference system states about heights."""

    vertical: CRS | None
    is_stated: bool
    unit: str = ""
    unit_m: float = 1.0


_BY_FILE, _BY_CALLER, _BY_GRID, _BY_FORMAT = (
    "reference system",
    "as the caller states",
    "as the caller states by a grid",
    "its format",
)
_WHO = {_BY_FILE: "the file", _BY_CALLER: "the caller", _BY_GRID: "the caller", _BY_FORMAT: "its format"}


def _of_file(crs: CRS) -> _OfFile:
    """The vertical reference system of a file, whether it states a datum, and its unit."""
    own = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs
    if not own.is_compound:
        if len(own.axis_info) < 3:
            return _OfFile(None, False)
        axis = own.axis_info[2]
        return _OfFile(None, True, axis.unit_name, float(axis.unit_conversion_factor))
    vertical = own.sub_crs_list[1]
    if isinstance(vertical, BoundCRS) or vertical.is_bound:
        vertical = vertical.source_crs or vertical
    axis = vertical.axis_info[0]
    unit, factor = axis.unit_name, float(axis.unit_conversion_factor)
    if _NO_DATUM.match(vertical.name):
        return _OfFile(None, False, unit, factor)
    if _ELLIPSOID_NAME.search(vertical.name):
        return _OfFile(None, True, unit, factor)
    return _OfFile(_usual(vertical), True, unit, factor)


def _usual(vertical: CRS) -> CRS:
    """The system of PROJ for a name such as "EGM96_Geoid", whatever its unit."""
    match = _EGM.search(vertical.name)
    if match is None or vertical.axis_info[0].direction.lower() != "up":
        return vertical
    names = {"84": "EGM84", "96": "EGM96", "08": "EGM2008"}
    return CRS.from_user_input(NAMED[names[match[1]]])


def _vertical(stated: _OfFile, caller: HeightsByCaller, source: str) -> tuple[CRS | None, str]:
    """The vertical reference system, None for the ellipsoid or an unnamed geoid, and who states it."""
    requested = None if caller.vertical is None else vertical_crs(caller.vertical)
    if stated.is_stated:
        if caller.vertical is not None and _name(stated.vertical) != _name(requested):
            raise VerticalDatumError(
                f"{source}: the file states heights above {_name(stated.vertical)}, the caller "
                f"{_name(requested)}; omit the vertical datum or correct it"
            )
        return stated.vertical, _BY_FILE
    if caller.vertical is not None:
        return requested, _BY_CALLER
    if caller.by_format is not None:
        return vertical_crs(caller.by_format), _BY_FORMAT
    if caller.geoid is not None:
        return None, _BY_GRID
    raise VerticalDatumError(
        f"{source}: the file does not state its vertical datum: give ellipsoid, EGM96, EGM2008 or the "
        "code of a vertical reference system (--vertical), or the grid file of a geoid (--geoid)"
    )


def _name(vertical: CRS | None) -> str:
    return ELLIPSOID if vertical is None else vertical.name


def _other_model(vertical: CRS | None, grid: Path, found: Statement) -> Statements:
    """What a grid of another geoid than the stated one means: refused, or the stated one named.

    Raises:
        VerticalDatumError: heights above one model of the Earth are given the grid of another.
    """
    model = geoid_model(grid)
    if vertical is None or model is None or CRS.from_user_input(NAMED[model]) == vertical:
        return ()
    if any(CRS.from_user_input(code) == vertical for code in NAMED.values()):
        raise VerticalDatumError(
            f"{found.file}: heights above {vertical.name}, by {_WHO[found.where]}, and the grid of "
            f"{model} in {grid.name}: the same geoid expected; give the grid of {vertical.name}, or "
            "omit --geoid"
        )
    return (replace(found, use=Use.NOT_USED, note=f"the grid {grid.name} is {model}, and is used"),)


def _own_ellipsoid(crs: CRS, place: Array) -> Geoid | None:
    """The ellipsoid of a reference system with three axes; None where it is that of WGS 84.

    Raises:
        VerticalDatumError: there is no usable transformation.
    """
    geographic = crs.geodetic_crs if crs.geodetic_crs is not None else crs
    if crs.is_bound:
        geographic = crs.to_3d()
    try:
        to_own = Transformer.from_crs(
            "EPSG:4979", geographic.to_3d(), always_xy=True, allow_ballpark=False
        )
    except ProjError:
        raise VerticalDatumError(f"heights of {crs.name} cannot be transformed to WGS 84") from None

    def zero_m(lon_lat: Array) -> Array:
        below = to_own.transform(lon_lat[:, 0], lon_lat[:, 1], np.zeros(len(lon_lat)))[2]
        return np.where(np.isfinite(below), -np.asarray(below), np.nan)

    return zero_m if abs(zero_m(np.asarray(place)[None, :2])[0]) > _NO_SHIFT_M else None


def _unit(
    crs: CRS, stated: _OfFile, vertical: CRS | None, source: str, band_unit: str
) -> tuple[float, Statements]:
    """Metres of the unit of heights, and who states it."""
    if vertical is not None and vertical.axis_info[0].direction.lower() != "up":
        raise VerticalDatumError(
            f"{source}: {vertical.name} found, which counts depths; heights expected"
        )
    of_system, factor = stated.unit, stated.unit_m
    if not of_system and vertical is not None:
        of_system, factor = vertical.axis_info[0].unit_name, vertical.axis_info[0].unit_conversion_factor
    system = Statement(source, Subject.UNIT, Use.USED, of_system, "vertical reference system")
    if band_unit.strip():
        band_m = unit_m(band_unit, source, "band 1")
        band = Statement(source, Subject.UNIT, Use.USED, band_unit, "band 1")
        if not of_system or band_m == factor or abs(band_m / factor - 1.0) < 1e-9:
            return band_m, (band,)
        note = f"the unit of the band, {band_unit}, is used; correct one of them"
        return band_m, (band, replace(system, use=Use.NOT_USED, note=note))
    if of_system:
        return float(factor), (system,)
    note = "state it otherwise with gdal_edit.py -units"
    horizontal_unit = crs.axis_info[0].unit_name
    is_in_metres = not crs.is_projected or crs.axis_info[0].unit_conversion_factor == 1.0
    if not is_in_metres:
        note = f"though positions are in {horizontal_unit}: " + note
    metre = Statement(source, Subject.UNIT, Use.ASSUMED, "metre", "heights", note)
    return 1.0, (replace(metre, is_usual=is_in_metres),)
