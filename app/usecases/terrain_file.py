"""Terrains in files, as commands and jobs name them."""

from dataclasses import dataclass
from pathlib import Path

from amers.services.errors import MissingGeoid
from amers.services.formats.elevation.dem import read_dem
from amers.services.terrain import Terrain

HEIGHT_SIGMA_POSTINGS = 0.1
"""Assumed standard deviation of heights between the nodes of a terrain, in distances of its nodes."""


@dataclass(frozen=True)
class TerrainFile:
    """A terrain in a file.

    Attributes:
        dem: file with the heights.
        vertical: vertical datum of the heights, where the file does not state it; see `read_dem`.
        geoid: grid file of the geoid, where PROJ has none.
        fill_px: voids are filled from heights at most this many nodes away.
        geoid_option: what gives `geoid`, for the error when the grid is missing.
    """

    dem: Path
    vertical: str | None = None
    geoid: Path | None = None
    fill_px: int = 0
    geoid_option: str = "--geoid"


def read_terrain(file: TerrainFile) -> Terrain:
    """The terrain of a file; it stays open and is read by windows.

    Raises:
        InputError: the file cannot be used, or the vertical datum is unknown.
    """
    try:
        return read_dem(file.dem, file.vertical, file.geoid, file.fill_px)
    except MissingGeoid as error:
        raise MissingGeoid(f"{file.dem}: {error} with {file.geoid_option}") from None
