"""The tiles of a web map over a scene, in the tile matrix set WebMercatorQuad of OGC.

Zoom z divides the square of the spherical Mercator map (EPSG:3857) into 2^z x 2^z tiles of 256 pixels a
side; row 0 is the northernmost, column 0 begins at longitude -180.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from amers.services.errors import InputError
from amers.services.geodesy import WGS84_A, longitudes_near
from amers.services.imagery.scene import Scene, scene_footprint, scene_gsd_m
from amers.services.map_grid import MapGrid, map_units_per_metre
from amers.services.types import Array

TILE_PX = 256
MOST_ZOOM = 24
_CRS = "EPSG:3857"
_HALF_WORLD_M = math.pi * WGS84_A
_MOST_LATITUDE_DEG = 85.0
_FEW = 2
"""The coarsest zoom has at most this many rows and columns of tiles."""
_MOST_MAP_PIXELS = 8
"""The finest zoom has at most this many times the pixels of the scene: a narrow scene lies askew in a
box that is mostly empty."""


class TilePlace(NamedTuple):
    """The place of a tile in the tile matrix set."""

    zoom: int
    row: int
    column: int


@dataclass(frozen=True)
class TileLimits:
    """The rows and columns of the tiles of one zoom that a scene may lie on.

    Attributes:
        zoom: of the tile matrix.
        first_row, last_row, first_column, last_column: both inclusive; columns go on beyond
            2^zoom - 1 where a scene crosses the antimeridian.
    """

    zoom: int
    first_row: int
    last_row: int
    first_column: int
    last_column: int

    @property
    def rows(self) -> int:
        """Number of rows of tiles."""
        return self.last_row - self.first_row + 1

    @property
    def columns(self) -> int:
        """Number of columns of tiles."""
        return self.last_column - self.first_column + 1

    def index(self, place: TilePlace) -> int | None:
        """The number of a tile, row by row from 0; None outside the limits."""
        zoom, row, column = place
        if column < self.first_column and column >= 0:
            column += 2**self.zoom
        inside = (
            self.first_row <= row <= self.last_row and self.first_column <= column <= self.last_column
        )
        if zoom != self.zoom or not inside:
            return None
        return (row - self.first_row) * self.columns + column - self.first_column

    def grid(self) -> MapGrid:
        """The pixels of all these tiles as one map."""
        step_m = _step_m(self.zoom)
        corner = np.array([self.first_column, self.first_row]) * TILE_PX * step_m
        origin = np.array([-_HALF_WORLD_M, _HALF_WORLD_M]) + [1.0, -1.0] * (corner + step_m / 2.0)
        step = np.array([[0.0, step_m], [-step_m, 0.0]])
        return MapGrid(_CRS, origin, step, (self.rows * TILE_PX, self.columns * TILE_PX))

    def coarser(self) -> "TileLimits":
        """The tiles of the zoom before that hold the same ground."""
        return TileLimits(
            self.zoom - 1,
            self.first_row // 2,
            self.last_row // 2,
            self.first_column // 2,
            self.last_column // 2,
        )


def tile_outline(place: TilePlace) -> Array:
    """Longitudes and latitudes (4, 2) of the corners of a tile."""
    grid = TileLimits(place.zoom, place.row, place.row, place.column, place.column).grid()
    last = TILE_PX - 0.5
    return grid.lon_lat(np.array([[-0.5, -0.5], [-0.5, last], [last, last], [last, -0.5]]))


def choose_tiles(scenes: Sequence[Scene], heights_m: tuple[float, float]) -> list[TileLimits]:
    """The tiles of a scene from the zoom nearest to its ground sampling to one with a few tiles.

    Args:
        scenes: one image with the models that it is to be seen through.
        heights_m: lowest and highest ground.

    Returns:
        Limits from the finest zoom to the coarsest.

    Raises:
        InputError: the scene is too near to a pole for a map of the web.
    """
    lon_lat = np.concatenate([scene_footprint(one, heights_m) for one in scenes])
    return tiles_over(lon_lat, scene_gsd_m(scenes[0]), math.prod(scenes[0].image.shape))


def tiles_over(outline: Array, gsd_m: float, pixels: int) -> list[TileLimits]:
    """The tiles of an image on the map; see `choose_tiles`.

    Args:
        outline: (n, 2) longitudes and latitudes.
        gsd_m: of the image.
        pixels: of the image, their number.

    Raises:
        InputError: the image is too near to a pole for a map of the web.
    """
    lon_lat = outline.copy()
    lon_lat[:, 0] = longitudes_near(lon_lat[:, 0], lon_lat[0, 0])
    lat = float(np.abs(lon_lat[:, 1]).max())
    if not lat <= _MOST_LATITUDE_DEG:
        raise InputError(
            f"the scene reaches latitude {lat:.2f} degrees; the map of the web ends at "
            f"{_MOST_LATITUDE_DEG:g} degrees"
        )
    step_m = gsd_m * float(map_units_per_metre(_CRS, lon_lat.mean(axis=0))[0])
    zoom = min(max(round(math.log2(_step_m(0) / step_m)), 0), MOST_ZOOM)
    finest = _limits(lon_lat, zoom)
    most_tiles = _MOST_MAP_PIXELS * pixels / TILE_PX**2
    while finest.zoom > 0 and finest.rows * finest.columns > max(most_tiles, _FEW**2):
        finest = _limits(lon_lat, finest.zoom - 1)
    levels = [finest]
    while levels[-1].zoom > 0 and max(levels[-1].rows, levels[-1].columns) > _FEW:
        levels.append(levels[-1].coarser())
    return levels


def _step_m(zoom: int) -> float:
    """Map metres per pixel; metres on the ground at the equator only."""
    return 2.0 * _HALF_WORLD_M / TILE_PX / 2**zoom


def _limits(lon_lat: Array, zoom: int) -> TileLimits:
    """The tiles of a zoom over positions (n, 2), whose longitudes are continuous."""
    column = (lon_lat[:, 0] / 360.0 + 0.5) * 2**zoom
    row = (0.5 - np.arcsinh(np.tan(np.radians(lon_lat[:, 1]))) / (2.0 * math.pi)) * 2**zoom
    first_column = math.floor(column.min())
    wrapped = first_column % 2**zoom
    return TileLimits(
        zoom,
        math.floor(row.min()),
        math.floor(row.max()),
        wrapped,
        wrapped + math.floor(column.max()) - first_column,
    )
