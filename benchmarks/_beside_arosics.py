"""An ortho pair of simulated ground by AROSICS and by the dense method, at as many places."""

import json
import subprocess
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median

import numpy as np
import rasterio
from rasterio.windows import Window as RasterWindow

from services.formats.scenes import read_scene
from services.geodesy import metres_per_degree
from services.imagery import Window
from services.matching.dense import Reference
from services.reference import ReferenceOptions, register_on_reference
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
    """What was found in the pair.

    Attributes:
        tried, accepted: tie points.
        cpu_s: on one core, without imports.
        east_m, north_m: median shift of the accepted ones: what the second image has to be moved by.
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


def register_pair(folder: Path, count: int, repeats: int) -> TiePoints:
    """Tie points of the pair at about `count` places by the dense method; median CPU time."""
    taken_s = []
    for _ in range(1 + repeats):
        start = time.process_time()
        base = read_scene(folder / "ortho_0.tif", sigma_m=1.0)
        scene = read_scene(folder / "ortho_1.tif", sigma_m=largest_shift_m() / 3.0)
        reference = Reference(base.image, base.model, None, 0.5 * GSD_M, 0.0, 0.1 * GSD_M)
        found = register_on_reference(scene, reference, ReferenceOptions(places=count))
        taken_s.append(time.process_time() - start)
    active = found.measures.active
    seen = scene.model.locate(found.measures.line_sample[active], np.zeros(int(active.sum())))
    shift_deg = np.median(found.measures.lon_lat_h[active] - seen, axis=0)[:2]
    metres = np.array(metres_per_degree(float(seen[0, 1]), 0.0))
    east_m, north_m = (shift_deg * metres).tolist()
    return TiePoints(len(active), int(active.sum()), median(taken_s[1:]), east_m, north_m)


def largest_shift_m() -> float:
    """How far both look."""
    return LARGEST_SHIFT_PX * GSD_M


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
