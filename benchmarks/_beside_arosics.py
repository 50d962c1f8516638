"""AROSICS on an ortho pair of simulated ground, with as many tie points as a registration has points."""

import json
import subprocess
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window as RasterWindow

from services.imagery import Window
from services.simulation.tiles import TiledView
from services.simulation.view import ViewPlan, plan_geometry
from services.simulation.world import make_world

GSD_M = 0.5
SHIFT_M = (6.0, -4.0)
"""By how much the second image is said to lie further east and north than it does."""
LARGEST_SHIFT_PX = 40
DAYS = (datetime(2024, 6, 12, 10, 30, tzinfo=UTC), datetime(2024, 6, 20, 10, 40, tzinfo=UTC))
SEED = 4
_STRIP = 512


@dataclass(frozen=True)
class TiePoints:
    """What AROSICS found.

    Attributes:
        tried, accepted: tie points.
        cpu_s: on one core, without its imports.
        east_m, north_m: median shift of the accepted ones.
    """

    tried: int
    accepted: int
    cpu_s: float
    east_m: float
    north_m: float


def make_pair(folder: Path, size: int) -> None:
    """Two images of one ground from straight above, on two days, laid on a map as ortho-images are."""
    world = make_world(np.random.default_rng(SEED), size_m=2_000.0)
    lon, lat = world.centre_lon_lat.tolist()
    for number, acquired_at in enumerate(DAYS):
        plan = ViewPlan(f"ortho_{number}", (lon, lat), (size, size), GSD_M, acquired_at=acquired_at)
        geometry = plan_geometry(world, plan, np.random.default_rng(SEED))
        image = TiledView(world, geometry, SEED + number)
        east_m, north_m = (number * shift for shift in SHIFT_M)
        corner = rasterio.transform.from_origin(5e5 + east_m, 49e5 + north_m, GSD_M, GSD_M)
        with rasterio.open(
            folder / f"ortho_{number}.tif",
            "w",
            driver="GTiff",
            height=size,
            width=size,
            count=1,
            dtype="uint16",
            crs="EPSG:32631",
            transform=corner,
            tiled=True,
            compress="deflate",
            predictor=2,
        ) as file:
            for line in range(0, size, _STRIP):
                strip = image.read(Window(line, 0, min(_STRIP, size - line), size))
                window = RasterWindow(0, line, size, len(strip))
                file.write(strip.astype(np.uint16), 1, window=window)


def find_tie_points(python: str, folder: Path, size: int, count: int) -> TiePoints:
    """Tie points of the pair on a grid of about `count` places, by an interpreter that has AROSICS."""
    grid_px = int(size / np.sqrt(count))
    script = Path(__file__).with_name("_arosics_run.py")
    names = [str(folder / f"ortho_{number}.tif") for number in range(2)]
    done = subprocess.run(
        [python, str(script), *names, str(grid_px), str(LARGEST_SHIFT_PX)],
        check=True,
        capture_output=True,
        text=True,
        cwd=folder,
    )
    return TiePoints(**json.loads(done.stdout.strip().splitlines()[-1]))
