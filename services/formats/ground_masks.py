"""Masks and land cover of the ground in files: GeoJSON polygons, or images on a map."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import shapely

from amers.services.errors import FormatError
from amers.services.formats.images.raster import RasterImage, map_grid_of, open_values
from amers.services.formats.stac.catalogue import parse_area
from amers.services.formats.text_files import load_json, read_text
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.quality.density import GroundMask
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


def read_ground_mask(path: Path) -> GroundMask:
    """The ground that a file excludes: polygons in GeoJSON, or pixels of an image on a map other than 0.

    Ground beyond the image, and its pixels without data, are not excluded. The image stays open.

    Raises:
        FormatError: the file cannot be read, has no polygon, or is an image on no map.
    """
    if path.suffix.lower() in (".json", ".geojson"):
        area = parse_area(load_json(read_text(path), str(path)), str(path))
        shapely.prepare(area)

        def inside(lon_lat: Array) -> BoolArray:
            return np.asarray(shapely.contains_xy(area, lon_lat[:, 0], lon_lat[:, 1]))

        return inside
    image, grid = _on_map(path)

    def covered(lon_lat: Array) -> BoolArray:
        return np.asarray(np.nan_to_num(_values(image, grid, lon_lat)) != 0.0)

    return covered


def read_land_cover(path: Path) -> LandCover:
    """The land cover in an image on a map: names of ESA WorldCover if it has only its classes.

    Otherwise the classes are named by their numbers. The image stays open.

    Raises:
        FormatError: the image cannot be read, or is on no map.
    """
    image, grid = _on_map(path)

    def cover(lon_lat: Array) -> list[str]:
        values = _values(image, grid, lon_lat)
        classes = {int(value) for value in np.unique(values[np.isfinite(values)])} - {0}
        is_world_cover = classes <= set(WORLD_COVER)

        def name(value: float) -> str:
            if not np.isfinite(value) or int(value) == 0:
                return "unknown"
            return WORLD_COVER[int(value)] if is_world_cover else f"class {int(value)}"

        return [name(value) for value in values.tolist()]

    return cover


def any_of(masks: list[GroundMask]) -> GroundMask | None:
    """The ground that at least one of some masks excludes; None without masks."""
    if not masks:
        return None

    def covered(lon_lat: Array) -> BoolArray:
        return np.any([mask(lon_lat) for mask in masks], axis=0)

    return covered


def _on_map(path: Path) -> tuple[RasterImage, MapGrid]:
    image = open_values(path)
    grid = map_grid_of(image)
    if grid is None:
        image.close()
        raise FormatError(
            f"{path}: no coordinate reference system found, polygons in GeoJSON or an image on a map "
            "expected"
        )
    return image, grid


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
