"""Web map tiles of surfaces: coloured and shaded heights, rendered from the file on request."""

import cv2
import numpy as np

from amers.services.formats.images.surfaces import SurfaceImage
from amers.services.imagery.source import Window
from amers.services.orthorectification.tile_limits import TILE_PX, TileLimits, TilePlace, tiles_over
from amers.services.surface.relief import relief
from amers.services.surface.tiles import part_of_grid
from amers.services.types import Array

_MARGIN_PX = 1
"""Pixels around a tile whose heights its slopes need, so that tiles meet without seams."""
_OUTLINE_PLACES = 9
"""Places along each edge of a surface: its edges are bent on another map."""


def outline_of(surface: SurfaceImage) -> Array:
    """Longitudes and latitudes (n, 2) of places along the edges of a surface."""
    lines, samples = surface.grid.shape
    across = np.linspace(-0.5, samples - 0.5, _OUTLINE_PLACES)
    down = np.linspace(-0.5, lines - 0.5, _OUTLINE_PLACES)
    edges = [(line, sample) for line in (-0.5, lines - 0.5) for sample in across]
    edges += [(line, sample) for line in down for sample in (-0.5, samples - 0.5)]
    return surface.grid.lon_lat(np.array(edges))


def surface_limits(surface: SurfaceImage) -> list[TileLimits]:
    """The tiles that a surface lies on, from the zoom of its cells to one with a few tiles.

    Raises:
        InputError: the surface is too near to a pole for a map of the web.
    """
    lines, samples = surface.grid.shape
    return tiles_over(outline_of(surface), surface.grid.gsd_m, lines * samples)


def draw_surface_tile(surface: SurfaceImage, place: TilePlace, limits_m: tuple[float, float]) -> bytes:
    """A tile of a surface as PNG, transparent where there is no height.

    Args:
        surface: open.
        place: of the tile.
        limits_m: heights of the first and the last colour.

    Raises:
        FormatError: the file cannot be read there.
    """
    of_tile = TileLimits(place.zoom, place.row, place.row, place.column, place.column).grid()
    grid = part_of_grid(of_tile, Window(0, 0, TILE_PX, TILE_PX), _MARGIN_PX)
    pixel_m = grid.gsd_m
    places = np.indices(grid.shape).reshape(2, -1).T.astype(np.float64)
    cells = surface.grid.line_sample(grid.lon_lat(places))
    height_m = surface.at(cells, pixel_m / surface.grid.gsd_m)[0].reshape(grid.shape)
    inner = np.s_[_MARGIN_PX:-_MARGIN_PX, _MARGIN_PX:-_MARGIN_PX]
    pixels = relief(height_m, pixel_m, limits_m)[inner][:, :, [2, 1, 0, 3]]
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels))
    assert done, "a tile can be a PNG"
    return encoded.tobytes()
