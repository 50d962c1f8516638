"""The options that give a terrain."""

from dataclasses import dataclass
from typing import Annotated

import typer

from amers.app.cli.options import GeoidFile, Places, refuse_alone
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.pieces import source_of


@dataclass(frozen=True)
class TerrainOptions:
    """A terrain, or none.

    Attributes:
        dem: heights of the ground: GeoTIFF, .hgt, .bil, .asc, VRT …, a folder, archive, .txt list or
            STAC catalogue of them; path or address; repeat for several.
        vertical: vertical datum of the heights: ellipsoid, EGM96, EGM2008, EPSG:…
        geoid: grid file of the geoid, GTX or GeoTIFF; also its name among PROJ's grids.
    """

    dem: Places = ()
    vertical: str | None = None
    geoid: GeoidFile = None

    @property
    def terrain(self) -> TerrainFile | None:
        """The terrain; None without --dem.

        Raises:
            InputError: an option belongs to --dem, which is not given.
        """
        refuse_alone("dem", self, "vertical", "geoid")
        return TerrainFile(source_of(self.dem), self.vertical, self.geoid) if self.dem else None


@dataclass(frozen=True)
class NeededTerrain:
    """A terrain without which a command does nothing.

    Attributes:
        dem: heights of the ground: GeoTIFF, .hgt, .bil, .asc, VRT …, a folder, archive, .txt list or
            STAC catalogue of them; path or address; repeat for several.
        geoid: grid file of the geoid, GTX or GeoTIFF.
        vertical: vertical datum of the heights: ellipsoid, EGM96, EGM2008, EPSG:…
        fill_px: fill voids of the terrain from heights at most this many nodes away.
    """

    dem: Places
    vertical: str | None = None
    geoid: GeoidFile = None
    fill_px: Annotated[int, typer.Option(min=0, max=50)] = 0

    @property
    def terrain(self) -> TerrainFile:
        """The terrain."""
        return TerrainFile(source_of(self.dem), self.vertical, self.geoid, self.fill_px)
