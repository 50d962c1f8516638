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
from dataclasses import asdict
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from benchmarks._distorted_tables import accused, by_kind, distorted_acceptance, show_distorted
from benchmarks._distorted_trials import DISTORTED
from benchmarks._families import (
    FAMILIES,
    Result,
    Scene,
    fingerprint,
    name_of,
    outcome_line,
    read_outcomes,
    run_all,
)
from benchmarks._measuring import RESULTS, keep
from benchmarks._stress_figure import draw_figure
from benchmarks._stress_tables import acceptance, by_factor, show, show_acceptance, summary

SEED = 1


def main() -> None:
    """Run the missing scenes, print the tables, write the results, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--family", choices=[*FAMILIES, "all"], default="ordinary")
    parser.add_argument("--scenes", type=int, help="of each family; by default what `_families` says")
    parser.add_argument("--nominal", type=int, default=10, help="scenes in nominal conditions")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--jobs", type=int, default=1, help="processes; each has its own worlds")
    parser.add_argument(
        "--folder", type=Path, default=RESULTS / "stress", help="outcomes and blocks of earlier runs"
    )
    parser.add_argument("--any-code", action="store_true", help="include outcomes of older sources")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    file = arguments.folder / f"outcomes_{arguments.seed}.jsonl"
    families = list(FAMILIES) if arguments.family == "all" else [arguments.family]
    scenes = {
        family: FAMILIES[family].scenes if arguments.scenes is None else arguments.scenes
        for family in families
    }
    wanted = [("nominal", number) for number in range(arguments.nominal) if "ordinary" in families]
    wanted += [
        (kind, number)
        for family in families
        for kind in FAMILIES[family].kinds
        for number in range(scenes[family])
    ]
    outcomes = run_missing(arguments, file, wanted)
    of_kind = {
        kind: [outcomes[name_of(scene)] for scene in wanted if scene[0] == kind] for kind, _ in wanted
    }
    for family in families:
        report(family, of_kind)


def run_missing(arguments: argparse.Namespace, file: Path, wanted: list[Scene]) -> dict[str, Result]:
    """The outcomes of scenes by name; those that are missing are run, and kept one by one."""
    code = fingerprint()
    outcomes = read_outcomes(file, None if arguments.any_code else code)
    missing = [scene for scene in wanted if name_of(scene) not in outcomes]
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as progress, file.open("a") as out:
        task = progress.add_task("scenes", total=len(wanted), completed=len(wanted) - len(missing))
        for name, result in run_all(missing, arguments.seed, arguments.folder, arguments.jobs):
            outcomes[name] = result
            out.write(outcome_line(name, code, result))
            out.flush()
            progress.advance(task)
    return outcomes


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
