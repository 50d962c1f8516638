"""Time and memory of registering scenes of growing size.

Scenes of 0.5 m are simulated, delivered 50 m wrong and with a drift of 2 px, and written as tiled,
compressed GeoTIFF with RPC tags. The block is made once, from two views of 1.5 m of other days and
directions whose models are true: points anywhere on the ground are measured on chips in both and
intersected, and keep the covariance of the intersection; each has chips of 2 m and 20 m from both views.
Points lie densest in the middle, so that every scene has as many as are tried.

All of that is made in a process of its own. Each registration runs in another one, from the files, and
tells its CPU time (imports left out, all threads) and the peak of its resident memory, with what it had
before it began beside it. The smallest scene is registered once more before, uncounted: it compiles.
CE90 is that of a grid of 25 x 25 places of the image, between where the registered model locates them
and what they truly show. Run: python -m benchmarks.registration [--largest 5000]
"""

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import TypeVar

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks._measuring import keep
from benchmarks._simulated import lay_points, write_view
from services.errors import ComputationError
from services.formats.block import FolderChips, read_block, write_block
from services.formats.block_json import BlockMetadata, BlockSpecification, Provenance
from services.formats.raster import open_raster
from services.formats.scenes import read_scene
from services.geodesy import metres_per_degree
from services.quality.accuracy import accuracy
from services.registration import register_scene
from services.scene import Scene
from services.sensors.correction import CorrectedModel, ImageCorrection
from services.simulation.render import surface_seen
from services.simulation.view import ViewPlan, plan_geometry
from services.simulation.world import World, make_world
from services.types import Array

SIZES = (2_500, 5_000, 10_000, 20_000)
GSD_M = 0.5
CHIP_GSDS_M = (2.0, 20.0)
REFERENCE_GSD_M = 1.5
REFERENCE_MARGIN_M = 1_300.0
REFERENCES = (
    (12.0, 100.0, datetime(2024, 5, 28, 10, 25, tzinfo=UTC)),
    (10.0, 290.0, datetime(2024, 7, 14, 10, 50, tzinfo=UTC)),
)
"""Incidence, azimuth and time of the views the block is made from."""
BORDER_M = 250.0
CANDIDATES_PER_SCENE = 1_000
ERROR_M = (30.0, -40.0)
DRIFT_PX = np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])
SIGMA_M = 25.0
SEED = 4

Made = TypeVar("Made")


@dataclass(frozen=True)
class Registered:
    """What one process tells of its registration."""

    correction: ImageCorrection
    tried: int
    active: int
    cpu_s: float
    wall_s: float
    start_mib: float
    peak_mib: float


@dataclass(frozen=True)
class Outcome:
    """The scene of one size: medians of the times, the largest of the peaks."""

    size_px: int
    file_mb: float
    cpu_s: float
    wall_s: float
    start_mib: float
    peak_mib: float
    tried: int
    active: int
    ce90_before_m: float
    ce90_m: float


@dataclass(frozen=True)
class Refused:
    """The scene of one size that was not registered, and why."""

    size_px: int
    reason: str


def main() -> None:
    """Make, measure, print, keep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--largest", type=int, default=max(SIZES), help="lines of the largest scene")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    sizes = [size for size in SIZES if size <= arguments.largest] or [arguments.largest]
    with tempfile.TemporaryDirectory(prefix="amers-bench-", dir="/tmp") as name:
        folder = Path(name)
        apart(make_all, folder, sizes)
        attempt(folder, sizes[0], 1)
        outcomes = [attempt(folder, size, arguments.repeats) for size in sizes]
    show(outcomes)
    keep("registration", [asdict(outcome) for outcome in outcomes])


def apart(work: Callable[..., Made], *arguments: object) -> Made:
    """Do a piece of work in a process that did nothing else before and ends after."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def make_all(folder: Path, sizes: list[int]) -> None:
    """The block and the scenes of one place, each scene with what some of its pixels truly show."""
    world = make_world(np.random.default_rng(SEED), size_m=2_000.0)
    make_block(folder, world, sizes)
    for size in sizes:
        plan = ViewPlan(
            f"scene_{size}",
            place(world),
            (size, size),
            GSD_M,
            incidence_deg=14.0,
            azimuth_deg=200.0,
            acquired_at=datetime(2024, 6, 20, 10, 40, tzinfo=UTC),
        )
        rng = np.random.default_rng([SEED, size])
        geometry = plan_geometry(world, plan, rng, ERROR_M, DRIFT_PX)
        write_view(scene_path(folder, size), world, geometry, geometry.delivered, rng)
        axis = np.linspace(0.0, size - 1.0, 25)
        line_sample = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
        shown = surface_seen(world, geometry.true_model, line_sample)
        np.savez(truth_path(folder, size), line_sample=line_sample, lon_lat_h=shown)


