"""An ortho pair of simulated ground, matched by AROSICS and by registration on a reference image."""

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

from amers.services.formats.images.scenes import read_scene
from amers.services.imagery.source import Window
from amers.services.matching.reference_image import Reference
from amers.services.registration.on_reference import register_on_reference
from amers.services.registration.options import ReferenceOptions
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewPlan, plan_geometry
from amers.services.simulation.world import make_world
from amers.services.types import Array
from benchmarks._measuring import memory_mib

GSD_M = 0.5
SHIFT_M = (6.0, -4.0)
"""By how much the second image is said to lie further east and north than it does."""
LARGEST_SHIFT_PX = 40
DAYS = (datetime(2024, 6, 12, 10, 30, tzinfo=UTC), datetime(2024, 6, 20, 10, 40, tzinfo=UTC))
SEED = 4
_STRIP = 512


@dataclass(frozen=True)
class Errors:
    """Of accepted tie points against the shift that was put in, pixels.

    Attributes:
        shift_px: of their median.
        median_px, rms_px: of one of them, length.
    """

    shift_px: float
    median_px: float
    rms_px: float


@dataclass(frozen=True)
class TiePoints:
    """What was found in the pair, by a process of its own.

    Attributes:
        tried, accepted: tie points.
        cpu_s: of the first run in the process, all threads, without imports.
        again_s: median of those after it; NaN where there was none.
        start_mib, peak_mib: resident memory before the first run, imports included, and at its highest.
        errors: of the accepted.
    """

    tried: int
    accepted: int
    cpu_s: float
    again_s: float
    start_mib: float
    peak_mib: float
    errors: Errors


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


def register_pair(folder: Path, repeats: int) -> TiePoints:
    """Tie points of the pair by registration on a reference image with default options."""
    start_mib = memory_mib("VmRSS")
    taken_s = []
    for _ in range(1 + repeats):
        start = time.process_time()
        base = read_scene(folder / "ortho_0.tif", sigma_m=1.0)
        scene = read_scene(folder / "ortho_1.tif", sigma_m=largest_shift_m() / 3.0)
        reference = Reference(base.image, base.model, None, 0.5 * GSD_M, 0.0, 0.1 * GSD_M)
        registration = register_on_reference(scene, reference)
        taken_s.append(time.process_time() - start)
    measures = registration.measures
    active = measures.active
    line, sample = (measures.predicted - measures.line_sample)[active].T
    shift_m = GSD_M * np.column_stack([sample, -line])
    return TiePoints(
        tried=len(active),
        accepted=int(active.sum()),
        cpu_s=taken_s[0],
        again_s=median(taken_s[1:]),
        start_mib=start_mib,
        peak_mib=memory_mib("VmHWM"),
        errors=errors_of(shift_m),
    )


def errors_of(shift_m: Array) -> Errors:
    """Errors of shifts (n, 2) east, north, by which the second image has to be moved."""
    error_px = (shift_m + np.array(SHIFT_M)) / GSD_M
    length_px = np.hypot(error_px[:, 0], error_px[:, 1])
    return Errors(
        shift_px=float(np.hypot(*np.median(error_px, axis=0))),
        median_px=float(np.median(length_px)),
        rms_px=float(np.sqrt((length_px**2).mean())),
    )


def largest_shift_m() -> float:
    """How far both look."""
    return LARGEST_SHIFT_PX * GSD_M


def find_tie_points(python: str, folder: Path, size: int) -> TiePoints:
    """Tie points of the pair on a grid of as many places, by an interpreter that has AROSICS."""
    grid_px = int(size / np.sqrt(ReferenceOptions().places))
    script = Path(__file__).with_name("_arosics_run.py")
    names = [str(folder / f"ortho_{number}.tif") for number in range(2)]
    result = subprocess.run(
        [python, str(script), *names, str(grid_px), str(LARGEST_SHIFT_PX)],
        check=True,
        capture_output=True,
        text=True,
        cwd=folder,
    )
    output = json.loads(result.stdout.strip().splitlines()[-1])
    shift_m = np.column_stack([output.pop("east_m"), output.pop("north_m")])
    return TiePoints(again_s=float("nan"), accepted=len(shift_m), errors=errors_of(shift_m), **output)
