"""Writing resampled images (on a map or straightened) and corrected map grids."""

import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.transform import Affine
from rasterio.windows import Window as RasterWindow

from amers.services.errors import FormatError
from amers.services.formats.images.datasets import GDAL_OPTIONS, as_format_error
from amers.services.formats.images.raster import (
    GDAL_FIRST_PIXEL,
    gdal_rpc,
    map_grid_of,
    open_raster,
)
from amers.services.map_grid import MapGrid
from amers.services.orthorectification.rectify import OrthoWindow
from amers.services.sensors.rpc import RpcModel
from amers.services.types import FloatImage


def write_refined_ortho(image_path: Path, grid: MapGrid, folder: Path, copy: bool = False) -> list[Path]:
    """Write the corrected map grid of an ortho-image.

    `NAME.aux.xml` contains the reference system and the geotransform. GDAL and QGIS prefer this file,
    beside the image, to the image's own. A copy contains them itself.

    Args:
        image_path: the delivered image, which stays unchanged.
        grid: the corrected grid, in the reference system of the image.
        folder: where to write; created when missing.
        copy: also write a copy of the image, which must be a GeoTIFF.

    Returns:
        The files written.

    Raises:
        FormatError: the image has no map grid, a copy is requested of another format, or a delivered
            file would be overwritten.
    """
    image = open_raster(image_path)
    try:
        if map_grid_of(image) is None:
            raise FormatError(
                f"{image_path}: expected an image with a map grid, found no reference system"
            )
        text = format_aux(grid)
        driver = image.dataset.driver
    finally:
        image.close()
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / image_path.name).resolve() == image_path.resolve():
        raise FormatError(
            f"{folder}: the delivered image or its map grid would be overwritten; "
            "give another output folder"
        )
    sidecar = folder / f"{image_path.name}.aux.xml"
    sidecar.write_text(text, encoding="utf-8")
    if not copy:
        return [sidecar]
    if driver != "GTiff":
        raise FormatError(
            f"{image_path}: {driver} found; only a GeoTIFF can be copied with another map grid"
        )
    target = folder / image_path.name
    shutil.copyfile(image_path, target)
    with (
        as_format_error(target, "a GeoTIFF with a writable map grid"),
        rasterio.Env(**GDAL_OPTIONS),
        rasterio.open(target.resolve(), "r+", driver="GTiff", IGNORE_COG_LAYOUT_BREAK="YES") as file,
    ):
        file.transform = gdal_transform(grid)
    return [sidecar, target]


@dataclass(frozen=True)
class BandForm:
    """The bands of a file.

    Attributes:
        bands: their number.
        dtype: type of the pixels: uint8, uint16, int16 or float32.
        nodata: value of pixels without data.
        saturated: value of saturated pixels; None takes the largest of the type.
        names, units: of the bands, all or none.
        overviews: how they are made: AVERAGE, or NEAREST for values of which there is no mean.
    """

    bands: int
    dtype: str
    nodata: float
    saturated: int | None = None
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    overviews: str = "AVERAGE"


@dataclass(frozen=True)
class SensorGrid:
    """The pixels of an image in the geometry of its sensor.

    Attributes:
        shape: lines and samples.
        model: of the image.
    """

    shape: tuple[int, int]
    model: RpcModel


