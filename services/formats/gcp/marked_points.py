"""Ground points marked in images: what travels between the formats of the field, and datums.

| format | first pixel | ground | heights |
|---|---|---|---|
| Amers GeoJSON | its centre is (0, 0) | lon, lat | WGS 84 ellipsoid (RFC 7946) |
| Orthority GeoJSON, `ji` | its centre is (0, 0) | lon, lat | WGS 84 ellipsoid |
| ASP `.gcp` | its centre is (0, 0) | lat, lon | above a datum the caller says |
| OPF 1.0 | its corner is (0, 0) | axes of its CRS | of its CRS, else the ellipsoid |
| QGIS `.points` | its corner is (0, 0), lines negative | its `#CRS` | none |
| ENVI `.pts` | its corner is (1, 1) | `projection info` | above a datum the caller says |
| ODM `gcp_list.txt` | its centre is (0, 0) | its first line | of its system, else the caller says |
| PCI text | its corner is (0, 0) | its first line, ours | its first line, else the caller says |

The readers and writers of these formats convert, and nothing else does: inside, the centre of the first
pixel is (0, 0) and heights are above the WGS 84 ellipsoid.
"""

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS
from pyproj.exceptions import CRSError, ProjError

from services.errors import FormatError, VerticalDatumError
from services.types import Array, BoolArray

WGS84_3D = CRS.from_epsg(4979)
ELLIPSOID = "ellipsoid"
"""What a caller says of heights that are above the ellipsoid of their reference system."""

StrArray = npt.NDArray[np.str_]


@dataclass(frozen=True)
class MarkedPoints:
    """n ground points and where images show them, one row a mark.

    Attributes:
        id: (n,) str; a point seen in several images has as many rows.
        lon_lat_h: (n, 3); the height is NaN where the file holds none.
        sigma_m: (n, 3) of east, north, up, one standard deviation; NaN where unknown.
        image: (n,) str, name of the image; "" where the file does not say.
        line_sample: (n, 2) pixels.
        sigma_px: (n,) one standard deviation a coordinate; NaN where unknown.
        residual_px: (n, 2) observed minus computed, line and sample; NaN where unknown.
        active: (n,) to be used.
        check: (n,) held out of the adjustment.
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
        """The points of a mask (n,)."""
        return MarkedPoints(**{name: values[rows] for name, values in vars(self).items()})


def marked_points(
    id: list[str],
    lon_lat_h: list[tuple[float, float, float]] | Array,
    line_sample: list[tuple[float, float]] | Array,
    **known: Any,
) -> MarkedPoints:
    """Marked points with what a file does not say filled in: unknown sigmas, active, no check points.

    Args:
        id, lon_lat_h, line_sample: n rows.
        known: any other attribute of `MarkedPoints`, n rows.
    """
    n = len(id)
    rest: dict[str, Any] = {
        "sigma_m": np.full((n, 3), np.nan),
        "image": np.full(n, "", dtype=np.str_),
        "sigma_px": np.full(n, np.nan),
        "residual_px": np.full((n, 2), np.nan),
        "active": np.ones(n, dtype=bool),
        "check": np.zeros(n, dtype=bool),
    }
    shapes = {name: value.shape for name, value in rest.items()}
    kinds = {name: value.dtype.kind for name, value in rest.items()}
    for name, values in known.items():
        dtype = {"U": np.str_, "b": np.bool_}.get(kinds[name], np.float64)
        rest[name] = np.array(values, dtype=dtype).reshape(shapes[name])
    return MarkedPoints(
        id=np.array(id, dtype=np.str_),
        lon_lat_h=np.array(lon_lat_h, dtype=np.float64).reshape(n, 3),
        line_sample=np.array(line_sample, dtype=np.float64).reshape(n, 2),
        **rest,
    )


def ground_from(
    coordinates: Array, crs: CRS, heights: str | None, source: str, axes_of_crs: bool = False
) -> Array:
    """Points of any reference system as longitude, latitude and height above the WGS 84 ellipsoid.

    Args:
        coordinates: (n, 3) east or longitude first, unless `axes_of_crs`.
        crs: of the coordinates.
        heights: of a system without any: "ellipsoid" or a vertical reference system.
        source: name of the file, for the messages.
        axes_of_crs: the coordinates are in the order of the axes of their system.

    Raises:
        VerticalDatumError: when the datum of the heights is unknown, or the grid it needs is missing.
        FormatError: when the points cannot be brought into WGS 84.
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
            f"{source}: points of {crs.name} cannot be brought to heights above the WGS 84 ellipsoid: "
            f"{error}"
        ) from None
    return np.column_stack([y, x, z] if axes_of_crs else [x, y, z])


def crs_from(definition: str, source: str) -> CRS:
    """The reference system of a definition.

    Raises:
        FormatError: when it is none.
    """
    try:
        return CRS.from_user_input(definition)
    except CRSError:
        raise FormatError(f"{source}: expected a reference system, found {definition[:60]!r}") from None


def _with_heights(crs: CRS, heights: str | None, source: str) -> CRS:
    if heights is None:
        raise VerticalDatumError(
            f"{source}: the file does not say what its heights are above; say it: {ELLIPSOID!r}, or a "
            "vertical reference system such as 'EPSG:5773' (EGM96) or 'EPSG:3855' (EGM2008)"
        )
    if heights == ELLIPSOID:
        return crs.to_3d()
    vertical = crs_from(heights, source)
    if not vertical.is_vertical:
        raise VerticalDatumError(f"{source}: {heights} is not a vertical reference system")
    return CompoundCRS(f"{crs.name} + {vertical.name}", [crs, vertical])


def load_json(text: str, source: str) -> Any:
    """A JSON document.

    Raises:
        FormatError: when it is none.
    """
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{source}: not a JSON document: {error}") from None
