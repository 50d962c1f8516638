"""Time, memory and profile of the registration of large scenes, with AROSICS for comparison.

A scene of 0.5 m has a model with an error of 15 m and a drift of 2 px. It is a tiled, compressed
GeoTIFF with RPC tags. Only the surroundings of the points are rendered; one piece of them is repeated
in between, so that reading costs as much as in a whole image. The block has chips of 2 m from six views
of other days
and directions with true models: points are measured on chips in all views, intersected, and have the
covariance of the intersection. 200 points are tried, each with its six views, in two fine stages.

One process makes the data, and each registration runs in another process, from the files. The tables
report the CPU time (all threads, without imports) of the first registration of the process, which loads
compiled code, and the median of the following ones; the resident memory before and at its peak; and the
CPU time by stage, under a profiler. CE90 compares a grid of 25 x 25 places of the image, as the
registered model locates them, with the ground that the image truly shows there.

With an interpreter that has AROSICS, its local co-registration finds tie points in an ortho pair of
simulated ground, on a grid as dense as the places of a registration on a reference image. The errors of
the accepted tie points are those against the simulated shift.
Run: python -m benchmarks.registration [--sizes 5000,40000] [--arosics PYTHON]
"""

import argparse
import cProfile
import math
import multiprocessing
import pstats
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TypeVar

import numpy as np
from rich.console import Console
from rich.table import Table

from amers.services.formats.block.reader import FolderChips, read_block
from amers.services.formats.images.scenes import read_scene
from amers.services.geodesy import metres_per_degree
from amers.services.matching.control_points import MatchingOptions
from amers.services.quality.accuracy import accuracy
from amers.services.registration.on_points import Registration, register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.correction import CorrectedModel, ImageCorrection
from amers.services.types import Array
from benchmarks._beside_arosics import TiePoints, find_tie_points, make_pair, register_pair
from benchmarks._large_scene import SIGMA_M, make_case
from benchmarks._measuring import keep, memory_mib

SIZES = (5_000, 40_000)
POINTS, VIEWS = 200, 6
PAIR_SIZE = 5_000

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
    parser.add_argument("--arosics", metavar="PYTHON", help="an interpreter that has AROSICS")
    arguments = parser.parse_args()
    outcomes = []
    for size in map(int, arguments.sizes.split(",")):
        with tempfile.TemporaryDirectory(prefix="amers-bench-", dir="/tmp") as name:
            outcomes.append(measure(Path(name), size, arguments.repeats))
    show(outcomes)
    results: dict[str, object] = {"scenes": [asdict(outcome) for outcome in outcomes]}
    if arguments.arosics is None:
        print("AROSICS was not run: name an interpreter that has it with --arosics")
    else:
        with tempfile.TemporaryDirectory(prefix="amers-bench-", dir="/tmp") as name:
            apart(make_pair, Path(name), PAIR_SIZE)
            ours = apart(register_pair, Path(name), arguments.repeats)
            theirs = find_tie_points(arguments.arosics, Path(name), PAIR_SIZE)
        show_beside(outcomes, ours, theirs)
        results |= {"pair": asdict(ours), "pair_arosics": asdict(theirs)}
    keep("registration", results)


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


def show_beside(scenes: list[Outcome], ours: TiePoints, theirs: TiePoints) -> None:
    """Print the ortho pair by both, and the time of a point of the scenes and of AROSICS."""
    pair = Table(
        "",
        "AROSICS",
        "Amers",
        title=f"tie points of one ortho pair of {PAIR_SIZE:,}² px",
        caption="errors of the accepted tie points against the simulated shift",
    )
    for name, value_of in PAIR_ROWS:
        pair.add_row(name, value_of(theirs), value_of(ours))
    each_s = theirs.cpu_s / theirs.accepted
    ours_s = (ours.cpu_s / ours.accepted, ours.again_s / ours.accepted)
    pair.add_row(
        "AROSICS takes", "", " … ".join(f"{each_s / own:.1f}" for own in ours_s) + " times as long"
    )
    table = Table("of a scene", "found", "CPU", "CPU each", "a tie point of AROSICS takes")
    for scene in scenes:
        for what, count in (("views", scene.agreed), (f"points of {VIEWS} views", scene.active)):
            own_s = scene.again_s / max(count, 1)
            table.add_row(
                f"{what}, {scene.size_px:,}²",
                str(count),
                f"{scene.again_s:.1f} s",
                f"{1e3 * own_s:.1f} ms",
                f"{each_s / own_s:.1f} times as long",
            )
    console = Console(width=105)
    console.print(pair)
    console.print(table)


PAIR_ROWS: tuple[tuple[str, Callable[[TiePoints], str]], ...] = (
    ("tried", lambda t: str(t.tried)),
    ("accepted", lambda t: str(t.accepted)),
    ("CPU, first in its process", lambda t: f"{t.cpu_s:.2f} s"),
    ("CPU, again", lambda t: "not run" if math.isnan(t.again_s) else f"{t.again_s:.2f} s"),
    ("CPU for each accepted", lambda t: f"{1e3 * t.cpu_s / max(t.accepted, 1):.1f} ms"),
    ("memory before", lambda t: f"{t.start_mib:.0f} MiB"),
    ("peak", lambda t: f"{t.peak_mib:.0f} MiB"),
    ("error of the median shift", lambda t: f"{t.errors.shift_px:.4f} px"),
    ("error of one, median", lambda t: f"{t.errors.median_px:.4f} px"),
    ("error of one, root mean square", lambda t: f"{t.errors.rms_px:.4f} px"),
)


if __name__ == "__main__":
    main()
