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

Only the readers and writers of these formats convert: everywhere else the centre of the first pixel is
(0, 0) and heights are above the WGS 84 ellipsoid.
"""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError, ProjError

from services.errors import FormatError, InputError, VerticalDatumError
from services.map_grid import crs_of_code
from services.types import Array, BoolArray

WGS84_3D = CRS.from_epsg(4979)
ELLIPSOID = "ellipsoid"
"""The `heights` of a caller whose heights are above the ellipsoid of their reference system."""
NAMES_FILES = re.compile(r"\b(init|\w*grids|catalog)\s*=|proj\s*=\s*pipeline", re.IGNORECASE)
"""Parts of a PROJ string that make PROJ read other files."""

StrArray = npt.NDArray[np.str_]


@dataclass(frozen=True)
class MarkedPoints:
    """n marks: ground points and their positions in images, one row for each mark.

    Attributes:
        id: (n,) str, id of the point; a point marked in several images has one row for each of them.
        lon_lat_h: (n, 3); the height is NaN where the file has none.
        sigma_m: (n, 3) east, north, up, one standard deviation; NaN where unknown.
        image: (n,) str, name of the image; "" where the file has none.
        line_sample: (n, 2) pixels.
        sigma_px: (n,) one standard deviation of each coordinate; NaN where unknown.
        residual_px: (n, 2) observed minus computed, line and sample; NaN where unknown.
        active: (n,) whether the mark is to be used.
        check: (n,) whether the point is a check point, held out of the adjustment.
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

    def __len__(self) -> int:
        return len(self.id)

    def take(self, rows: BoolArray) -> "MarkedPoints":
        """The marks where a mask (n,) is true."""
        return MarkedPoints(**{name: values[rows] for name, values in vars(self).items()})


def marked_points(
    id: list[str],
    lon_lat_h: list[tuple[float, float, float]] | Array,
    line_sample: list[tuple[float, float]] | Array,
    **attributes: Any,
) -> MarkedPoints:
    """Marked points with default attributes: unknown sigmas and residuals, active, no check points.

    Args:
        id, lon_lat_h, line_sample: n rows.
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
    )


def to_wgs84(
    coordinates: Array, crs: CRS, heights: str | None, source: str, axes_of_crs: bool = False
) -> Array:
    """Longitude, latitude and height above the WGS 84 ellipsoid (n, 3) of points in any CRS.

    Args:
        coordinates: (n, 3) east or longitude first, unless `axes_of_crs`.
        crs: reference system of the coordinates.
        heights: datum of the heights where `crs` has none: "ellipsoid" or a vertical reference system.
        source: name of the file, for messages.
        axes_of_crs: the coordinates are in the order of the axes of `crs`.

    Raises:
        VerticalDatumError: the datum of the heights is unknown, or the grid it needs is not installed.
        FormatError: the points cannot be transformed to WGS 84.
    """
    if len(crs.axis_info) < 3:
        crs = _with_heights(crs, heights, source)
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
            f"{source}: points in {crs.name} cannot be transformed to heights above the WGS 84 "
            f"ellipsoid: {error}"
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
    """Refuse what is neither "ellipsoid" nor the code of a vertical reference system.

    Raises:
        InputError: the heights cannot be used.
    """
    if heights != ELLIPSOID and not crs_of_code(heights).is_vertical:
        raise VerticalDatumError(
            f"heights: {heights} given, {ELLIPSOID!r} or a vertical reference system expected"
        )


def _with_heights(crs: CRS, heights: str | None, source: str) -> CRS:
    if heights is None:
        raise VerticalDatumError(
            f"{source}: the file does not state the datum of its heights; give heights: {ELLIPSOID!r} "
            "or a vertical reference system such as 'EPSG:5773' (EGM96) or 'EPSG:3855' (EGM2008)"
        )
    if heights == ELLIPSOID:
        return crs.to_3d()
    try:
        check_heights(heights)
    except InputError as error:
        raise VerticalDatumError(f"{source}: {error}") from None
    vertical = crs_of_code(heights)
    return CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical])
