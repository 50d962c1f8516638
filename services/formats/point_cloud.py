"""Writing point clouds: LAS 1.4 and its compressed form LAZ, block by block.

Source: ASPRS (2019), LAS Specification 1.4 R15; point format 6, the reference system as WKT.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from amers.services.errors import FormatError, InputError
from amers.services.formats.images.surfaces import heights_crs
from amers.services.map_grid import MapGrid
from amers.services.surface.match import Reasons
from amers.services.types import Array, FloatImage

STEP_M = 0.001
"""Coordinates are whole millimetres: a hundredth of the noise of the best surfaces."""
_ORTHOMETRIC, _ELLIPSOIDAL = ",2005", ",2002"
"""Types of vertical datums in WKT 1 (OGC 01-009, 12.3.11), of which libraries write the first."""


@dataclass(frozen=True)
class CloudPoints:
    """Points of a surface.

    Attributes:
        xy_h: (n, 3) map coordinates and height above the ellipsoid.
        sigma_m: (n,) float32, one standard deviation of the height.
        views: (n,) uint8, number of images that show it, 0 where it was filled.
    """

    xy_h: Array
    sigma_m: FloatImage
    views: Reasons

    def __len__(self) -> int:
        return len(self.sigma_m)


def write_point_cloud(path: Path, grid: MapGrid, blocks: Iterable[CloudPoints]) -> int:
    """Write points as LAZ, or as LAS where the name ends so; returns their number.

    Beside the coordinates, points have the dimensions `sigma_m` and `views`.

    Args:
        path: the file; an existing one is replaced when the new one is complete.
        grid: of the surface: its reference system, and an origin near the points.
        blocks: of points.

    Raises:
        InputError: the name ends otherwise, or the library for point clouds is missing.
        FormatError: the file cannot be written.
    """
    if path.suffix.lower() not in (".laz", ".las"):
        raise InputError(f"{path}: a name that ends with .laz or .las expected")
    try:
        import laspy
    except ImportError:
        raise InputError(
            f"{path}: the library for point clouds is not installed; install amers[clouds]"
        ) from None
    header = _header(laspy, grid)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial, count = path.with_name(f".{path.name}.partial"), 0
    try:
        with laspy.open(partial, "w", header=header, do_compress=path.suffix.lower() == ".laz") as file:
            for block in blocks:
                record = laspy.ScaleAwarePointRecord.zeros(len(block), header=header)
                record.x, record.y, record.z = block.xy_h.T
                record["sigma_m"], record["views"] = block.sigma_m, block.views
                record["return_number"] = record["number_of_returns"] = np.ones(len(block), np.uint8)
                file.write_points(record)
                count += len(block)
        partial.replace(path)
    except OSError as error:
        raise FormatError(f"{path}: the file cannot be written: {error}") from error
    finally:
        with suppress(FileNotFoundError):
            partial.unlink()
    return count


def _header(laspy: Any, grid: MapGrid) -> Any:
    """The header of the file of a surface."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, STEP_M)
    header.offsets = np.append(np.floor(grid.origin_xy), 0.0)
    header.generating_software = "Amers"
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams("sigma_m", np.float32, "standard deviation, metres"),
            laspy.ExtraBytesParams("views", np.uint8, "images, 0 where filled"),
        ]
    )
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(cloud_crs(grid)))
    header.global_encoding.wkt = True
    return header


def cloud_crs(grid: MapGrid) -> str:
    """The reference system of a grid with heights above the ellipsoid, in WKT 1, which LAS asks for."""
    text: str = CRS.from_user_input(heights_crs(grid)).to_wkt("WKT1_GDAL")
    before, datum, after = text.rpartition("VERT_DATUM[")
    return before + datum + after.replace(_ORTHOMETRIC, _ELLIPSOIDAL, 1)
