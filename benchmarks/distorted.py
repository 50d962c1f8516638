"""Crops of real Pléiades views, distorted as scanners and archives do, registered and judged by ties.

Points are made from the other views of a place by the production of the project; a scene is a crop of
the view left over, distorted by a known map and delivered with a model that is 5 to 30 m off. What each
of its pixels shows is known from features matched without any model, smoothed to about a tenth of a
pixel, and from the exact map. Clean crops must not be told to lack fit.

Where a place has three views, the scene is kept apart from its points. Those of a pair were measured in
the scene itself, too, and lie where it shows them: errors are far smaller than stated there, and say
nothing of whether what is stated is true.

Needs the real images named by AMERS_REAL_DATA. Outcomes are appended to a file; a scene is not repeated
as long as the sources are the same. Run: python -m benchmarks.distorted [--scenes 9 | --name steps_0003]
"""

import argparse
import os
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path

from rich.console import Console

from benchmarks._campaign import Log, fingerprint, run_campaign
from benchmarks._distorted_tables import (
    Distorted,
    accused,
    by_kind,
    distorted_acceptance,
    figures_of,
    show_distorted,
)
from benchmarks._measuring import RESULTS, keep
from benchmarks._outcome import SOURCES, Outcome
from benchmarks._real_distorted import (
    CLEAN,
    SCENES,
    RealScene,
    Result,
    name_of,
    run_real,
    view_of,
)
from benchmarks._real_views import is_kept_apart
from benchmarks._stress_tables import NORMALISED, show_acceptance

SEED = 1
KEPT_APART = "kept apart"


def main() -> None:
    """Run the missing scenes, print the tables, write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--family", choices=[*SCENES, "all"], default="all")
    parser.add_argument("--scenes", type=int, help="of each family; by default 288 in all")
    parser.add_argument("--name", help="of a single scene, as family_0003")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--folder", type=Path, default=RESULTS / "distorted", help="of the outcomes")
    parser.add_argument("--any-code", action="store_true", help="include outcomes of older sources")
    arguments = parser.parse_args()
    folder = os.environ.get("AMERS_REAL_DATA")
    if not folder:
        sys.exit("AMERS_REAL_DATA is not set: name the folder of the real images")
    arguments.folder.mkdir(parents=True, exist_ok=True)
    families = list(SCENES) if arguments.family == "all" else [arguments.family]
    names = {
        family: [name_of(family, number) for number in range(arguments.scenes or SCENES[family])]
        for family in families
    }
    if arguments.name:
        names = {arguments.name.rsplit("_", 1)[0]: [arguments.name]}
    outcomes = run_campaign(
        {name: name for some in names.values() for name in some},
        partial(run_real, seed=arguments.seed, real_data=Path(folder)),
        stratum=view_of,
        log=distorted_log(arguments.folder / f"outcomes_{arguments.seed}.jsonl", arguments.any_code),
        say=_tell,
    )
    kept = {family: _report(family, [outcomes[n] for n in some]) for family, some in names.items()}
    if not arguments.name:
        keep("distorted", kept)


def distorted_log(file: Path, any_code: bool = False) -> Log[Result]:
    """The outcomes in a file."""
    code = fingerprint("services", *SOURCES, "real_views", "real_distorted")
    return Log(file, (RealScene, Outcome), code, any_code)


def _tell(name: str, result: Result) -> None:
    """Print the outcome of a scene."""
    scene, outcome = result
    Console(width=200).print(
        f"{name} {scene.view} {scene.drawn.kind or CLEAN}: {outcome.verdict}, "
        f"CE90 {outcome.ce90_m:.2f} m, {outcome.predicted_m:.2f} m predicted, "
        f"{outcome.wrong_share:.0%} wrong, {outcome.active} active; {outcome.reason}",
        highlight=False,
    )


def _report(family: str, results: list[Result]) -> dict[str, object]:
    """Print and return what a family shows."""
    rows = by_kind(family, [(scene.drawn, outcome) for scene, outcome in results])
    for words, is_apart in ((KEPT_APART, True), ("measured in it", False)):
        some = [outcome for scene, outcome in results if is_kept_apart(scene.view) == is_apart]
        rows[words] = figures_of(family, some)
    show_distorted(f"real crops, distorted: {family}", rows)
    lines = _acceptance(rows["all"], rows[KEPT_APART])
    of_all = [outcome for _, outcome in results]
    lines += [accused(of_all)] if family == CLEAN else distorted_acceptance(family, of_all)
    show_acceptance(lines)
    return {
        "kinds": {kind: asdict(row) for kind, row in rows.items()},
        "acceptance": [
            {"requirement": requirement, "holds": holds, "figures": figures}
            for requirement, holds, figures in lines
        ],
    }


def _acceptance(figures: Distorted, apart: Distorted) -> list[tuple[str, bool, str]]:
    """What a family must show on real images, and those of its scenes that are kept apart."""
    low, high = NORMALISED
    return [
        (
            "none delivered is wrong by more than 3 times its predicted CE90",
            figures.wrong == 0,
            f"{figures.wrong} wrong; true over predicted: median {figures.of_predicted[0]:.2f}, "
            f"largest {figures.of_predicted[1]:.2f}",
        ),
        (
            f"normalised errors {low:g} to {high:g}, views kept apart from their points",
            apart.good + apart.usable == 0 or low <= apart.normalised <= high,
            f"{apart.normalised:.2f} of {apart.good + apart.usable} delivered",
        ),
    ]


if __name__ == "__main__":
    main()
