"""The families of scenes of a campaign, and the outcome of each scene, kept as soon as it is known."""

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.managers import SyncManager
from pathlib import Path
from queue import Empty, Queue

import cv2

from amers.services.registration.options import RegistrationOptions
from benchmarks._campaign import Outcome, attempt
from benchmarks._distorted_trials import DISTORTED, distorted_trial
from benchmarks._distortions import Drawn
from benchmarks._kept_pixels import keep_tiles, pixels_file, read_tiles
from benchmarks._trials import (
    Trial,
    damaged_trial,
    draw_trial,
    intact_trial,
    nominal_trial,
    points_trial,
    sensor_trial,
)
from benchmarks._worlds import NOMINAL, PLACES, Place, block_of

ROOT = Path(__file__).parent.parent
OPTIONS = RegistrationOptions(max_points=120)
NOMINAL_OPTIONS = RegistrationOptions()

Result = tuple[Trial, Outcome]
Scene = tuple[str, int]
"""Kind and number of a scene: they and the seed determine it."""


@dataclass(frozen=True)
class Family:
    """Scenes that are difficult in one way.

    Attributes:
        kinds: of its scenes; each number is a scene of every kind, so that kinds can be compared.
        scenes: how many numbers a campaign has.
        factors: edges of the classes in which each factor is reported.
    """

    kinds: tuple[str, ...]
    scenes: int
    factors: dict[str, tuple[float, ...]]


DRAWS: dict[str, Callable[[int, int], Trial]] = {
    "trial": draw_trial,
    "nominal": nominal_trial,
    "damaged": damaged_trial,
    "intact": intact_trial,
    "points": points_trial,
    "sensor": sensor_trial,
    **{family: partial(distorted_trial, family) for family in DISTORTED},
}
_POINTS = {"point_ce90_m": (0.5, 1.5, 3.0, 5.0), "incidence_deg": (0.0, 10.0, 20.0, 35.1)}
_OTHERWISE = {"chip_ratio": (0.1, 0.5, 2.5, 10.0), "point_ce90_m": (0.5, 1.5, 3.0, 5.0)}
FAMILIES = {
    "ordinary": Family(
        ("trial",),
        500,
        {
            "chip_ratio": (0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0),
            "location_error_m": (1.0, 10.0, 50.0, 200.0, 2_000.0),
            "drift_px": (0.0, 1.0, 3.0, 6.0),
            "noise": (0.0, 15.0, 50.0, 120.0),
            "haze": (0.0, 0.2, 0.5, 0.85),
            "cloud_cover": (0.0, 0.1, 0.4, 0.7),
            "inverted": (-0.5, 0.5, 1.5),
            "season": (0.0, 0.1, 0.5, 1.0),
            "vanished": (0.0, 0.1, 0.3, 0.5),
            "moved": (0.0, 0.1, 0.3, 0.5),
            "patterned_share": (-0.1, 0.1, 1.0),
            "relief_m": (0.0, 150.0, 500.0, 2_001.0),
            **_POINTS,
            "understated": (0.99, 1.01, 2.0, 3.0),
        },
    ),
    "damaged": Family(
        ("intact", "damaged"),
        200,
        {
            "damaged": (1e-5, 1e-4, 1e-3, 1e-2, 0.0501),
            "bits": (8, 9, 11, 12, 13, 17),
            "patch_px": (1, 2, 8, 24, 65),
            "missing": (0.0, 0.01, 0.99, 1.01),
            "brightest": (-0.5, 0.5, 1.5),
        },
    ),
    "points": Family(
        ("points",),
        200,
        {
            "correlated": (0.0, 0.01, 0.65, 1.01),
            "correlation": (0.05, 0.1, 0.15, 0.2),
            "blocks": (0.5, 1.5, 2.5, 3.5),
            "frame_sigma_m": (0.3, 0.7, 1.5, 3.0),
            "frame_up_m": (0.5, 1.5, 5.0),
            "warped": (0.0, 0.01, 0.65, 1.01),
            **_POINTS,
        },
    ),
    "sensor": Family(
        ("sensor",),
        100,
        {
            "blur_px": (0.3, 0.65, 1.0),
            "smear_px": (0.3, 0.75, 1.2),
            "seam_px": (0.0, 0.01, 0.5, 1.0),
            "parts": (2, 5, 9),
            "terrain_m": (0.0, 0.01, 100.0, 1_000.0),
            "chip_ratio": (0.1, 0.5, 2.5, 10.0),
        },
    ),
    "jitter": Family(
        ("jitter",),
        140,
        {
            "distortion.amplitude_px": (0.2, 0.5, 1.0, 2.0, 6.01),
            "distortion.period_px": (100.0, 300.0, 1_000.0, 8_000.0),
            **_OTHERWISE,
        },
    ),
    "bow": Family(("bow",), 100, {"distortion.amplitude_px": (0.5, 1.0, 2.0, 4.0, 8.01), **_OTHERWISE}),
    "steps": Family(
        ("steps",),
        80,
        {"distortion.step_lines": (1, 3, 10, 30, 101), "distortion.steps": (1, 2, 4), **_OTHERWISE},
    ),
    "moved": Family(
        ("moved",),
        80,
        {
            "distortion.moved_share": (0.05, 0.15, 0.25, 0.4),
            "distortion.moved_m": (2.0, 5.0, 15.0, 40.0, 101.0),
            **_OTHERWISE,
        },
    ),
    "wrong_model": Family(
        ("wrong_model",), 60, {"distortion.tilt_deg": (0.0, 0.01, 8.0, 16.0, 25.1), **_OTHERWISE}
    ),
    "otherwise": Family(
        ("otherwise",), 60, {"distortion.amplitude_px": (0.2, 1.0, 2.0, 8.01), **_OTHERWISE}
    ),
    "parts": Family(
        ("parts",), 60, {"distortion.amplitude_px": (0.5, 1.0, 2.0, 4.0, 8.01), **_OTHERWISE}
    ),
}


