"""Terrains in files, as commands and jobs name them."""

from dataclasses import dataclass, replace
from pathlib import Path

from amers.services.errors import MissingGeoid
from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.pieces import Source
from amers.services.terrain import Terrain
from amers.services.types import Array


@dataclass(frozen=True)
class TerrainFile:
    """A terrain in a file.

    Attributes:
        dem: file with the heights of the ground, or its tiles in files, a folder, a list or a
            catalogue; see `read_dem`.
        vertical: vertical datum of the heights: ellipsoid, EGM96, EGM2008, EPSG:…
        geoid: grid file of the geoid, GTX or GeoTIFF.
        fill_px: fill voids of the terrain from heights at most this many nodes away.
        geoid_option: what gives `geoid`, for the error when the grid is missing.
        is_uploaded: the file comes from a stranger: only an image that names no other file is read.
    """

    dem: Source
    vertical: str | None = None
    geoid: Path | None = None
    fill_px: int = 0
    geoid_option: str = "--geoid"
    is_uploaded: bool = False


def read_terrain(
    file: TerrainFile, sigma_m: float | None = None, outline: Array | None = None
) -> Terrain:
    """The terrain of a file; it stays open and is read by windows.

    Args:
        file: with the heights.
        sigma_m: one standard deviation of its heights; by default that of each cell of a surface, and
            0.1 of the distance of the nodes for others.
        outline: (n, 2) lon, lat where heights are needed; see `read_dem`.

    Raises:
        InputError: the file cannot be used, or the vertical datum is unknown.
    """
    try:
        terrain = read_dem(
            file.dem,
            file.vertical,
            file.geoid,
            file.fill_px,
            images_only=file.is_uploaded,
            outline=outline,
        )
    except MissingGeoid as error:
        raise MissingGeoid(f"{file.dem}: {error} with {file.geoid_option}") from None
    return terrain if sigma_m is None else replace(terrain, sigmas=float(sigma_m))
