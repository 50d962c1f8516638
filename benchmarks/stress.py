"""Success rate of registration under difficult conditions, and honesty of the stated accuracy.

Scenes of twelve simulated worlds, from 0.2 m to 20 m, vary in all factors that make registration
difficult: a few factors over their whole range, the others mildly. Ten more scenes have the conditions
that SRP is described by. Each result is compared with the true sensor over the whole image. Three
figures
matter: how often a result is delivered ("good" or "usable") and right; whether a "good" result is wrong
by more than three times its stated accuracy; and the mean square of true errors over stated standard
deviations, 1 when these are honest.

Every scene follows from the seed and its number. The outcome of each scene is appended to a file. A
scene is not repeated as long as the sources are the same; blocks of points are reused until their files
are removed. Run: python -m benchmarks.stress [--scenes 500]
"""

import argparse
import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from benchmarks._campaign import Outcome, attempt
from benchmarks._measuring import RESULTS, keep
from benchmarks._stress_figure import draw_figure
from benchmarks._trials import Trial, draw_trial, in_order_of_places, nominal_trial
from benchmarks._worlds import NOMINAL, PLACES, block_of
from services.registration.options import RegistrationOptions

OPTIONS = RegistrationOptions(max_points=120)
NOMINAL_OPTIONS = RegistrationOptions()
SEED = 1
ROOT = Path(__file__).parent.parent

Result = tuple[Trial, Outcome]

FACTORS: dict[str, tuple[float, ...]] = {
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
    "incidence_deg": (0.0, 10.0, 20.0, 35.1),
    "point_ce90_m": (0.5, 1.5, 3.0, 5.0),
    "understated": (0.99, 1.01, 2.0, 3.0),
}
"""Edges of the classes in which each factor is reported."""


def main() -> None:
    """Run the missing scenes, print the tables, write the results, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--nominal", type=int, default=10, help="scenes in nominal conditions")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument(
        "--folder", type=Path, default=RESULTS / "stress", help="outcomes and blocks of earlier runs"
    )
    parser.add_argument("--any-code", action="store_true", help="include outcomes of older sources")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    file = arguments.folder / f"outcomes_{arguments.seed}.jsonl"
    code = fingerprint()
    outcomes = read_outcomes(file, None if arguments.any_code else code)
    run_missing(arguments, file, code, outcomes)
    results = [outcomes[name] for name in sorted(outcomes) if name.startswith("trial")]
    nominal = [outcomes[name] for name in sorted(outcomes) if name.startswith("nominal")]
    show(results, nominal)
    keep(
        "stress",
        {"summary": summary(results), "nominal": summary(nominal), "factors": by_factor(results)},
    )
    if results:
        draw_figure(results, FACTORS, RESULTS / "stress.png")


def fingerprint() -> str:
    """A short hash of all sources of `services`."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "services").rglob("*.py")):
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
            outcomes[record["name"]] = Trial(**record["trial"]), Outcome(**record["outcome"])
    return outcomes


def run_missing(
    arguments: argparse.Namespace, file: Path, code: str, outcomes: dict[str, Result]
) -> None:
    """Register the scenes that have no outcome yet, world by world, and add their outcomes."""
    work = [("nominal", number) for number in range(arguments.nominal)]
    work += [("trial", number) for number in in_order_of_places(range(arguments.scenes), PLACES)]
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as progress, file.open("a") as out:
        task = progress.add_task("scenes", total=len(work))
        for kind, number in work:
            name = f"{kind}_{number:05d}"
            if name not in outcomes:
                outcomes[name] = run(kind, number, arguments.seed, arguments.folder)
                trial, outcome = (asdict(part) for part in outcomes[name])
                line = {"name": name, "code": code, "trial": trial, "outcome": outcome}
                out.write(json.dumps(line) + "\n")
                out.flush()
            progress.advance(task)


def run(kind: str, number: int, seed: int, folder: Path) -> Result:
    """The trial and the outcome of one scene."""
    place = NOMINAL if kind == "nominal" else PLACES[number % len(PLACES)]
    trial = nominal_trial(seed, number) if kind == "nominal" else draw_trial(seed, number)
    options = NOMINAL_OPTIONS if kind == "nominal" else OPTIONS
    return trial, attempt(place, trial, block_of(place, folder), seed, options)