def name_of(scene: Scene) -> str:
    """The name by which the outcome of a scene is kept."""
    return f"{scene[0]}_{scene[1]:05d}"


def place_of(scene: Scene) -> Place:
    """The world of a scene."""
    kind, number = scene
    return NOMINAL if kind == "nominal" else PLACES[number % len(PLACES)]


def fingerprint(*more: str) -> str:
    """A short hash of the sources that outcomes follow from, and of more modules of the benchmarks."""
    digest = hashlib.sha256()
    names = ("campaign", "distorted_trials", "distortions", "point_errors", "scenes", "trials", "worlds")
    drawn = [ROOT / "benchmarks" / f"_{name}.py" for name in (*names, *more)]
    for path in sorted((ROOT / "services").rglob("*.py")) + drawn:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def read_outcomes(file: Path, code: str | None) -> dict[str, Result]:
    """Outcomes by name, of the sources with a fingerprint, or of all when None; without broken lines."""
    outcomes: dict[str, Result] = {}
    for line in file.read_text().splitlines() if file.exists() else ():
        try:
            record = json.loads(line)
        except json.JSONDecodeError:
            continue
        if code in (None, record["code"]):
            drawn = Drawn(**record["trial"].pop("distortion", {}))
            trial = Trial(**record["trial"], distortion=drawn)
            outcomes[record["name"]] = trial, Outcome(**record["outcome"])
    return outcomes


def outcome_line(name: str, code: str, result: Result) -> str:
    """The line that keeps the outcome of a scene."""
    trial, outcome = (asdict(part) for part in result)
    return json.dumps({"name": name, "code": code, "trial": trial, "outcome": outcome}) + "\n"


def run(scene: Scene, seed: int, folder: Path) -> Result:
    """The trial and the outcome of one scene."""
    kind, number = scene
    place, trial = place_of(scene), DRAWS[kind](seed, number)
    options = NOMINAL_OPTIONS if kind == "nominal" else OPTIONS
    file = pixels_file(folder, f"{name_of(scene)}_{seed}")
    tiles = read_tiles(file)
    kept = len(tiles)
    outcome = attempt(place, trial, block_of(place, folder), seed, options, tiles=tiles)
    if len(tiles) > kept:
        keep_tiles(tiles, (place.lines, place.lines), file)
    return trial, outcome


def run_all(scenes: list[Scene], seed: int, folder: Path, jobs: int) -> Iterator[tuple[str, Result]]:
    """Yield names and results of scenes in the order in which they end; each world is made once.

    Args:
        scenes: any order; those of one place are run one after another, in one process.
        seed: of the campaign.
        folder: of the blocks.
        jobs: processes.
    """
    of_place: dict[str, list[Scene]] = defaultdict(list)
    for scene in sorted(scenes, key=lambda scene: scene[1]):
        of_place[place_of(scene).name].append(scene)
    if jobs == 1:
        for group in of_place.values():
            yield from ((name_of(scene), run(scene, seed, folder)) for scene in group)
        return
    context = get_context("spawn")
    with SyncManager(ctx=context) as manager, ProcessPoolExecutor(jobs, context) as pool:
        done: Queue[tuple[str, Result]] = manager.Queue()
        work = partial(_run_group, seed=seed, folder=folder, done=done)
        largest_first = sorted(of_place.values(), key=len, reverse=True)
        futures = [pool.submit(work, group) for group in largest_first]
        missing = len(scenes)
        while missing:
            try:
                yield done.get(timeout=1.0)
                missing -= 1
            except Empty:
                for future in futures:
                    if future.done():
                        future.result()


def _run_group(group: list[Scene], seed: int, folder: Path, done: "Queue[tuple[str, Result]]") -> None:
    cv2.setNumThreads(1)
    for scene in group:
        done.put((name_of(scene), run(scene, seed, folder)))
