"""Time, memory and profile of the registration of large scenes.

A scene of 0.5 m has a model with an error of 15 m and a drift of 2 px. It is a tiled, compressed
GeoTIFF with RPC tags. Only the surroundings of the points are rendered; one piece of them is repeated
in between, so that reading costs as much as in a whole image. The block has chips of 2 m from six views
of other days and directions with true models: points are measured on chips in all views, intersected,
and have the covariance of the intersection. 200 points are tried, each with its six views, in two fine
stages.

One process makes the data, and each registration runs in another process, from the files. The tables
report the CPU time (all threads, without imports) of the first registration of the process, which loads
compiled code, and the median of the following ones; the resident memory before and at its peak; and the
CPU time by stage, under a profiler. CE90 compares a grid of 25 x 25 places of the image, as the
registered model locates them, with the ground that the image truly shows there.
Run: python -m benchmarks.registration [--sizes 5000,40000]
"""

import argparse
import cProfile
import multiprocessing
import pstats
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import TypeVar

import numpy as np
import rasterio
from rasterio.windows import Window as RasterWindow
from rich.console import Console
from rich.table import Table

from amers.services.formats.block.document import BlockMetadata, BlockSpecification, Provenance
from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.raster import gdal_rpc
from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ImageSource, Window
from amers.services.matching.control_points import MatchingOptions
from amers.services.quality.accuracy import accuracy
from amers.services.registration.on_points import Registration, register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.correction import CorrectedModel, ImageCorrection
from amers.services.sensors.rpc import RpcModel
from amers.services.simulation.render import surface_seen
from amers.services.simulation.tiles import TiledView
from amers.services.simulation.view import ViewPlan, plan_geometry
from amers.services.simulation.world import World, make_world
from amers.services.types import Array, ControlPoints
from benchmarks._measuring import keep, memory_mib, open_folder
from benchmarks._simulated import lay_points

GSD_M = 0.5
CHIP_GSD_M = 2.0
REFERENCE_GSD_M = 2.0
REFERENCE_MARGIN_M = 600.0
REFERENCES = (
    (12.0, 100.0, datetime(2024, 5, 28, 10, 25, tzinfo=UTC)),
    (10.0, 290.0, datetime(2024, 7, 14, 10, 50, tzinfo=UTC)),
    (14.0, 190.0, datetime(2024, 6, 2, 10, 35, tzinfo=UTC)),
    (8.0, 20.0, datetime(2024, 6, 25, 10, 40, tzinfo=UTC)),
    (16.0, 240.0, datetime(2024, 7, 1, 10, 45, tzinfo=UTC)),
    (11.0, 330.0, datetime(2024, 6, 12, 10, 30, tzinfo=UTC)),
)
"""Incidence, azimuth and time of the views the block is made from."""
BORDER_M = 250.0
CANDIDATES_A_SIDE = 18
ERROR_M = (12.0, -9.0)
DRIFT_PX = np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])
SIGMA_M = 10.0
SEED = 4
BLOCK_PX = 256
FILL_SIDE = 4
"""Blocks of the texture that is repeated between the points, along each side."""

SIZES = (5_000, 40_000)
POINTS, VIEWS = 200, 6

STAGES = (
    ("reading the scene", "raster.py", "read", ""),
    ("rendering it as chips", "source.py", "render_chip", "reading the scene"),
    ("correlating", "correlate.py", "find_chip", ""),
    ("reading chips", "types.py", "point_chips", ""),
    ("combining views", "control_points.py", "_combined", ""),
    ("adjusting, also for the stability test", "image_correction.py", "adjust_scene", ""),
)
"""A stage, the file and the function whose time it is, and the stage within it that is subtracted."""

Made = TypeVar("Made")


@dataclass(frozen=True)
class Registered:
    """The measurements of one process about its registrations."""

    correction: ImageCorrection
    tried: int
    views: int
    agreed: int
    active: int
    verdict: str
    first_s: float
    again_s: float
    start_mib: float
    peak_mib: float
    stages_s: dict[str, float]


