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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from amers.services.datums import missing_grids
from amers.services.errors import FormatError, MissingGeoid, VerticalDatumError
from amers.services.formats.elevation.geoid import (
    geoid_of_crs,
    geoid_of_grid,
    vertical_crs,
)
from amers.services.statements import Statements
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

    def __len__(self) -> int:
        return len(self.id)

    @property
    def is_marked(self) -> BoolArray:
        """Which rows (n,) have a position in an image."""
        return np.asarray(np.isfinite(self.line_sample).all(axis=1))

    def take(self, rows: BoolArray) -> "MarkedPoints":
        """The marks where a mask (n,) is true."""
        columns = {name: values[rows] for name, values in vars(self).items() if name != "statements"}
        return MarkedPoints(**columns, statements=self.statements)


def marked_points(
    id: list[str],
    lon_lat_h: list[tuple[float, float, float]] | Array,
    line_sample: list[tuple[float, float]] | Array,
    statements: Statements = (),
    **attributes: Any,
) -> MarkedPoints:
    """Marked points with default attributes: unknown sigmas and residuals, active, no check points.

    Args:
        id, lon_lat_h, line_sample: n rows.
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
    return MarkedPoints(
        id=np.array(id, dtype=np.str_),
        lon_lat_h=np.array(lon_lat_h, dtype=np.float64).reshape(n, 3),
        line_sample=np.array(line_sample, dtype=np.float64).reshape(n, 2),
        **columns,
        statements=statements,
    )


def to_wgs84(
    coordinates: Array, crs: CRS, heights: Heights | None, source: str, axes_of_crs: bool = False
) -> Array:
    """Longitude, latitude and height above the WGS 84 ellipsoid (n, 3) of points in any CRS.

    Args:
        coordinates: (n, 3) east or longitude first, unless `axes_of_crs`; heights are metres where `crs`
            has none.
        crs: reference system of the coordinates.
        heights: datum of the heights where `crs` has none.
        source: name of the file, for messages.
        axes_of_crs: the coordinates are in the order of the axes of `crs`.

    Raises:
        VerticalDatumError: the datum of the heights is unknown, or the grid it needs is not installed.
        FormatError: the points cannot be transformed to WGS 84.
    """
    if len(crs.axis_info) >= 3:
        return _transformed(coordinates, crs, source, axes_of_crs)
    if heights is None:
        raise VerticalDatumError(
            f"{source}: the file does not state the datum of its heights; state it (--vertical): "
            f"{ELLIPSOID!r} or a vertical reference system such as 'EGM96' or 'EPSG:3855' (EGM2008), or "
            "the grid file of a geoid (--geoid)"
        )
    try:
        vertical = None if isinstance(heights, Path) else vertical_crs(heights)
        if isinstance(heights, str) and vertical is None:
            return _transformed(coordinates, crs.to_3d(), source, axes_of_crs)
        if vertical is not None and vertical.axis_info[0].unit_conversion_factor != 1.0:
            raise VerticalDatumError(
                f"heights of this file are metres, those of {vertical.name} are "
                f"{vertical.axis_info[0].unit_name}: state the datum in metres"
            )
        ground = _transformed(coordinates * [1.0, 1.0, 0.0], crs, source, axes_of_crs)
        geoid = geoid_of_grid(Path(heights)) if vertical is None else geoid_of_crs(vertical)
    except MissingGeoid as error:
        raise MissingGeoid(f"{source}: {error} (--geoid, or --control-geoid for control)") from None
    except VerticalDatumError as error:
        raise VerticalDatumError(f"{source}: {error}") from None
    zero_m = geoid(ground[:, :2])
    unknown = np.isnan(zero_m)
    if unknown.any():
        lon, lat = ground[unknown][0, :2]
        raise VerticalDatumError(
            f"{source}: the geoid of {heights} is unknown at {int(unknown.sum())} of {len(ground)} "
            f"points, such as longitude {lon:.4f}, latitude {lat:.4f}; take the datum of that region"
        )
    return np.column_stack([ground[:, :2], zero_m + coordinates[:, 2]])


def horizontal_unit_m(crs: CRS) -> float:
    """Length of the unit of a projected CRS; 1 for a geographic one, whose heights are metres."""
    return float(crs.axis_info[0].unit_conversion_factor) if crs.is_projected else 1.0


def _transformed(coordinates: Array, crs: CRS, source: str, axes_of_crs: bool) -> Array:
    """Points (n, 3) in WGS 84, by a transformation of PROJ that is never approximate."""
    try:
        transformer = Transformer.from_crs(
            crs, WGS84_3D, always_xy=not axes_of_crs, allow_ballpark=False, only_best=True
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
