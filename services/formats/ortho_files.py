"""Ortho-images with a corrected place on the map: beside the image, or in a copy of it."""

import shutil
from pathlib import Path
from xml.sax.saxutils import escape

import rasterio
from rasterio.transform import Affine

from services.errors import FormatError
from services.formats.raster import (
    GDAL_FIRST_PIXEL,
    OPTIONS,
    as_format_error,
    map_grid_of,
    open_raster,
)
from services.map_grid import MapGrid


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
