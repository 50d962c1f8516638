"""A reference ortho-image and a terrain, to register scenes on where there are no control points."""

from dataclasses import dataclass
from pathlib import Path

from app.errors import InputError
from app.usecases.orthorectification import TerrainFile
from services.formats.dem import read_dem
from services.formats.raster import map_grid_of, open_raster
from services.matching.dense import Reference
from services.sensors.ortho import OrthoModel

LOCAL_SIGMA_PX = 0.3
"""How far details of an ortho-image lie off the rest of it, one standard deviation, its own pixels."""
COMMON_SIGMA_PX = 0.1
"""What all of them share towards another image: shadows and roofs that lean alike, its own pixels."""
HEIGHT_SIGMA_POSTINGS = 0.1
"""How good the heights between the nodes of a terrain are taken to be, in distances of its nodes."""

NO_HEIGHT_SIGMA_M = 5000.0
"""Of heights nobody gave: land reaches from -430 to 8,850 m."""


@dataclass(frozen=True)
class ReferenceFiles:
    """A reference on the disk.

    Attributes:
        image: ortho-image: GeoTIFF (or COG) or JPEG 2000 on a map.
        terrain: heights of the same place; only an ortho-image as scene needs none.
        sigma_m: how well the image lies on the Earth as a whole, one standard deviation a coordinate;
            None when unknown.
    """

    image: Path
    terrain: TerrainFile | None = None
    sigma_m: float | None = None


def read_reference(files: ReferenceFiles) -> Reference:
    """Open a reference; its files stay open and are read by windows.

    Raises:
        InputError: when the image lies on no map, or the terrain cannot be used.
    """
    image = open_raster(files.image)
    grid = map_grid_of(image)
    if grid is None:
        image.close()
        raise InputError(f"{files.image}: expected an ortho-image on a map, found no reference system")
    model = OrthoModel(grid)
    gsd_m = grid.gsd_m
    terrain = None
    height_sigma_m = NO_HEIGHT_SIGMA_M
    if files.terrain is not None:
        asked = files.terrain
        terrain = read_dem(asked.dem, asked.vertical, asked.geoid, asked.fill_px)
        height_sigma_m = HEIGHT_SIGMA_POSTINGS * terrain.posting_m
    return Reference(
        image=image,
        model=model,
        terrain=terrain,
        sigma_m=LOCAL_SIGMA_PX * gsd_m,
        height_sigma_m=height_sigma_m,
        common_sigma_m=COMMON_SIGMA_PX * gsd_m,
        frame_sigma_m=float("nan") if files.sigma_m is None else files.sigma_m,
    )
