"""A block of an ortho-image over two cells, one without texture, and references with known errors."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from amers.app.usecases.new_block import BlockIdentity
from amers.app.usecases.ortho_production import OrthoFiles, run_ortho_production
from amers.services.production.ortho_production import OrthoPointOptions
from amers.services.types import Array
from tests.services.textures import moved, texture

GSD_M = 2.0
SIDE = 1400
CORNER_XY = (404_798.0, 5_806_430.0 + 1_400.0)
"""Upper left corner, UTM 33: parallel 52.4 runs through the middle of the image."""
GROUND_M = 120.0
HEIGHT_BIAS_M = 1.5
NODE_NOISE_M = 0.4
HEIGHT_NOISE_M = NODE_NOISE_M * 2.0 / 3.0
"""Between nodes with independent noise, bilinear heights have a third less, on the average."""
SHIFT_PX = (-1.5, 1.0)
"""Lines and samples by which the site shows everything off: 3 m north and 2 m east on the map."""
SPACING_M = 200.0


@dataclass(frozen=True)
class QualityWorld:
    """Files of a block and of its references.

    Attributes:
        block: folder; its southern half has few points, as only two islands have texture.
        image: that the block was made of.
        site: ortho-image that shows everything shifted.
        control_site: one that does not.
        far: one of other ground.
        dem: heights below the points, with a bias and noise.
        lake: GeoJSON of the southern half.
    """

    block: Path
    image: Path
    site: Path
    control_site: Path
    far: Path
    dem: Path
    lake: Path


def make_quality_world(folder: Path) -> QualityWorld:
    """Write the files."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(21)
    land = texture(rng, SIDE, 1.5)
    shifted = moved(land, *SHIFT_PX)
    half = SIDE // 2
    # Two islands of texture in the south, so that the outline of the points supports the lake.
    for pixels in (land, shifted):
        pixels[half:, 200:-200] = 0.0
        pixels[half:-200] = 0.0
    image = _write(folder / "land.tif", land, 0, 0)
    control_site = _write(folder / "harbour.tif", land[:, :half], 0, 0)
    site = _write(folder / "airport.tif", shifted[:, half:], 0, half)
    options = OrthoPointOptions(spacing_m=SPACING_M, fine_gsd_m=GSD_M)
    files = OrthoFiles((image,), None, GROUND_M, 0.3, sigma_m=3.0, frame_sigma_up_m=2.0)
    run_ortho_production(
        files, folder / "block", BlockIdentity("land", title="A piece of land"), options
    )
    return QualityWorld(
        block=folder / "block",
        image=image,
        site=site,
        control_site=control_site,
        far=_write(folder / "far.tif", land[:100, :100], -90_000, 0),
        dem=_write_dem(folder / "dem.tif", rng),
        lake=_write_lake(folder / "lake.geojson"),
    )


def _write(path: Path, pixels: Array, line: int, sample: int) -> Path:
    """A map image of a part of the land, from a line and a sample on."""
    values = np.rint(500.0 + 100.0 * pixels).astype(np.uint16)
    corner = CORNER_XY[0] + sample * GSD_M, CORNER_XY[1] - line * GSD_M
    transform = from_origin(*corner, GSD_M, GSD_M)
    profile = {"driver": "GTiff", "count": 1, "dtype": "uint16", "crs": "EPSG:32633"}
    height, width = values.shape
    with rasterio.open(path, "w", height=height, width=width, transform=transform, **profile) as file:
        file.write(values, 1)
    return path


def _write_dem(path: Path, rng: np.random.Generator) -> Path:
    """Heights in steps of 10 m, below the points by the bias, with noise."""
    shape = (SIDE // 5 + 20, SIDE // 5 + 20)
    heights = GROUND_M - HEIGHT_BIAS_M + rng.normal(0.0, NODE_NOISE_M, shape)
    transform = from_origin(CORNER_XY[0] - 100.0, CORNER_XY[1] + 100.0, 10.0, 10.0)
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "crs": "EPSG:32633"}
    height, width = shape
    with rasterio.open(path, "w", height=height, width=width, transform=transform, **profile) as file:
        file.write(heights.astype(np.float32), 1)
    return path


def _write_lake(path: Path) -> Path:
    """The ground south of parallel 52.4."""
    path.write_text(
        '{"type": "Polygon", "coordinates": [[[13, 52], [14, 52], [14, 52.4], [13, 52.4], [13, 52]]]}'
    )
    return path