def write_cog(
    path: Path, grid: MapGrid | SensorGrid, windows: Iterable[OrthoWindow], form: BandForm
) -> float:
    """Write an image as a cloud-optimised GeoTIFF with overviews, window by window.

    Integer pixels are rounded and clipped to the range of their type; a valid pixel never has the values
    `nodata` and `saturated`.

    Args:
        path: the file; an existing one is replaced when the new one is complete.
        grid: the map grid, or the geometry of a raw image, whose model becomes RPC tags.
        windows: all windows of the grid, in any order.
        form: of the bands.

    Returns:
        The largest `error_px` of the windows, in pixels.

    Raises:
        FormatError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    tiled, complete = (path.with_name(f".{path.name}.{end}") for end in ("tiled", "complete"))
    try:
        with as_format_error(path, "a writable file"), rasterio.Env(**GDAL_OPTIONS):
            error_px = _write_windows(tiled, windows, grid, form)
            predictor = "FLOATING_POINT" if form.dtype == "float32" else "STANDARD"
            rasterio.shutil.copy(
                tiled,
                complete,
                driver="COG",
                COMPRESS="DEFLATE",
                LEVEL=1,
                PREDICTOR=predictor,
                OVERVIEW_RESAMPLING=form.overviews,
                BIGTIFF="IF_SAFER",
            )
        complete.replace(path)
    finally:
        tiled.unlink(missing_ok=True)
        complete.unlink(missing_ok=True)
    return error_px


def _profile(grid: MapGrid | SensorGrid, form: BandForm) -> dict[str, Any]:
    """How a GeoTIFF in tiles is created."""
    place: dict[str, Any] = {}
    if isinstance(grid, MapGrid):
        place = {"crs": grid.crs, "transform": gdal_transform(grid)}
    return place | {
        "driver": "GTiff",
        "height": grid.shape[0],
        "width": grid.shape[1],
        "count": form.bands,
        "dtype": form.dtype,
        "nodata": form.nodata,
        "tiled": True,
        "blockxsize": 512,
        "blockysize": 512,
        "BIGTIFF": "IF_SAFER",
    }


def _write_windows(
    path: Path, windows: Iterable[OrthoWindow], grid: MapGrid | SensorGrid, form: BandForm
) -> float:
    """Write the windows into a new file; returns their largest error."""
    error_px = 0.0
    with rasterio.open(path, "w", **_profile(grid, form)) as file:
        if isinstance(grid, SensorGrid):
            file.rpcs = gdal_rpc(grid.model)
        for band, name in enumerate(form.names, start=1):
            file.set_band_description(band, name)
        for band, unit in enumerate(form.units, start=1):
            file.set_band_unit(band, unit)
        for ortho in windows:
            w = ortho.window
            target = RasterWindow(w.sample, w.line, w.samples, w.lines)
            pixels = _encoded(ortho.pixels, np.dtype(form.dtype), form.nodata, form.saturated)
            file.write(pixels, window=target)
            error_px = max(error_px, ortho.error_px)
    return error_px


def _encoded(
    pixels: FloatImage, dtype: np.dtype[Any], nodata: float, saturated: int | None
) -> np.ndarray:
    """Pixels in the type of the file, with `nodata` for NaN and `saturated` for +inf."""
    missing = np.isnan(pixels)
    if dtype.kind == "f":
        brightest = np.inf if saturated is None else float(saturated)
        return np.where(missing, nodata, np.where(np.isposinf(pixels), brightest, pixels)).astype(dtype)
    limits = np.iinfo(dtype)
    rounded = np.clip(np.rint(np.where(missing, 0.0, pixels)), limits.min, limits.max)
    if saturated is not None:
        rounded[rounded == saturated] = saturated - 1.0
        rounded[np.isposinf(pixels)] = saturated
    neighbour = nodata + 1.0 if nodata < limits.max else nodata - 1.0
    rounded[rounded == nodata] = neighbour
    return np.where(missing, nodata, rounded).astype(dtype)


def format_aux(grid: MapGrid) -> str:
    """The text of GDAL's `.aux.xml` for a map grid."""
    numbers = ", ".join(repr(float(number)) for number in gdal_transform(grid).to_gdal())
    crs = escape(rasterio.crs.CRS.from_user_input(grid.crs).to_wkt(version="WKT2_2019"))
    return (
        f'<PAMDataset>\n  <SRS dataAxisToSRSAxisMapping="{_axis_mapping(grid)}">{crs}</SRS>\n'
        f"  <GeoTransform>{numbers}</GeoTransform>\n</PAMDataset>\n"
    )


def gdal_transform(grid: MapGrid) -> Affine:
    """The geotransform of a map grid, whose origin is the corner of the first pixel."""
    corner = grid.origin_xy - grid.step_xy @ [GDAL_FIRST_PIXEL, GDAL_FIRST_PIXEL]
    (xl, xs), (yl, ys) = grid.step_xy
    return Affine(*(float(number) for number in (xs, xl, corner[0], ys, yl, corner[1])))


def _axis_mapping(grid: MapGrid) -> str:
    """The axes of the reference system, which may put latitude first, in the order x, y of the data."""
    return "2,1" if grid.first_axis_is_north else "1,2"
