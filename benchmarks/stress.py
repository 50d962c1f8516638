"""Success rate of registration under difficult conditions, and honesty of the stated accuracy.

Scenes of twelve simulated worlds, from 0.2 m to 20 m, in families. *Ordinary* scenes vary in all factors
that make registration difficult: a few factors over their whole range, the others mildly; ten more have
the conditions that SRP is described by. *Damaged* scenes have missing and saturated pixels, and each is
registered without them too. *Points* have correlated errors, offsets between blocks, errors of the
frame's height and distorted blocks. *Sensor* scenes have a blur, seams between detectors and a terrain
that nothing knows. Scenes of seven more families, *jitter*, *bow*, *steps*, *moved*, *wrong_model*,
*otherwise* and *parts*, are distorted in ways that their models do not say. Each result is compared with
the true sensor over the whole image, in the frame of the points and on the Earth.

Every scene follows from the seed and its number. The outcome of each scene is appended to a file. A
scene is not repeated as long as the sources are the same; blocks of points are reused until their files
are removed. Run: python -m benchmarks.stress [--family damaged] [--scenes 500] [--jobs 2]
"""

import argparse
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from amers.services.registration.options import RegistrationOptions
from benchmarks._campaign import Log, fingerprint, run_campaign
from benchmarks._distorted_tables import accused, by_kind, distorted_acceptance, show_distorted
from benchmarks._measuring import RESULTS, keep
from benchmarks._outcome import SOURCES, Outcome, Result, attempt
from benchmarks._scenes import keep_tiles, pixels_file, read_tiles
from benchmarks._stress_figure import draw_figure
from benchmarks._stress_tables import acceptance, by_factor, show, show_acceptance, summary
from benchmarks._trials import (
    DISTORTED,
    Trial,
    damaged_trial,
    distorted_trial,
    draw_trial,
    intact_trial,
    nominal_trial,
    points_trial,
    sensor_trial,
)
from benchmarks._worlds import NOMINAL, PLACES, Place, block_of

SEED = 1
OPTIONS = RegistrationOptions(max_points=120)
NOMINAL_OPTIONS = RegistrationOptions()

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


def main() -> None:
    """Run the missing scenes, print the tables, write the results, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--family", choices=[*FAMILIES, "all"], default="ordinary")
    parser.add_argument("--scenes", type=int, help="of each family; by default what `FAMILIES` says")
    parser.add_argument("--nominal", type=int, default=10, help="scenes in nominal conditions")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--jobs", type=int, default=1, help="processes; each has its own worlds")
    parser.add_argument(
        "--folder", type=Path, default=RESULTS / "stress", help="outcomes and blocks of earlier runs"
    )
    parser.add_argument("--any-code", action="store_true", help="include outcomes of older sources")
    arguments = parser.parse_args()
    folder, seed = arguments.folder, arguments.seed
    folder.mkdir(parents=True, exist_ok=True)
    families = list(FAMILIES) if arguments.family == "all" else [arguments.family]
    wanted = [("nominal", number) for number in range(arguments.nominal) if "ordinary" in families]
    for name in families:
        count = FAMILIES[name].scenes if arguments.scenes is None else arguments.scenes
        wanted += [(kind, number) for kind in FAMILIES[name].kinds for number in range(count)]
    outcomes = run_campaign(
        {name_of(scene): scene for scene in wanted},
        partial(run, seed=seed, folder=folder),
        jobs=arguments.jobs,
        stratum=place_of,
        log=stress_log(folder / f"outcomes_{seed}.jsonl", arguments.any_code),
    )
    of_kind: dict[str, list[Result]] = {}
    for scene in wanted:
        of_kind.setdefault(scene[0], []).append(outcomes[name_of(scene)])
    for name in families:
        report(name, of_kind)


def stress_log(file: Path, any_code: bool = False) -> Log[Result]:
    """The outcomes in a file."""
    return Log(file, (Trial, Outcome), fingerprint("services", *SOURCES), any_code)


def name_of(scene: Scene) -> str:
    """The name by which the outcome of a scene is kept."""
    return f"{scene[0]}_{scene[1]:05d}"


def place_of(scene: Scene) -> Place:
    """The world of a scene."""
    kind, number = scene
    return NOMINAL if kind == "nominal" else PLACES[number % len(PLACES)]


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


def report(family: str, of_kind: dict[str, list[Result]]) -> None:
    """Print and keep what a family shows."""
    factors, kinds = FAMILIES[family].factors, FAMILIES[family].kinds
    results = of_kind[kinds[-1]]
    nominal = of_kind.get("nominal", []) if family == "ordinary" else []
    intact = of_kind["intact"] if "intact" in kinds else []
    rows = [("all", results), ("nominal", nominal), ("intact", intact)]
    show(family, [(name, part) for name, part in rows if part], results, factors)
    lines = acceptance(results, nominal, intact)
    kinds_of = {}
    if family in DISTORTED:
        kinds_of = by_kind(family, [(trial.distortion, outcome) for trial, outcome in results])
        show_distorted(f"distortions: {family}", kinds_of)
        lines += distorted_acceptance(family, [outcome for _, outcome in results])
    else:
        lines.append(accused([outcome for _, outcome in results]))
    show_acceptance(lines)
    name = "stress" if family == "ordinary" else f"stress_{family}"
    keep(
        name,
        {
            "summary": summary(results),
            **({"nominal": summary(nominal)} if nominal else {}),
            **({"intact": summary(intact)} if intact else {}),
            "acceptance": [
                {"requirement": requirement, "holds": holds, "figures": figures}
                for requirement, holds, figures in lines
            ],
            "factors": by_factor(results, factors),
            **({"distortions": {k: asdict(v) for k, v in kinds_of.items()}} if kinds_of else {}),
        },
    )
    draw_figure(results, factors, RESULTS / f"{name}.png")


if __name__ == "__main__":
    main()
