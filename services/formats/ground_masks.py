"""Masks and land cover of the ground in files: GeoJSON polygons, or images on a map."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from rasterio.enums import ColorInterp

from amers.services.datums import horizontal
from amers.services.errors import FormatError
from amers.services.formats.gcp.record import Record
from amers.services.formats.images.raster import RasterImage, map_grid_of, open_raster
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.stac.catalogue import parse_area
from amers.services.formats.text_files import load_json, read_text
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.quality.density import GroundMask
from amers.services.statements import Statements, Subject
from amers.services.types import Array, BoolArray, IntArray

LandCover = Callable[[Array], list[str]]
"""The land cover at positions (n, 2) of longitude and latitude."""

WORLD_COVER = {
    10: "trees",
    20: "shrubs",
    30: "grass",
    40: "crops",
    50: "buildings",
    60: "bare ground",
    70: "snow and ice",
    80: "water",
    90: "wetland",
    95: "mangroves",
    100: "moss and lichen",
}
"""Classes of ESA WorldCover, version 2 (2021)."""

_TILE_PX = 1024


READER = Reader(
    "Masks and land cover of the ground",
    ("read_ground_mask", "read_land_cover"),
    (
        Treatment(Subject.HORIZONTAL_DATUM, "used", "An image on a map states its reference system."),
        Treatment(Subject.HORIZONTAL_DATUM, "assumed", "Polygons in GeoJSON are in WGS 84."),
        Treatment(
            Subject.HORIZONTAL_DATUM,
            "refused",
            "An image has no reference system, or a GeoJSON file states another system than WGS 84.",
        ),
        Treatment(Subject.ORDER, "refused", "A latitude is above 90 degrees."),
        Treatment(
            Subject.VALIDITY,
            "used",
            "The image has nodata pixels: their ground is not excluded, and their land "
            "cover is unknown.",
        ),
        Treatment(
            Subject.BANDS,
            "refused",
            "The land cover has several bands, so it is not clear which band contains the classes.",
        ),
        Treatment(
            Subject.IDENTITY,
            "assumed",
            "Classes are those of ESA WorldCover, unless the file states others.",
        ),
        Treatment(
            Subject.IDENTITY,
            "named",
            "Polygons have properties. Amers excludes all polygons.",
        ),
    ),
    (
        Subject.MODEL,
        Subject.PLACE,
        Subject.PIXEL_ORIGIN,
        Subject.VERTICAL_DATUM,
        Subject.UNIT,
        Subject.EPOCH,
        Subject.ACCURACY,
    ),
)


@dataclass(frozen=True)
class ExcludedGround:
    """The ground that a file excludes: a `GroundMask`.

    Attributes:
        excludes: whether positions (n, 2) of longitude and latitude are excluded.
        statements: of the file.
    """

    excludes: GroundMask
    statements: Statements = ()

    def __call__(self, lon_lat: Array) -> BoolArray:
        """Which positions (n, 2) are excluded."""
        return self.excludes(lon_lat)


@dataclass(frozen=True)
class CoveredGround:
    """The land cover of the ground in a file: a `LandCover`.

    Attributes:
        names: of the land cover at positions (n, 2) of longitude and latitude.
        statements: of the file.
    """

    names: LandCover
    statements: Statements = ()

    def __call__(self, lon_lat: Array) -> list[str]:
        """The land cover at positions (n, 2)."""
        return self.names(lon_lat)


def read_ground_mask(path: Path) -> ExcludedGround:
    """The ground that a file excludes: polygons in GeoJSON, or pixels of an image on a map other than 0.

    Ground beyond the image, and its pixels without data, are not excluded. Of a colour table, the index
    counts. The image stays open.

    Raises:
        FormatError: the file cannot be read, has no polygon, or is an image on no map.
    """
    if path.suffix.lower() in (".json", ".geojson"):
        return _polygons(path)
    image, grid, statements = _on_map(path)

    def covered(lon_lat: Array) -> BoolArray:
        return np.asarray(np.nan_to_num(_values(image, grid, lon_lat)) != 0.0)

    return ExcludedGround(covered, statements)


def _polygons(path: Path) -> ExcludedGround:
    document = load_json(read_text(path), str(path))
    area = parse_area(document, str(path))
    shapely.prepare(area)

    def inside(lon_lat: Array) -> BoolArray:
        return np.asarray(shapely.contains_xy(area, lon_lat[:, 0], lon_lat[:, 1]))

    record = Record(path.name)
    record.assumed(Subject.HORIZONTAL_DATUM, "WGS 84", "", "RFC 7946")
    features = document.get("features") or [document]
    names = {name: None for feature in features for name in feature.get("properties") or {}}
    if names:
        record.not_used(Subject.IDENTITY, ", ".join(names)[:80], "properties")
    return ExcludedGround(inside, tuple(record.statements))


def read_land_cover(path: Path) -> CoveredGround:
    """The land cover in an image on a map: names of ESA WorldCover if it has only its classes.

    Otherwise the classes are named by their numbers. The image stays open.

    Raises:
        FormatError: the image cannot be read, is on no map, or has several bands.
    """
    image, grid, statements = _on_map(path)
    bands = [band for band in image.dataset.colorinterp if band is not ColorInterp.alpha]
    if len(bands) > 1:
        image.close()
        raise FormatError(
            f"{path}: expected land cover in one band, found {len(bands)}; write the one with "
            "the classes into a file of its own (gdal_translate -b)"
        )

    def cover(lon_lat: Array) -> list[str]:
        values = _values(image, grid, lon_lat)
        classes = {int(value) for value in np.unique(values[np.isfinite(values)])} - {0}
        is_world_cover = classes <= set(WORLD_COVER)

        def name(value: float) -> str:
            if not np.isfinite(value) or int(value) == 0:
                return "unknown"
            return WORLD_COVER[int(value)] if is_world_cover else f"class {int(value)}"

        return [name(value) for value in values.tolist()]

    record = Record(path.name, list(statements))
    record.assumed(Subject.IDENTITY, "classes of ESA WorldCover", "", "others keep their numbers")
    return CoveredGround(cover, tuple(record.statements))


def any_of(masks: Sequence[GroundMask]) -> GroundMask | None:
    """The ground that at least one of some masks excludes; None without masks."""
    if not masks:
        return None

    def covered(lon_lat: Array) -> BoolArray:
        return np.any([mask(lon_lat) for mask in masks], axis=0)

    return covered


def _on_map(path: Path) -> tuple[RasterImage, MapGrid, Statements]:
    """An image, its map, and its statements; values of a colour table are classes, not grey."""
    image = open_raster(path)
    grid = map_grid_of(image)
    if grid is None:
        image.close()
        raise FormatError(
            f"{path}: no coordinate reference system found, polygons in GeoJSON or an image on a map "
            "expected"
        )
    of_pixels = [one for one in image.statements if one.subject is not Subject.BANDS]
    record = Record(path.name, of_pixels)
    record.used(Subject.HORIZONTAL_DATUM, horizontal(grid.crs).name, "reference system")
    return replace(image, palette=None), grid, tuple(record.statements)


def _values(image: RasterImage, grid: MapGrid, lon_lat: Array) -> Array:
    """Values (n,) of the pixels that positions fall in; NaN beyond the image and without data."""
    position = grid.line_sample(lon_lat)
    values = np.full(len(lon_lat), np.nan)
    for window, rows, pixel in _pieces(grid, position):
        pixels = image.read(window)
        values[rows] = pixels[pixel[:, 0] - window.line, pixel[:, 1] - window.sample]
    return values


def _pieces(grid: MapGrid, position: Array) -> Iterator[tuple[Window, IntArray, IntArray]]:
    """Yield windows of an image, each with the rows and the pixels of the positions in it."""
    rows = np.flatnonzero(grid.contains(position))
    pixel = np.clip(np.rint(position[rows]).astype(np.int64), 0, np.array(grid.shape) - 1)
    tile = pixel // _TILE_PX
    key = tile[:, 0] * (grid.shape[1] // _TILE_PX + 1) + tile[:, 1]
    order = np.argsort(key, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
        if len(part):
            low, high = pixel[part].min(axis=0), pixel[part].max(axis=0) + 1
            lines, samples = (int(size) for size in high - low)
            yield Window(int(low[0]), int(low[1]), lines, samples), rows[part], pixel[part]
