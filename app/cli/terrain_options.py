"""The options that give a terrain."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.options import GeoidFile, Shown
from amers.app.usecases.terrain_file import TerrainFile


@dataclass(frozen=True)
class TerrainOptions:
    """A terrain, or none.

    Attributes:
        dem: heights of the ground: GeoTIFF, .hgt, .bil, .asc, VRT …, a folder or .txt list of them.
        vertical: vertical datum of the heights: ellipsoid, EGM96, EGM2008, EPSG:…
        geoid: grid file of the geoid, GTX or GeoTIFF; also its name among PROJ's grids.
    """

    dem: Path | None = None
    vertical: str | None = None
    geoid: GeoidFile = None

    @property
    def terrain(self) -> TerrainFile | None:
        """The terrain; None without --dem."""
        return None if self.dem is None else TerrainFile(self.dem, self.vertical, self.geoid)


Terrain = Annotated[
    TerrainFile,
    Shown(
        dem=typer.Option(exists=True),
        vertical=None,
        geoid=typer.Option(),
        fill_px=typer.Option(min=0, max=50),
    ),
]
"""A terrain without which a command does nothing."""
