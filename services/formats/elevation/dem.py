"""Reading digital elevation models as terrain with heights above the WGS 84 ellipsoid."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from amers.services.errors import CoverageError, FormatError
from amers.services.formats.elevation.filled_voids import FilledVoids
from amers.services.formats.elevation.grid_files import is_tile
from amers.services.formats.elevation.heights import HeightsByCaller
from amers.services.formats.elevation.mosaic import mosaic_of
from amers.services.formats.elevation.tiles import HeightTile, read_tile
from amers.services.formats.text_files import read_text
from amers.services.imagery.source import ImageSource
from amers.services.statements import gathered
from amers.services.terrain import Geoid, Terrain

MOST_TILES = 20_000
"""Largest number of tiles of one terrain: SRTM has 14,000."""


def read_dem(
    path: Path,
    vertical: str | None = None,
    geoid: Path | None = None,
    fill_px: int = 0,
    *,
    images_only: bool = False,
) -> Terrain:
    """The terrain in a file, or in many tiles; files stay open and are read by windows.

    A surface brings the standard deviation of each of its heights.

    Args:
        path: GeoTIFF (or COG), JPEG 2000 or NITF with any reference system; any other file of
            `amers.services.formats.elevation.grid_files`; a folder of them; or a text file `.txt` with
            one of them a line, relative to its own folder.
        vertical: vertical datum of the heights, when the file does not state it: "ellipsoid", "EGM96",
            "EGM2008" or the code of a vertical reference system.
        geoid: grid file of the geoid; by default the grid that PROJ has installed.
        fill_px: largest distance in nodes from which voids are filled; 0 leaves voids.
        images_only: read only what names no other file, as for uploads.

    Raises:
        FormatError: the file cannot be used.
        VerticalDatumError: the vertical datum is not stated, the file and the caller contradict each
            other, or the grid of the geoid is missing.
        CoverageError: the grid of the geoid does not cover the terrain.
    """
    caller = HeightsByCaller(vertical, geoid)
    tiles = [path] if images_only else _tiles(path)
    if tiles == [path]:
        tile = read_tile(path, caller, images_only=images_only)
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


def _tiles(path: Path) -> list[Path]:
    """The files of a terrain, by name.

    Raises:
        FormatError: a folder or a list has none, too many, or one that does not exist.
    """
    if path.is_dir():
        tiles = sorted(file for file in path.iterdir() if is_tile(file))
        expected = "a folder with files of heights"
    elif path.suffix.lower() == ".txt" and path.is_file():
        lines = [line.strip() for line in read_text(path).splitlines()]
        tiles = [path.parent / line for line in lines if line and not line.startswith("#")]
        expected = "a list of files of heights, one a line"
        missing = [tile for tile in tiles if not tile.is_file()]
        if missing:
            raise FormatError(f"{path}: {missing[0]} does not exist; expected {expected}")
    else:
        return [path]
    if not 1 <= len(tiles) <= MOST_TILES:
        raise FormatError(f"{path}: expected {expected}, at most {MOST_TILES:,}, found {len(tiles):,}")
    return tiles


def _check_geoid_coverage(tile: HeightTile, geoid: Geoid, path: Path) -> None:
    """Refuse a geoid of another region, with which every height would be unknown."""
    last = np.array(tile.grid.shape) - 1.0
    corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [0.5, 0.5]]) * last
    if np.isnan(geoid(tile.grid.lon_lat(corners))).all():
        raise CoverageError(
            f"{path}: the grid of the geoid does not cover the terrain; give the geoid of this region"
        )
