"""Surfaces of simulated pairs of growing size: time and the peak of memory, which must not grow.

The images are written strip by strip into a temporary folder, of which 20,000 x 20,000 pixels and the
work on them take up to 30 GB. Every pair is made in a process of its own, with the tasks of the surface
in that process, so that its peak is the one of all stages; `--jobs 2` tells the peak of the process that
hands out the tasks instead. Time is CPU of all processes.
Run: python -m benchmarks.surface_scale --sides 2500 5000
"""

import os

# Read by Numba when it is first imported.
os.environ["NUMBA_NUM_THREADS"] = "1"

import argparse
import multiprocessing
import resource
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import rasterio

from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.surface import SurfaceFiles, run_surface
from amers.services.formats.images.raster import gdal_rpc
from amers.services.simulation.view import ViewPlan, plan_geometry, render_view
from amers.services.simulation.world import World, make_world
from amers.services.surface.options import SurfaceOptions
from benchmarks._measuring import keep, memory_mib, open_folder, print_table

GSD_M = 0.5
RELIEF_M = 60.0
LOOKS = {"left": (14.0, 270.0), "right": (14.0, 90.0)}
"""Incidence and azimuth: a base over height of 0.5."""


@dataclass(frozen=True)
class Outcome:
    """One surface.

    Attributes:
        side_px: lines and samples of each image.
        jobs: processes of the tasks.
        wall_s, cpu_s: of the whole surface, its file included.
        memory_mib: highest resident memory of the process that makes it.
        work_mib: of the work folder before the end.
        found: share of the cells with a height.
        stages_s: CPU of the tasks of each stage.
    """

    side_px: int
    jobs: int
    wall_s: float
    cpu_s: float
    memory_mib: float
    work_mib: float
    found: float
    stages_s: dict[str, float]


def write_pair(world: World, folder: Path, side: int) -> tuple[Path, ...]:
    """Write both images with their true models, strip by strip."""
    lon, lat = (float(value) for value in world.centre_lon_lat)
    paths = []
    for number, (name, look) in enumerate(LOOKS.items()):
        plan = ViewPlan(name, (lon, lat), (side, side), GSD_M, *look)
        geometry = plan_geometry(world, plan, np.random.default_rng(number))
        profile = {"driver": "GTiff", "width": side, "height": side, "count": 1, "dtype": "uint16"}
        profile |= {"tiled": True, "blockxsize": 512, "blockysize": 512, "compress": "deflate"}
        paths.append(folder / f"{name}.tif")
        with rasterio.open(paths[-1], "w", **profile, zlevel=1, predictor=2) as file:
            file.rpcs = gdal_rpc(geometry.rpc)
            for line, strip in render_view(world, geometry, np.random.default_rng(number)):
                window = rasterio.windows.Window(0, line, side, len(strip))
                file.write(strip, 1, window=window)
    return tuple(paths)


def write_images(folder: Path, side: int) -> None:
    """Write the images of one size; the world repeats beyond 2 km."""
    write_pair(make_world(np.random.default_rng(5), 2000.0, GSD_M, RELIEF_M), folder, side)


def measure(folder: Path, side: int, jobs: int, answer: "multiprocessing.Queue[Outcome]") -> None:
    """Make the surface of the images in a folder, and tell what it took."""
    images = tuple(folder / f"{name}.tif" for name in LOOKS)
    begun = time.perf_counter()
    work = folder / "work"
    surface = run_surface(
        SurfaceFiles(images),
        folder / "surface.tif",
        SurfaceOptions(),
        place=WorkPlace(work, ComputeOptions(jobs)),
    )
    wall_s = time.perf_counter() - begun
    own = resource.getrusage(resource.RUSAGE_SELF)
    # The server of the processes forks them, so that they are no children of this one.
    elsewhere_s = sum(effort.cpu_s for effort in surface.effort.values()) if jobs > 1 else 0.0
    kept = sum(path.stat().st_size for path in work.rglob("*") if path.is_file())
    answer.put(
        Outcome(
            side,
            jobs,
            round(wall_s, 1),
            round(own.ru_utime + own.ru_stime + elsewhere_s, 1),
            round(memory_mib("VmHWM")),
            round(kept / 2**20),
            round(surface.cells["has a height"] / (surface.lines * surface.samples), 3),
            {stage: round(effort.cpu_s, 1) for stage, effort in surface.effort.items()},
        )
    )


def outcome(side: int, jobs: int) -> Outcome:
    """The figures of one size, in processes of their own."""
    context = multiprocessing.get_context("spawn")
    with open_folder() as folder:
        writer = context.Process(target=write_images, args=(folder, side))
        writer.start()
        writer.join()
        answer: multiprocessing.Queue[Outcome] = context.Queue()
        maker = context.Process(target=measure, args=(folder, side, jobs, answer))
        maker.start()
        maker.join()
        if maker.exitcode != 0:
            raise SystemExit(f"{side} px: the process ended with {maker.exitcode}")
        return answer.get()


def main() -> None:
    """Measure the given sizes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sides", type=int, nargs="+", default=[2500, 5000])
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    outcomes = []
    for side in arguments.sides:
        outcomes.append(outcome(side, arguments.jobs))
        print(outcomes[-1], flush=True)
        keep("surface_scale", [asdict(one) for one in outcomes])
    columns = {
        "px": lambda one: f"{one.side_px:,}",
        "wall s": lambda one: one.wall_s,
        "CPU s": lambda one: one.cpu_s,
        "CPU s/Mpx": lambda one: f"{one.cpu_s / one.side_px**2 * 1e6:.2f}",
        "memory MiB": lambda one: one.memory_mib,
        "work MiB": lambda one: one.work_mib,
        "found": lambda one: one.found,
    }
    print_table("Surfaces of simulated pairs", outcomes, columns)


if __name__ == "__main__":
    main()
