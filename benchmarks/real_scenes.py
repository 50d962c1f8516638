"""Real scenes registered on points of other dates and views, clean and with faults of their pixels.

Nine WorldView-3 dates of a town, each on blocks of six, three and two other dates; nine Pléiades views
of four places, whole and cropped. Models are 5 to 30 m off. What the scenes show is known by features
matched without any model, smoothed to about a tenth of a pixel. A scene is wrong when its true CE90 over
what it states to hold is more than 3 times the stated one, or a tenth of that area is.
Needs AMERS_REAL_DATA. Outcomes are appended to a file; a scene is not repeated as long as the sources
are the same.
Run: python -m benchmarks.real_scenes [--faults 415] [--clean 119] [--any-code]
"""

import argparse
import os
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.imagery.source import ArrayImage, Window
from amers.services.matching.predict import in_image
from amers.services.registration.on_points import Registration
from benchmarks._campaign import Log, fingerprint, run_campaign
from benchmarks._faulty_pixels import KINDS, Fault, drawn_fault
from benchmarks._measuring import RESULTS, print_table
from benchmarks._outcome import SOURCES, Outcome, outcome_of
from benchmarks._real_dates import PAIRS, TooFewTies, date_view
from benchmarks._real_distorted import LOCATION_M, OPTIONS
from benchmarks._real_views import VIEWS, RealView, real_view, rpc_of
from benchmarks._scenes import Truth

SEED = 1
CROPS = 5
"""Scenes of each Pléiades view: the whole one, and crops."""
FAULTS_OF_VIEW = 5
DATES = {pair.name: pair for pair in PAIRS}
UNJUDGED = "no truth"
VERDICTS = ("good", "usable", "failed", "refused", UNJUDGED)
_BESIDE_PX = 30.0
"""How far crops reach beyond the points of their view."""
_KEY = 43


@dataclass(frozen=True)
class RealTrial:
    """One scene.

    Attributes:
        view: of the image, and of the points where they are of other dates.
        number: of the trial of this view; 0 is the whole image.
        fault: of its pixels.
    """

    view: str
    number: int
    fault: Fault

    @property
    def name(self) -> str:
        """For outcomes."""
        what = f"{self.fault.kind}_{self.fault.amount}_{self.fault.at:g}" if self.fault.kind else "clean"
        return f"{self.view}_{self.number}_{what}"


Result = tuple[RealTrial, Outcome]


def clean_trials() -> list[RealTrial]:
    """All scenes without faults: dates first."""
    return [
        *(RealTrial(view, 0, Fault()) for view in DATES),
        *(RealTrial(view, number, Fault()) for number in range(CROPS) for view in VIEWS),
    ]


def faulty_trials() -> list[RealTrial]:
    """Scenes with faults, of every view: the kinds take turns."""
    kinds, out = list(KINDS), []
    for number in range(FAULTS_OF_VIEW):
        for k, view in enumerate((*VIEWS, *DATES)):
            rng = np.random.default_rng([SEED, number, k, _KEY])
            kind = kinds[(k + number * 3) % len(kinds)]
            out.append(RealTrial(view, 0, drawn_fault(rng, kind)))
    return out


def register_trial(trial: RealTrial, view: RealView) -> tuple[Outcome, Registration | None]:
    """The outcome of a scene, and its registration."""
    rng = np.random.default_rng([SEED, trial.number, len(trial.view), sum(map(ord, trial.view)), _KEY])
    shape = view.scene.image.shape
    corner = np.zeros(2)
    if trial.number:
        # Around the points: views have borders without pixels.
        first = np.clip(view.placed.min(axis=0) - _BESIDE_PX, 0.0, None)
        last = np.minimum(view.placed.max(axis=0) + _BESIDE_PX, shape) - view.crop
        corner = np.floor(rng.uniform(first, np.maximum(first, last)))
        shape = (min(view.crop, shape[0]), min(view.crop, shape[1]))
    window = Window(int(corner[0]), int(corner[1]), *shape)
    pixels = trial.fault.pixels(view.scene.image.read(window))
    error_m, towards = rng.uniform(*LOCATION_M), rng.uniform(0.0, 2.0 * np.pi)
    shift_px = error_m / scene_gsd_m(view.scene) * np.array([np.sin(towards), np.cos(towards)])
    model = rpc_of(view.scene.model)
    model = replace(model, image_offset=model.image_offset - corner + shift_px)
    scene = Scene(
        ArrayImage(pixels), model, view.scene.acquisition, float(error_m / rng.uniform(1.2, 2.6))
    )
    line_sample = trial.fault.shown(view.line_sample - corner, shape)
    line_sample[~in_image(line_sample, pixels.shape, -2.0)] = np.nan
    shown = np.isfinite(line_sample).all(axis=1)
    ground = view.ground[shown]
    seen = int(in_image(view.placed - corner, shape, 0.0).sum())
    truth = Truth(line_sample[shown], ground, lambda used: ground, 1.0, seen, np.inf)
    return outcome_of(scene, view.block.points, view.block, OPTIONS, truth)