@dataclass(frozen=True)
class Outcome:
    """The measurements of the scene of one size."""

    size_px: int
    file_mb: float
    made_s: float
    first_s: float
    again_s: float
    start_mib: float
    peak_mib: float
    tried: int
    views: int
    agreed: int
    active: int
    verdict: str
    ce90_before_m: float
    ce90_m: float
    stages_s: dict[str, float]


def main() -> None:
    """Make the data, measure, print the tables, write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", default=",".join(map(str, SIZES)), help="lines of the scenes")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    outcomes = []
    for size in map(int, arguments.sizes.split(",")):
        with open_folder() as folder:
            outcomes.append(measure(folder, size, arguments.repeats))
    show(outcomes)
    keep("registration", {"scenes": [asdict(outcome) for outcome in outcomes]})


def apart(work: Callable[..., Made], *arguments: object) -> Made:
    """The result of a function, run in a new process that ends afterwards."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def measure(folder: Path, size: int, repeats: int) -> Outcome:
    """The measurements of a scene of some size, registered several times and compared with the truth."""
    made_s = apart(timed_make, folder, size)
    measured = apart(register_often, folder, repeats)
    scene = read_scene(folder / "scene.tif", sigma_m=SIGMA_M)
    with np.load(folder / "truth.npz") as truth:
        line_sample, shown = truth["line_sample"], truth["lon_lat_h"]
    refined = CorrectedModel(scene.model, measured.correction)
    figures = {name: value for name, value in vars(measured).items() if name != "correction"}
    return Outcome(
        size_px=size,
        file_mb=(folder / "scene.tif").stat().st_size / 1e6,
        made_s=made_s,
        ce90_before_m=ce90_m(scene.model.locate(line_sample, shown[:, 2]), shown),
        ce90_m=ce90_m(refined.locate(line_sample, shown[:, 2]), shown),
        **figures,
    )


def timed_make(folder: Path, size: int) -> float:
    """CPU time that a case takes to make, seconds."""
    make_case(folder, size)
    return time.process_time()


def register_often(folder: Path, repeats: int) -> Registered:
    """The measurements of registering the scene of a folder on its block, in this process."""
    start_mib = memory_mib("VmRSS")
    taken_s = []
    for _ in range(1 + repeats):
        start = time.process_time()
        registration = register(folder)
        taken_s.append(time.process_time() - start)
    peak_mib = memory_mib("VmHWM")
    profile = cProfile.Profile(time.process_time)
    profile.runcall(register, folder)
    measures = registration.measures
    return Registered(
        correction=registration.adjustment.correction,
        tried=int((measures.reason != "not_tried").sum()),
        views=len(registration.views.view),
        agreed=int(registration.views.agreed.sum()),
        active=int(measures.active.sum()),
        verdict=registration.qualification.verdict,
        first_s=taken_s[0],
        again_s=median(taken_s[1:]),
        start_mib=start_mib,
        peak_mib=peak_mib,
        stages_s=stages_s(profile),
    )


def register(folder: Path) -> Registration:
    """The registration of the scene of a folder."""
    scene = read_scene(folder / "scene.tif", sigma_m=SIGMA_M)
    options = RegistrationOptions(max_points=POINTS, matching=MatchingOptions(max_views=VIEWS))
    with FolderChips(folder / "block") as chips:
        return register_scene(scene, read_block(folder / "block").points, chips, options)


def stages_s(profile: cProfile.Profile) -> dict[str, float]:
    """CPU time of the stages and of the rest, seconds."""
    stats = pstats.Stats(profile)
    taken: dict[str, float] = {}
    for stage, file, function, within in STAGES:
        spent = sum(
            values[3]
            for (path, _, name), values in stats.stats.items()  # type: ignore[attr-defined]
            if name == function and path.endswith(f"/{file}")
        )
        taken[stage] = spent - taken.get(within, 0.0)
    taken["everything else"] = stats.total_tt - sum(taken.values())  # type: ignore[attr-defined]
    return taken


