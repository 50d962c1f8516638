"""Ground points marked in images, and their conversion to WGS 84.

| format | first pixel | ground | heights |
|---|---|---|---|
| Amers GeoJSON | its centre is (0, 0) | lon, lat | WGS 84 ellipsoid (RFC 7946) |
| Orthority GeoJSON, `ji` | its centre is (0, 0) | lon, lat | WGS 84 ellipsoid |
| ASP `.gcp` | its centre is (0, 0) | lat, lon | above a datum that the caller states |
| OPF 1.0 | its corner is (0, 0) | axes of its CRS | of its CRS, else the ellipsoid |
| QGIS `.points` | its corner is (0, 0), lines negative | its `#CRS` | none |
| ENVI `.pts` | its corner is (1, 1) | `projection info` | above a datum that the caller states |
| ODM `gcp_list.txt` | its centre is (0, 0) | its first line | of its CRS, else the caller states them |
| PCI text | its corner is (0, 0) | a first line of ours | its first line, else the caller states them |
| CSV | its first line states it | lon, lat, or x, y in a CRS of the caller | the caller states them |
| USGS GCPLib | no positions in images | lat, lon | the caller states them |
| Copernicus Sentinel-2 GCP database | no positions in images | lon, lat | the caller states them |

Only the readers and writers of these formats convert: everywhere else the centre of the first pixel is
(0, 0) and heights are above the WGS 84 ellipsoid.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from amers.services.datums import DatumShift, datum_shift, from_wgs84, horizontal, missing_grids
from amers.services.errors import FormatError, MissingGeoid, VerticalDatumError
from amers.services.formats.elevation.geoid import vertical_crs
from amers.services.formats.elevation.heights import HeightDatum, HeightsByCaller, height_datum
from amers.services.statements import Statement, Statements, Subject, Use
from amers.services.types import Array, BoolArray, StrArray

WGS84_3D = CRS.from_epsg(4979)
ELLIPSOID = "ellipsoid"
"""The `heights` of a caller whose heights are above the ellipsoid of their reference system."""
Heights = str | Path
"""Datum of heights: "ellipsoid", a vertical reference system such as "EGM96" or "EPSG:5773", or the path
of the grid of a geoid."""
NAMES_FILES = re.compile(r"\b(init|\w*grids|catalog)\s*=|proj\s*=\s*pipeline", re.IGNORECASE)
"""Parts of a PROJ string that make PROJ read other files."""


@dataclass(frozen=True)
class MarkedPoints:
    """Ground points and their positions in images, one row for each mark.

    Attributes:
        id: (n,) str, id of the point; a point marked in several images has one row for each of them, a
            point without a mark has one row.
        lon_lat_h: (n, 3); the height is NaN where the file has none.
        sigma_m: (n, 3) east, north, up, one standard deviation; NaN where unknown.
        image: (n,) str, name of the image; "" where the file has none.
        line_sample: (n, 2) pixels; NaN where the point is not marked.
        sigma_px: (n,) one standard deviation of each coordinate; NaN where unknown.
        residual_px: (n, 2) observed minus computed, line and sample; NaN where unknown.
        active: (n,) whether the mark is to be used.
        check: (n,) whether the point is a check point, held out of the adjustment.
        statements: of the file.
        datum_sigma_m: accuracy of the transformation of the datum, one standard deviation of a
            horizontal coordinate. It is in `sigma_m` where that is known.
    """

    id: StrArray
    lon_lat_h: Array
    sigma_m: Array
    image: StrArray
    line_sample: Array
    sigma_px: Array
    residual_px: Array
    active: BoolArray
    check: BoolArray
    statements: Statements = ()
    datum_sigma_m: float = 0.0

    def __len__(self) -> int:
        return len(self.id)

    @property
    def is_marked(self) -> BoolArray:
        """Which rows (n,) have a position in an image."""
        return np.asarray(np.isfinite(self.line_sample).all(axis=1))

    def take(self, rows: BoolArray) -> "MarkedPoints":
        """The marks where a mask (n,) is true."""
        columns: dict[str, Any] = {
            name: values[rows] for name, values in vars(self).items() if isinstance(values, np.ndarray)
        }
        return replace(self, **columns)


@dataclass(frozen=True)
class Ground:
    """Ground points of a file in WGS 84.

    Attributes:
        lon_lat_h: (n, 3); the height is NaN where the file has none.
        sigma_m: of their positions by the transformation of the datum, one standard deviation of each
            horizontal coordinate; 0 where there is none.
        statements: on datums and units.
    """

    lon_lat_h: Array
    sigma_m: float
    statements: Statements

    def __len__(self) -> int:
        return len(self.lon_lat_h)


def joined_marks(parts: Sequence[MarkedPoints]) -> MarkedPoints:
    """The marks of several files, one after the other; what the files state is left out."""
    columns: dict[str, Any] = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(MarkedPoints)
        if field.name not in ("statements", "datum_sigma_m")
    }
    return MarkedPoints(**columns)


def marked_points(
    id: list[str],
    lon_lat_h: Ground | list[tuple[float, float, float]] | Array,
    line_sample: list[tuple[float, float]] | Array,
    statements: Statements = (),
    **attributes: Any,
) -> MarkedPoints:
    """Marked points with default attributes: unknown sigmas and residuals, active, no check points.

    Args:
        id, lon_lat_h, line_sample: n rows; the sigma and the statements of a `Ground` are added,
            but none on a subject that the reader found itself.
        statements: of the file.
        attributes: other attributes of `MarkedPoints`, n rows, that replace the defaults.
    """
    n = len(id)
    columns: dict[str, Any] = {
        "sigma_m": np.full((n, 3), np.nan),
        "image": np.full(n, "", dtype=np.str_),
        "sigma_px": np.full(n, np.nan),
        "residual_px": np.full((n, 2), np.nan),
        "active": np.ones(n, dtype=bool),
        "check": np.zeros(n, dtype=bool),
    }
    for name, values in attributes.items():
        default = columns[name]
        dtype = {"U": np.str_, "b": np.bool_}.get(default.dtype.kind, np.float64)
        columns[name] = np.array(values, dtype=dtype).reshape(default.shape)
    datum_sigma_m = 0.0
    if isinstance(lon_lat_h, Ground):
        horizontal_m = columns["sigma_m"][:, :2]
        horizontal_m[:] = np.copysign(np.hypot(horizontal_m, lon_lat_h.sigma_m), horizontal_m)
        datum_sigma_m = lon_lat_h.sigma_m
        known = {one.subject for one in statements if one.use is not Use.NOT_USED}
        of_ground = [
            one for one in lon_lat_h.statements if one.use is not Use.USED or one.subject not in known
        ]
        statements = (*statements, *of_ground)
        lon_lat_h = lon_lat_h.lon_lat_h
    return MarkedPoints(
        id=np.array(id, dtype=np.str_),
        lon_lat_h=np.array(lon_lat_h, dtype=np.float64).reshape(n, 3),
        line_sample=np.array(line_sample, dtype=np.float64).reshape(n, 2),
        **columns,
        statements=statements,
        datum_sigma_m=datum_sigma_m,
    )


def to_wgs84(
    coordinates: Array, crs: CRS, heights: Heights | None, source: str, axes_of_crs: bool = False
) -> Ground:
    """Points in any CRS as longitude, latitude and height above the WGS 84 ellipsoid.

    Args:
        coordinates: (n, 3) east or longitude first, unless `axes_of_crs`; heights are metres where `crs`
            has none, and NaN where a point has none.
        crs: reference system of the coordinates.
        heights: datum of the heights where `crs` has none; not needed where no point has a height.
        source: name of the file, for messages.
        axes_of_crs: the coordinates are in the order of the axes of `crs`.

    Raises:
        VerticalDatumError: the datum of the heights is unknown, or the grid it needs is not installed.
        FormatError: the points cannot be transformed to WGS 84.
    """
    height = coordinates[:, 2]
    flat = np.column_stack([coordinates[:, :2], np.nan_to_num(height, nan=0.0)])
    in_space = len(crs.axis_info) >= 3 and not crs.is_compound
    if in_space and heights not in (None, ELLIPSOID):
        raise VerticalDatumError(
            f"{source}: {crs.name} has heights above its ellipsoid, the caller states {heights}; omit "
            "the datum of the heights, or give a reference system without heights"
        )
    if in_space and not crs.is_geographic and not crs.is_projected:
        ground = _transformed(flat, crs, source, axes_of_crs)
        return Ground(ground, 0.0, _of_three_axes(crs, source))
    own = horizontal(crs.to_wkt())
    ground = _transformed(flat * [1.0, 1.0, 0.0], own, source, axes_of_crs)
    middle = np.median(ground[:, :2], axis=0) if len(ground) else np.zeros(2)
    shift = datum_shift(crs.to_wkt(), np.array(from_wgs84(crs.to_wkt()).transform(*middle)), source)
    of_datum = (shift.statement(source),)
    if in_space:
        ground = _without(_transformed(flat, crs, source, axes_of_crs), np.isnan(height))
        return Ground(ground, shift.sigma_m, of_datum + _of_three_axes(crs, source)[1:])
    if np.isnan(height).all():
        return Ground(_without(ground, np.isnan(height)), shift.sigma_m, of_datum)
    datum = _height_datum(crs, shift, middle, heights, source)
    zero_m = 0.0 if datum.zero_m is None else datum.zero_m(ground[:, :2])
    ground[:, 2] = zero_m + datum.unit_m * height
    unknown = np.isnan(zero_m) & np.isfinite(height)
    if unknown.any():
        lon, lat = ground[unknown][0, :2]
        raise VerticalDatumError(
            f"{source}: the geoid of {heights or crs.name} is unknown at {int(unknown.sum())} of "
            f"{len(ground)} points, such as longitude {lon:.4f}, latitude {lat:.4f}; take the datum of "
            "that region"
        )
    return Ground(ground, shift.sigma_m, of_datum + datum.statements)


def _height_datum(
    crs: CRS, shift: DatumShift, middle: Array, heights: Heights | None, source: str
) -> HeightDatum:
    """Unit and datum of heights that a reference system or the caller states; else they are metres."""
    if heights is None and not crs.is_compound:
        raise no_datum(source)
    vertical, grid = (None, heights) if isinstance(heights, Path) else (heights, None)
    caller = HeightsByCaller(vertical, grid)
    try:
        if caller.vertical is not None and not crs.is_compound:
            _check_metres(caller.vertical)
        datum = height_datum(crs, shift, middle, caller, source)
    except MissingGeoid as error:
        raise MissingGeoid(f"{source}: {error} (--geoid, or --control-geoid for control)") from None
    except VerticalDatumError as error:
        text = str(error)
        raise VerticalDatumError(text if text.startswith(source) else f"{source}: {text}") from None
    if crs.is_compound:
        return datum
    of_datum = [one for one in datum.statements if one.subject is not Subject.UNIT]
    return replace(datum, statements=tuple(of_datum))


def _check_metres(heights: str) -> None:
    vertical = vertical_crs(heights)
    if vertical is not None and vertical.axis_info[0].unit_conversion_factor != 1.0:
        raise VerticalDatumError(
            f"heights of this file are metres, those of {vertical.name} are "
            f"{vertical.axis_info[0].unit_name}: state the datum in metres"
        )


def _of_three_axes(crs: CRS, source: str) -> Statements:
    """What a reference system with three axes states; its transformation is that of space."""
    where = "reference system"
    horizontal_datum = Statement(source, Subject.HORIZONTAL_DATUM, Use.USED, crs.name, where)
    vertical = replace(horizontal_datum, subject=Subject.VERTICAL_DATUM, value="its own ellipsoid")
    unit = replace(horizontal_datum, subject=Subject.UNIT, value=crs.axis_info[2].unit_name)
    return horizontal_datum, vertical, unit


def _without(ground: Array, missing: BoolArray) -> Array:
    return np.column_stack([ground[:, :2], np.where(missing, np.nan, ground[:, 2])])


def no_datum(source: str) -> VerticalDatumError:
    """The error of a file whose heights have no datum, with the options that state it."""
    return VerticalDatumError(
        f"{source}: the file does not state the datum of its heights; state it (--vertical): "
        f"{ELLIPSOID!r} or a vertical reference system such as 'EGM96' or 'EPSG:3855' (EGM2008), or "
        "the grid file of a geoid (--geoid)"
    )


def horizontal_unit_m(crs: CRS) -> float:
    """Length of the unit of a projected CRS; 1 for a geographic one, whose heights are metres."""
    return float(crs.axis_info[0].unit_conversion_factor) if crs.is_projected else 1.0


def _transformed(coordinates: Array, crs: CRS, source: str, axes_of_crs: bool) -> Array:
    """Points (n, 3) in WGS 84, by a transformation of PROJ that is never approximate."""
    try:
        transformer = Transformer.from_crs(
            crs, WGS84_3D, always_xy=not axes_of_crs, allow_ballpark=False
        )
        x, y, z = transformer.transform(
            coordinates[:, 0], coordinates[:, 1], coordinates[:, 2], errcheck=True
        )
    except ProjError as error:
        kind = VerticalDatumError if crs.is_compound else FormatError
        raise kind(
            f"{source}: points in {crs.name} cannot be transformed to WGS 84"
            f"{missing_grids(crs) or f': {error}'}"
        ) from None
    return np.column_stack([y, x, z] if axes_of_crs else [x, y, z])


def parse_crs(definition: str, source: str) -> CRS:
    """The reference system of a definition: a code, WKT or a PROJ string that names no other files.

    Raises:
        FormatError: PROJ does not understand the definition, or it names files.
    """
    try:
        if NAMES_FILES.search(definition):
            raise CRSError("definitions of files are not read")
        return CRS.from_user_input(definition)
    except CRSError:
        raise FormatError(
            f"{source}: expected a reference system, such as EPSG:32633, found {definition[:60]!r}"
        ) from None


def check_heights(heights: str) -> None:
    """Refuse what is neither "ellipsoid" nor a vertical reference system.

    Raises:
        VerticalDatumError: the heights cannot be used.
    """
    vertical_crs(heights)