def run_trial(trial: RealTrial, real_data: Path) -> Result:
    """A scene and its outcome."""
    try:
        view = view_named(trial.view, real_data)
    except TooFewTies as error:
        return trial, Outcome(UNJUDGED, str(error), 0, 0, 0, "", *[np.nan] * 8)
    return trial, register_trial(trial, view)[0]


def view_named(name: str, real_data: Path) -> RealView:
    """A view of a date or of a place."""
    return date_view(real_data, DATES[name]) if name in DATES else real_view(real_data, name)


def main() -> None:
    """Run the missing scenes and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clean", type=int, default=len(clean_trials()), help="scenes")
    parser.add_argument("--faults", type=int, default=len(faulty_trials()), help="scenes")
    parser.add_argument("--kind", choices=KINDS, help="of the faults")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=RESULTS / "real_scenes", help="of the outcomes")
    parser.add_argument("--any-code", action="store_true", help="include outcomes of older sources")
    arguments = parser.parse_args()
    folder = os.environ.get("AMERS_REAL_DATA")
    if not folder:
        sys.exit("AMERS_REAL_DATA is not set: name the folder of the real images")
    arguments.folder.mkdir(parents=True, exist_ok=True)
    faulty = [one for one in faulty_trials() if arguments.kind in (None, one.fault.kind)]
    trials = [*_spread(clean_trials(), arguments.clean), *_spread(faulty, arguments.faults)]
    code = fingerprint("services", *SOURCES, "real_views", "real_dates", "faulty_pixels")
    results = run_campaign(
        {one.name: one for one in trials},
        partial(run_trial, real_data=Path(folder)),
        jobs=arguments.jobs,
        stratum=lambda trial: trial.view,
        log=Log(arguments.folder / "outcomes.jsonl", (RealTrial, Outcome), code, arguments.any_code),
        say=_tell,
    )
    _show(results.values())


def _spread(trials: list[RealTrial], count: int) -> list[RealTrial]:
    """So many of the trials, evenly."""
    rows = np.unique(np.linspace(0, len(trials) - 1, min(count, len(trials))).astype(int))
    return [trials[row] for row in rows.tolist()] if count else []


def _tell(name: str, result: Result) -> None:
    outcome = result[1]
    print(
        f"{name}: {outcome.verdict}{' WRONG' * is_wrong(outcome)}, true {outcome.ce90_m:.2f} m, "
        f"stated {outcome.predicted_m:.2f} m, {outcome.wrong_share:.0%} wrong, {outcome.active} of "
        f"{outcome.matched} of {outcome.visible}, {outcome.held_percent:.0f} % held; "
        f"{outcome.reason[:90]}",
        flush=True,
    )


def is_wrong(outcome: Outcome) -> bool:
    """Whether a scene is delivered and wrong, or wrong in part."""
    return outcome.delivered and (outcome.wrong or outcome.wrong_in_part)


@dataclass(frozen=True)
class Row:
    """What the scenes of a kind came to."""

    kind: str
    outcomes: list[Outcome]

    def count(self, verdict: str) -> int:
        """Scenes of a verdict."""
        return sum(one.verdict == verdict for one in self.outcomes)

    @property
    def wrong(self) -> int:
        """Scenes that are delivered and wrong."""
        return sum(map(is_wrong, self.outcomes))

    @property
    def of_stated(self) -> list[float]:
        """True over stated CE90 of those delivered."""
        return [one.ce90_m / one.predicted_m for one in self.outcomes if one.delivered] or [np.nan]

    @property
    def normalised(self) -> float:
        """Mean square of the true errors over the stated ones, of those delivered."""
        return float(np.mean([one.normalised for one in self.outcomes if one.delivered] or [np.nan]))


def _show(results: Iterable[Result]) -> None:
    """A row for every kind."""
    of_kind: dict[str, list[Outcome]] = {}
    for trial, outcome in results:
        place = "dates" if trial.view in DATES else "views"
        of_kind.setdefault(trial.fault.kind or f"clean, {place}", []).append(outcome)
    verdicts = {one: partial(lambda verdict, row: row.count(verdict), one) for one in VERDICTS}
    print_table(
        "real scenes",
        [Row(kind, some) for kind, some in of_kind.items()],
        {
            "kind": lambda row: row.kind,
            "scenes": lambda row: len(row.outcomes),
            **verdicts,
            "wrong": lambda row: row.wrong,
            "true / stated": lambda row: f"{np.median(row.of_stated):.2f}",
            "largest": lambda row: f"{np.max(row.of_stated):.2f}",
            "normalised": lambda row: f"{row.normalised:.2f}",
            "CPU s": lambda row: f"{np.mean([one.cpu_s for one in row.outcomes]):.2f}",
        },
    )


if __name__ == "__main__":
    main()