def ce90_m(located: Array, true: Array) -> float:
    """CE90 of ground positions against the truth, metres."""
    east_north = [
        (a[:2] - b[:2]) * metres_per_degree(float(b[1]), float(b[2]))
        for a, b in zip(located, true, strict=True)
    ]
    return accuracy(np.array(east_north)).ce90_m.value


def show(outcomes: list[Outcome]) -> None:
    """Print the tables."""
    table = Table("", *(f"{o.size_px:,}²" for o in outcomes), title="registration of one scene")
    for name, value_of in ROWS:
        table.add_row(name, *(value_of(o) for o in outcomes))
    profile = Table("profile", *(f"{o.size_px:,}²" for o in outcomes))
    for stage in outcomes[0].stages_s:
        shares = (o.stages_s[stage] / sum(o.stages_s.values()) for o in outcomes)
        profile.add_row(stage, *(f"{share:.0%}" for share in shares))
    console = Console(width=105)
    console.print(table)
    console.print(profile)


ROWS: tuple[tuple[str, Callable[[Outcome], str]], ...] = (
    ("file", lambda o: f"{o.file_mb:,.0f} MB"),
    ("made in", lambda o: f"{o.made_s:.0f} s"),
    ("CPU, first in its process", lambda o: f"{o.first_s:.2f} s"),
    ("CPU, again", lambda o: f"{o.again_s:.2f} s"),
    ("memory before", lambda o: f"{o.start_mib:.0f} MiB"),
    ("peak", lambda o: f"{o.peak_mib:.0f} MiB"),
    ("points tried", lambda o: str(o.tried)),
    ("views tried, in agreement, last stage", lambda o: f"{o.views}, {o.agreed}"),
    ("active", lambda o: str(o.active)),
    ("CE90 before", lambda o: f"{o.ce90_before_m:.1f} m"),
    ("CE90 after", lambda o: f"{o.ce90_m:.2f} m"),
    ("verdict", lambda o: o.verdict),
)


def make_case(folder: Path, size: int) -> None:
    """A block of points, a scene of a size that shows them, and what some of its pixels truly show."""
    world = make_world(np.random.default_rng(SEED), size_m=2_000.0)
    points = make_block(folder, world, size)
    plan = ViewPlan(
        f"scene_{size}",
        middle_of(world),
        (size, size),
        GSD_M,
        incidence_deg=14.0,
        azimuth_deg=200.0,
        acquired_at=datetime(2024, 6, 20, 10, 40, tzinfo=UTC),
    )
    geometry = plan_geometry(world, plan, np.random.default_rng([SEED, size]), ERROR_M, DRIFT_PX)
    # A chip, the search around it, its diagonal turned by the view, and what the low-pass needs.
    reach_px = int((1.25 * 50.0 * CHIP_GSD_M + 3.0 * np.hypot(SIGMA_M, 1.0) + 20.0) / GSD_M)
    write_around(
        folder / "scene.tif",
        TiledView(world, geometry, SEED),
        geometry.delivered,
        geometry.delivered.project(points.lon_lat_h),
        reach_px,
    )
    axis = np.linspace(0.0, size - 1.0, 25)
    line_sample = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    shown = surface_seen(world, geometry.true_model, line_sample)
    np.savez(folder / "truth.npz", line_sample=line_sample, lon_lat_h=shown)


