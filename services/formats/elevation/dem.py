"""Reading digital elevation models as terrain with heights above the WGS 84 ellipsoid."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from amers.services.errors import CoverageError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.elevation.filled_voids import FilledVoids
from amers.services.formats.elevation.grid_files import HEIGHTS
from amers.services.formats.elevation.heights import HeightsByCaller
from amers.services.formats.elevation.mosaic import mosaic_of
from amers.services.formats.elevation.tiles import HeightTile, read_tile
from amers.services.formats.pieces import Source, pieces_of
from amers.services.imagery.source import ImageSource
from amers.services.statements import gathered
from amers.services.terrain import Geoid, Terrain
from amers.services.types import Array


def read_dem(
    path: Source,
    vertical: str | None = None,
    geoid: Path | None = None,
    fill_px: int = 0,
    *,
    images_only: bool = False,
    outline: Array | None = None,
) -> Terrain:
    """The terrain in a file, or in many tiles; files stay open and are read by windows.

    A surface brings the standard deviation of each of its heights.

    Args:
        path: GeoTIFF (or COG), JPEG 2000 or NITF with any reference system; any other file of
            `amers.services.formats.elevation.grid_files`; or several, a folder, a list or a catalogue of
            them, see `amers.services.formats.pieces`.
        vertical: vertical datum of the heights, when the file does not state it: "ellipsoid", "EGM96",
            "EGM2008" or the code of a vertical reference system.
        geoid: grid file of the geoid; by default the grid that PROJ has installed.
        fill_px: largest distance in nodes from which voids are filled; 0 leaves voids.
        images_only: read only what names no other file, as for uploads.
        outline: (n, 2) lon, lat; items of catalogues are taken where their boxes meet its box.

    Raises:
        FormatError: the file cannot be used.
        VerticalDatumError: the vertical datum is not stated, the file and the caller contradict each
            other, or the grid of the geoid is missing.
        CoverageError: the grid of the geoid does not cover the terrain.
    """
    caller = HeightsByCaller(vertical, geoid)
    tiles: list[FilePlace] = []
    if images_only and isinstance(path, Path):
        tiles.append(path)
    else:
        tiles.extend(pieces_of(path, HEIGHTS, outline))
    if len(tiles) == 1:
        tile = read_tile(tiles[0], caller, images_only=images_only)
        grid, statements = tile.grid, tile.statements
        heights: ImageSource = tile.heights
        sigmas: ImageSource | None = tile.sigmas
    else:
        tile, grid, heights, statements = mosaic_of(path, tiles, caller)
        sigmas = replace(heights, has_sigmas=True) if tile.sigmas else None
    note = tile.datum.origin
    if fill_px > 0:
        heights = FilledVoids(heights, fill_px)
        sigmas = sigmas and FilledVoids(sigmas, fill_px)
        note += f"; voids filled from heights within {fill_px} nodes"
    terrain = Terrain(grid, heights, tile.datum.zero_m, note, gathered(statements), sigmas)
    if terrain.geoid is not None:
        _check_geoid_coverage(tile, terrain.geoid, path)
    return terrain


def _check_geoid_coverage(tile: HeightTile, geoid: Geoid, path: Source) -> None:
    """Refuse a geoid of another region, with which every height would be unknown."""
    last = np.array(tile.grid.shape) - 1.0
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]]) * last
    if np.isnan(geoid(tile.grid.lon_lat(corners))).all():
        raise CoverageError(
            f"{path}: the grid of the geoid does not cover the terrain; give the geoid of this region"
        )
