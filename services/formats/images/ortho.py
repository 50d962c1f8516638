"""Ortho-images written: rectified scenes, and delivered ones with a corrected place on the map."""

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import rasterio
import rasterio.shutil
from rasterio.transform import Affine
from rasterio.windows import Window as RasterWindow

from services.errors import FormatError
from services.formats.images.raster import (
    GDAL_FIRST_PIXEL,
    OPTIONS,
    as_format_error,
    map_grid_of,
    open_raster,
)
from services.map_grid import MapGrid
from services.orthorectification.rectify import OrthoWindow
from services.types import FloatImage


def write_refined_ortho(image_path: Path, grid: MapGrid, folder: Path, copy: bool = False) -> list[Path]:
    """Write the corrected place of an ortho-image.

    `NAME.aux.xml` holds reference system and geotransform; laid beside the image it is believed before
    what the image says itself (GDAL, QGIS). A copy holds them itself.

    Args:
        image_path: the image as delivered; never written to.
        grid: as corrected, in the reference system of the image.
        folder: where to write; made when missing.
        copy: write a copy of the image too; of a GeoTIFF.

    Returns:
        The files written.

    Raises:
        FormatError: when the image lies on no map, a copy is asked for of another format, or a delivered
            file would be written over.
    """
    image = open_raster(image_path)
    try:
        if map_grid_of(image) is None:
            raise FormatError(f"{image_path}: expected an image on a map")
        text = format_aux(grid)
        driver = image.dataset.driver
    finally:
        image.close()
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / image_path.name).resolve() == image_path.resolve():
        raise FormatError(f"{folder}: the delivered image would be written over, or told another place")
    sidecar = folder / f"{image_path.name}.aux.xml"
    sidecar.write_text(text, encoding="utf-8")
    if not copy:
        return [sidecar]
    if driver != "GTiff":
        raise FormatError(f"{image_path}: only a GeoTIFF is copied with another place, this is {driver}")
    target = folder / image_path.name
    shutil.copyfile(image_path, target)
    with (
        as_format_error(target, "a GeoTIFF whose place can be written"),
        rasterio.Env(**OPTIONS),
        rasterio.open(target.resolve(), "r+", driver="GTiff", IGNORE_COG_LAYOUT_BREAK="YES") as file,
    ):
        file.transform = gdal_transform(grid)
    return [sidecar, target]


def write_cog(
    path: Path,
    grid: MapGrid,
    windows: Iterable[OrthoWindow],
    bands: int,
    dtype: str,
    nodata: float,
) -> float:
    """Write an ortho-image as a cloud-optimised GeoTIFF with overviews, window by window.

    Whole numbers are rounded, held to the range of their type and kept off `nodata`.

    Args:
        path: a file of that name is replaced, once the new one is whole.
        grid: the map.
        windows: all of them, in any order.
        bands: how many.
        dtype: of the pixels: uint8, uint16, int16 or float32.
        nodata: where the scene shows nothing.

    Returns:
        The largest `error_px` of the windows.

    Raises:
        FormatError: when the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    plain, whole = (path.with_name(f".{path.name}.{end}") for end in ("plain", "whole"))
    error_px = 0.0
    profile = {
        "driver": "GTiff",
        "height": grid.shape[0],
        "width": grid.shape[1],
        "count": bands,
        "dtype": dtype,
        "crs": grid.crs,
        "transform": gdal_transform(grid),
        "nodata": nodata,
    }
    tiles = {"tiled": True, "blockxsize": 512, "blockysize": 512, "BIGTIFF": "IF_SAFER"}
    try:
        with as_format_error(path, "a place to write to"), rasterio.Env(**OPTIONS):
            with rasterio.open(plain, "w", **profile, **tiles) as file:
                for done in windows:
                    at = done.window
                    place = RasterWindow(at.sample, at.line, at.samples, at.lines)
                    file.write(_stored(done.pixels, np.dtype(dtype), nodata), window=place)
                    error_px = max(error_px, done.error_px)
            predictor = "FLOATING_POINT" if dtype == "float32" else "STANDARD"
            rasterio.shutil.copy(
                plain,
                whole,
                driver="COG",
                COMPRESS="DEFLATE",
                LEVEL=1,
                PREDICTOR=predictor,
                OVERVIEW_RESAMPLING="AVERAGE",
                BIGTIFF="IF_SAFER",
            )
        whole.replace(path)
    finally:
        plain.unlink(missing_ok=True)
        whole.unlink(missing_ok=True)
    return error_px


def _stored(pixels: FloatImage, dtype: np.dtype[Any], nodata: float) -> np.ndarray:
    """Pixels as the file holds them."""
    missing = np.isnan(pixels)
    if dtype.kind == "f":
        return np.where(missing, nodata, pixels).astype(dtype)
    limits = np.iinfo(dtype)
    rounded = np.clip(np.rint(np.where(missing, 0.0, pixels)), limits.min, limits.max)
    beside = nodata + 1.0 if nodata < limits.max else nodata - 1.0
    rounded[rounded == nodata] = beside
    return np.where(missing, nodata, rounded).astype(dtype)


def format_aux(grid: MapGrid) -> str:
    """A map grid as GDAL's `.aux.xml`."""
    numbers = ", ".join(repr(float(number)) for number in gdal_transform(grid).to_gdal())
    crs = escape(rasterio.crs.CRS.from_user_input(grid.crs).to_wkt(version="WKT2_2019"))
    return (
        f'<PAMDataset>\n  <SRS dataAxisToSRSAxisMapping="{_axes(grid)}">{crs}</SRS>\n'
        f"  <GeoTransform>{numbers}</GeoTransform>\n</PAMDataset>\n"
    )


def gdal_transform(grid: MapGrid) -> Affine:
    """The geotransform of a map grid; GDAL counts from the corner of the first pixel."""
    corner = grid.origin_xy - grid.step_xy @ [GDAL_FIRST_PIXEL, GDAL_FIRST_PIXEL]
    (xl, xs), (yl, ys) = grid.step_xy
    return Affine(*(float(number) for number in (xs, xl, corner[0], ys, yl, corner[1])))


def _axes(grid: MapGrid) -> str:
    """How the axes of the data follow those of the reference system, which may put latitude first."""
    return "2,1" if grid.first_axis_is_north else "1,2"