def summary(results: list[Result]) -> dict[str, Any]:
    """Figures of some scenes."""
    outcomes = [outcome for _, outcome in results]
    delivered = [o for o in outcomes if o.delivered]
    good = [o for o in outcomes if o.verdict == "good"]
    verdicts = ("good", "usable", "failed", "refused")
    ce90_m = np.array([o.ce90_m for o in delivered])
    return {
        "scenes": len(outcomes),
        **{verdict: sum(o.verdict == verdict for o in outcomes) for verdict in verdicts},
        "success": sum(not o.wrong for o in delivered) / max(1, len(outcomes)),
        "good_but_wrong": sum(o.wrong for o in good),
        "delivered_but_wrong": sum(o.wrong for o in delivered),
        "ce90_m": quantiles(ce90_m),
        "ce90_before_m": quantiles(np.array([o.ce90_before_m for o in delivered])),
        "ground_ce90_m": quantiles(np.array([o.ground_ce90_m for o in delivered])),
        "ce90_px": quantiles(np.array([o.ce90_m / t.gsd_m for t, o in results if o.delivered])),
        "displacement_m": quantiles(np.array([o.displacement_m for o in delivered])),
        "ce90_of_points": quantiles(
            np.array([o.ce90_m / t.point_ce90_m for t, o in results if o.delivered])
        ),
        "normalised": mean([o.normalised for o in delivered]),
        "normalised_good": mean([o.normalised for o in good]),
        "normalised_honest_points": mean(
            [o.normalised for t, o in results if o.delivered and t.understated <= 1.0]
        ),
        "cpu_s": mean([o.cpu_s for o in outcomes]),
    }


def mean(values: list[float]) -> float | None:
    """The mean; None without values."""
    return float(np.mean(values)) if values else None


def quantiles(values: np.ndarray) -> list[float]:
    """Median, 90 % quantile and maximum of the finite values."""
    finite = values[np.isfinite(values)]
    return [float(v) for v in np.quantile(finite, [0.5, 0.9, 1.0])] if len(finite) else []


def by_factor(results: list[Result]) -> dict[str, list[dict[str, Any]]]:
    """Figures of the scenes in each class of each factor."""
    table: dict[str, list[dict[str, Any]]] = {}
    for factor, edges in FACTORS.items():
        value = np.array([float(getattr(trial, factor)) for trial, _ in results])
        row = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)
        table[factor] = [
            {
                "from": edges[k],
                "to": edges[k + 1],
                **summary([result for result, at in zip(results, row, strict=True) if at == k]),
            }
            for k in range(len(edges) - 1)
        ]
    return table


def show(results: list[Result], nominal: list[Result]) -> None:
    """Print the tables."""
    console = Console(width=120)
    table = Table(
        "factor",
        "from",
        "to",
        "scenes",
        "good",
        "usable",
        "failed",
        "refused",
        "success",
        "good, wrong",
        "CE90 m",
        "90 %",
        "normalised",
        title="registration under stress",
    )
    rows = [("all", {"from": "", "to": "", **summary(results)})]
    rows.append(("nominal", {"from": "", "to": "", **summary(nominal)}))
    rows += [(name, row) for name, classes in by_factor(results).items() for row in classes]
    for name, row in rows:
        counts = [str(row[key]) for key in ("scenes", "good", "usable", "failed", "refused")]
        median, most = (f"{v:.2f}" for v in row["ce90_m"][:2]) if row["ce90_m"] else ("", "")
        honest = "" if row["normalised"] is None else f"{row['normalised']:.2f}"
        success = f"{100.0 * row['success']:.0f} %"
        wrong = str(row["good_but_wrong"])
        edges = [f"{row[key]:g}" if row[key] != "" else "" for key in ("from", "to")]
        table.add_row(name, *edges, *counts, success, wrong, median, most, honest)
    console.print(table)
    for trial, outcome in results:
        if outcome.delivered and outcome.wrong:
            console.print(
                f"scene {trial.number} ({trial.place}, {outcome.verdict}): CE90 {outcome.ce90_m:.2f} m, "
                f"{outcome.predicted_m:.2f} m predicted, {outcome.active} active points"
            )


if __name__ == "__main__":
    main()