def make_block(folder: Path, world: World, sizes: list[int]) -> None:
    """A block whose points lie in the ground of every scene."""
    rng = np.random.default_rng(SEED)
    side_px = int((max(sizes) * GSD_M + 2.0 * REFERENCE_MARGIN_M) / REFERENCE_GSD_M)
    references = []
    for number, (incidence_deg, azimuth_deg, acquired_at) in enumerate(REFERENCES):
        plan = ViewPlan(
            f"reference_{number}",
            place(world),
            (side_px, side_px),
            REFERENCE_GSD_M,
            incidence_deg=incidence_deg,
            azimuth_deg=azimuth_deg,
            acquired_at=acquired_at,
        )
        geometry = plan_geometry(world, plan, rng)
        path = folder / f"{plan.image_id}.tif"
        write_view(path, world, geometry, geometry.rpc, rng)
        references.append(Scene(open_raster(path), geometry.rpc, geometry.acquisition, 0.0))
    east_m, north_m = metres_per_degree(float(world.centre_lon_lat[1]), 0.0)
    lon_lat = np.concatenate(
        [
            np.array(place(world))
            + rng.uniform(-0.5, 0.5, (CANDIDATES_PER_SCENE, 2))
            * (size * GSD_M - BORDER_M)
            / [east_m, north_m]
            for size in sizes
        ]
    )
    points, cut = lay_points(world, references, lon_lat, CHIP_GSDS_M)
    low, high = points.lon_lat_h[:, :2].min(axis=0), points.lon_lat_h[:, :2].max(axis=0)
    metadata = BlockMetadata(
        id="bench",
        version="1",
        title="Points of simulated ground",
        description="",
        license="",
        extent=np.array([low, [high[0], low[1]], high, [low[0], high[1]]]),
        created=datetime(2024, 7, 1, tzinfo=UTC),
        specification=BlockSpecification(CHIP_GSDS_M, len(REFERENCES)),
        provenance=Provenance(
            "benchmarks", "1", tuple(scene.acquisition.image_id for scene in references), {}
        ),
    )
    write_block(folder / "block", metadata, points, cut, {})


def place(world: World) -> tuple[float, float]:
    """Longitude and latitude of the middle of everything."""
    lon, lat = world.centre_lon_lat.tolist()
    return lon, lat


def scene_path(folder: Path, size: int) -> Path:
    """The scene of a size."""
    return folder / f"scene_{size}.tif"


def truth_path(folder: Path, size: int) -> Path:
    """What is true about the scene of a size."""
    return folder / f"truth_{size}.npz"


def register(folder: Path, size: int) -> Registered:
    """Register one scene from its file on the block in its folder, as a process of its own."""
    start_mib = memory_mib("VmRSS")
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    scene = read_scene(scene_path(folder, size), sigma_m=SIGMA_M)
    with FolderChips(folder / "block") as chips:
        registration = register_scene(scene, read_block(folder / "block").points, chips)
    measures = registration.measures
    return Registered(
        correction=registration.adjustment.correction,
        tried=int((measures.reason != "not_tried").sum()),
        active=int(measures.active.sum()),
        cpu_s=time.process_time() - cpu_s,
        wall_s=time.perf_counter() - wall_s,
        start_mib=start_mib,
        peak_mib=memory_mib("VmHWM"),
    )


def memory_mib(name: str) -> float:
    """Resident memory of this process, now (VmRSS) or at its highest (VmHWM).

    `getrusage` would tell the peak of the parent where that was higher: it survives `exec`.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024.0 for line in lines if line.startswith(f"{name}:"))


def attempt(folder: Path, size: int, repeats: int) -> Outcome | Refused:
    """Figures of one scene, or why there are none: a refusal is a result, too."""
    try:
        return measure(folder, size, repeats)
    except ComputationError as error:
        return Refused(size, str(error))


def measure(folder: Path, size: int, repeats: int) -> Outcome:
    """Register one scene some times, and hold the result against the truth."""
    runs = [apart(register, folder, size) for _ in range(repeats)]
    scene = read_scene(scene_path(folder, size), sigma_m=SIGMA_M)
    with np.load(truth_path(folder, size)) as truth:
        line_sample, shown = truth["line_sample"], truth["lon_lat_h"]
    refined = CorrectedModel(scene.model, runs[0].correction)
    return Outcome(
        size_px=size,
        file_mb=scene_path(folder, size).stat().st_size / 1e6,
        cpu_s=median(run.cpu_s for run in runs),
        wall_s=median(run.wall_s for run in runs),
        start_mib=max(run.start_mib for run in runs),
        peak_mib=max(run.peak_mib for run in runs),
        tried=runs[0].tried,
        active=runs[0].active,
        ce90_before_m=ce90_m(scene.model.locate(line_sample, shown[:, 2]), shown),
        ce90_m=ce90_m(refined.locate(line_sample, shown[:, 2]), shown),
    )


def ce90_m(found: Array, true: Array) -> float:
    """CE90 of ground positions against true ones."""
    east_north = [
        (a[:2] - b[:2]) * metres_per_degree(float(b[1]), float(b[2]))
        for a, b in zip(found, true, strict=True)
    ]
    return accuracy(np.array(east_north)).ce90_m.value


def show(outcomes: list[Outcome | Refused]) -> None:
    """Print the table."""
    table = Table(
        "lines x samples",
        "file",
        "CPU",
        "wall",
        "memory before",
        "peak",
        "tried",
        "active",
        "CE90 before",
        "after",
        title="registration of one scene",
    )
    for o in outcomes:
        if isinstance(o, Refused):
            continue
        table.add_row(
            f"{o.size_px:,}²",
            f"{o.file_mb:.0f} MB",
            f"{o.cpu_s:.1f} s",
            f"{o.wall_s:.1f} s",
            f"{o.start_mib:.0f} MiB",
            f"{o.peak_mib:.0f} MiB",
            str(o.tried),
            str(o.active),
            f"{o.ce90_before_m:.1f} m",
            f"{o.ce90_m:.2f} m",
        )
    console = Console(width=105)
    console.print(table)
    for o in outcomes:
        if isinstance(o, Refused):
            console.print(f"{o.size_px:,}² was not registered: {o.reason}")


if __name__ == "__main__":
    main()