def make_block(folder: Path, world: World, size: int) -> ControlPoints:
    """Points measured in six views whose models are true, well spread over the ground of a scene."""
    rng = np.random.default_rng(SEED)
    side_px = int((size * GSD_M + 2.0 * REFERENCE_MARGIN_M) / REFERENCE_GSD_M)
    references = []
    for number, (incidence_deg, azimuth_deg, acquired_at) in enumerate(REFERENCES):
        plan = ViewPlan(
            f"reference_{number}",
            middle_of(world),
            (side_px, side_px),
            REFERENCE_GSD_M,
            incidence_deg,
            azimuth_deg,
            acquired_at,
        )
        geometry = plan_geometry(world, plan, rng)
        image = TiledView(world, geometry, SEED + 1 + number)
        references.append(Scene(image, geometry.rpc, geometry.acquisition, 0.0))
    step = (np.arange(CANDIDATES_A_SIDE) + 0.5) / CANDIDATES_A_SIDE - 0.5
    grid = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    grid += rng.uniform(-0.3, 0.3, grid.shape) / CANDIDATES_A_SIDE
    metres = np.array(metres_per_degree(float(world.centre_lon_lat[1]), 0.0))
    lon_lat = world.centre_lon_lat + grid * (size * GSD_M - 2.0 * BORDER_M) / metres
    points, cut = lay_points(world, references, lon_lat, (CHIP_GSD_M,))
    low, high = points.lon_lat_h[:, :2].min(axis=0), points.lon_lat_h[:, :2].max(axis=0)
    metadata = BlockMetadata(
        id="bench",
        version="1",
        title="Points of simulated ground",
        description="",
        license="",
        extent=np.array([low, [high[0], low[1]], high, [low[0], high[1]]]),
        created=datetime(2024, 7, 1, tzinfo=UTC),
        specification=BlockSpecification((CHIP_GSD_M,), len(REFERENCES)),
        provenance=Provenance(
            "benchmarks", "1", tuple(scene.acquisition.image_id for scene in references), {}
        ),
    )
    write_block(folder / "block", metadata, points, cut, {})
    return points


def write_around(path: Path, image: ImageSource, model: RpcModel, places: Array, reach_px: int) -> None:
    """Write an image as a tiled, compressed GeoTIFF with RPC tags, true only around some places.

    Between them a piece of the image is repeated, so that every block costs what a block of an image
    costs, on disk and to read.

    Args:
        path: the file.
        image: what is rendered around the places.
        model: for the tags.
        places: (n, 2) line, sample.
        reach_px: how far around them, along lines and samples.
    """
    lines, samples = image.shape
    first = np.maximum(np.floor(places).astype(int) - reach_px, 0)
    last = np.minimum(np.ceil(places).astype(int) + reach_px + 1, image.shape)
    shown = (last > first).all(axis=1)
    first, last = first[shown], last[shown]
    side = FILL_SIDE * BLOCK_PX
    texture = image.read(Window(lines // 2, samples // 2, side, side)).astype(np.uint16)
    fill = np.tile(texture, (1, -(-samples // side)))[:, :samples]
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        height=lines,
        width=samples,
        count=1,
        dtype="uint16",
        tiled=True,
        blockxsize=BLOCK_PX,
        blockysize=BLOCK_PX,
        compress="deflate",
        predictor=2,
        BIGTIFF="IF_SAFER",
    ) as file:
        file.rpcs = gdal_rpc(model)
        for line in range(0, lines, BLOCK_PX):
            count = min(BLOCK_PX, lines - line)
            start = line % side
            strip = fill[start : start + count].copy()
            for k in np.flatnonzero((first[:, 0] < line + count) & (last[:, 0] > line)):
                top, bottom = max(first[k, 0], line), min(last[k, 0], line + count)
                left, right = (int(edge[k, 1]) for edge in (first, last))
                window = Window(int(top), left, int(bottom - top), right - left)
                strip[top - line : bottom - line, left:right] = image.read(window)
            file.write(strip, 1, window=RasterWindow(0, line, samples, count))


def middle_of(world: World) -> tuple[float, float]:
    """Longitude and latitude of the middle of everything."""
    lon, lat = world.centre_lon_lat.tolist()
    return lon, lat


if __name__ == "__main__":
    main()
