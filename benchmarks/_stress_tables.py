"""Figures of a stress campaign, its tables, and whether it shows what it must."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks._outcome import WRONG, Result

NORMALISED = (0.7, 1.5)
"""Mean squares of normalised errors that are honest."""
NOMINAL_BEFORE_M = 0.425
"""Median CE90 in nominal conditions, 21 November 2026, commit d09c026."""
NOMINAL_TOLERANCE = 0.05
SLIGHT_DAMAGE = 0.01
"""Share of damaged pixels up to which they must not matter."""

Factors = Mapping[str, Sequence[float]]


def summary(results: Sequence[Result]) -> dict[str, Any]:
    """Figures of some scenes."""
    outcomes = [outcome for _, outcome in results]
    delivered = [o for o in outcomes if o.delivered]
    good = [o for o in outcomes if o.verdict == "good"]
    verdicts = ("good", "usable", "failed", "refused")
    return {
        "scenes": len(outcomes),
        **{verdict: sum(o.verdict == verdict for o in outcomes) for verdict in verdicts},
        "success": sum(not o.wrong for o in delivered) / max(1, len(outcomes)),
        "good_but_wrong": sum(o.wrong for o in good),
        "delivered_but_wrong": sum(o.wrong for o in delivered),
        "delivered_but_wrong_on_earth": sum(o.wrong_on_earth for o in delivered),
        "ce90_m": quantiles([o.ce90_m for o in delivered]),
        "predicted_m": quantiles([o.predicted_m for o in delivered]),
        "ce90_before_m": quantiles([o.ce90_before_m for o in delivered]),
        "ground_ce90_m": quantiles([o.ground_ce90_m for o in delivered]),
        "ground_predicted_m": quantiles([o.ground_predicted_m for o in delivered]),
        "ce90_px": quantiles([o.ce90_m / t.gsd_m for t, o in results if o.delivered]),
        "displacement_m": quantiles([o.displacement_m for o in delivered]),
        "ce90_of_points": quantiles([o.ce90_m / t.point_ce90_m for t, o in results if o.delivered]),
        "of_predicted": quantiles([o.ce90_m / o.predicted_m for o in delivered]),
        "ground_of_predicted": quantiles([o.ground_ce90_m / o.ground_predicted_m for o in delivered]),
        "normalised": mean([o.normalised for o in delivered]),
        "ground_normalised": mean([o.ground_normalised for o in delivered]),
        "normalised_good": mean([o.normalised for o in good]),
        "normalised_honest_points": mean(
            [o.normalised for t, o in results if o.delivered and t.understated <= 1.0]
        ),
        "cpu_s": mean([o.cpu_s for o in outcomes]),
    }


def mean(values: list[float]) -> float | None:
    """The mean; None without values."""
    return float(np.mean(values)) if values else None


def quantiles(values: list[float]) -> list[float]:
    """Median, 90 % quantile and maximum of the finite values."""
    finite = [v for v in values if np.isfinite(v)]
    return [float(v) for v in np.quantile(finite, [0.5, 0.9, 1.0])] if finite else []


def by_factor(results: Sequence[Result], factors: Factors) -> dict[str, list[dict[str, Any]]]:
    """Figures of the scenes in each class of each factor."""
    table: dict[str, list[dict[str, Any]]] = {}
    for factor, edges in factors.items():
        value = np.array([float(attrgetter(factor)(trial)) for trial, _ in results])
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


def as_without_damage(
    damaged: Sequence[Result], intact: Sequence[Result], most: float
) -> tuple[int, int]:
    """How many scenes with at most this damage are delivered and right: with it, and without."""
    pairs = [
        (with_it, without)
        for (trial, with_it), (_, without) in zip(damaged, intact, strict=True)
        if trial.damaged <= most
    ]
    return (
        sum(with_it.delivered and not with_it.wrong for with_it, _ in pairs),
        sum(without.delivered and not without.wrong for _, without in pairs),
    )


def acceptance(
    results: Sequence[Result], nominal: Sequence[Result], intact: Sequence[Result]
) -> list[tuple[str, bool, str]]:
    """What a family must show: the requirement, whether it holds, the figures.

    Args:
        results: of the family.
        nominal: scenes in nominal conditions; none when they were not run.
        intact: for damaged scenes, the same scenes with all their pixels, in the same order.
    """
    figures = summary(results)
    lines = [
        (f"none delivered is wrong by more than {WRONG:g} times its predicted CE90, {where}",
         figures[key] == 0, f"{figures[key]} wrong; true over predicted: {_listed(figures[ratio])}")
        for where, key, ratio in (
            ("relative", "delivered_but_wrong", "of_predicted"),
            ("on the Earth", "delivered_but_wrong_on_earth", "ground_of_predicted"),
        )
    ]  # fmt: skip
    for where, key in (("relative", "normalised"), ("on the Earth", "ground_normalised")):
        value = figures[key]
        honest = value is not None and NORMALISED[0] <= value <= NORMALISED[1]
        text = "no scene delivered" if value is None else f"{value:.2f}"
        lines.append(
            (f"normalised errors {NORMALISED[0]:g} to {NORMALISED[1]:g}, {where}", honest, text)
        )
    if intact:
        for most, where in ((SLIGHT_DAMAGE, "damage up to 1 % of the pixels"), (1.0, "all damage")):
            with_it, without = as_without_damage(results, intact, most)
            lines.append(
                (
                    f"{where}: delivered and right as often as without, to 1 % of the scenes",
                    with_it >= without - 0.01 * len(results),
                    f"{with_it} with, {without} without",
                )
            )
    if nominal:
        figures = summary(nominal)
        median_m = figures["ce90_m"][0] if figures["ce90_m"] else float("inf")
        lines.append(
            (
                f"nominal CE90 at most {NOMINAL_TOLERANCE:.0%} above {NOMINAL_BEFORE_M:g} m",
                median_m <= (1.0 + NOMINAL_TOLERANCE) * NOMINAL_BEFORE_M,
                f"{_listed(figures['ce90_m'])} m true, {_listed(figures['predicted_m'])} m predicted",
            )
        )
    return lines


def _listed(values: list[float]) -> str:
    """Median, 90 % and largest of a figure."""
    return "median {:.2f}, 90 % {:.2f}, largest {:.2f}".format(*values) if values else "none"


def show(
    family: str,
    rows: Sequence[tuple[str, Sequence[Result]]],
    results: Sequence[Result],
    factors: Factors,
) -> None:
    """Print the tables of a family.

    Args:
        family: its name.
        rows: names and results of the first lines.
        results: of the family, by factor below them.
        factors: edges of the classes.
    """
    console = Console(width=165)
    headings = (
        "factor  from  to  scenes  good  usable  failed  refused  success  good, wrong  wrong  "
        "wrong, Earth  CE90 m  90 %  normalised  Earth"
    )
    table = Table(*headings.split("  "), title=f"registration under stress: {family}")
    table.columns[0].min_width = max(len(name) for name in [*factors, "nominal"])
    lines = [(name, {"from": "", "to": "", **summary(part)}) for name, part in rows]
    lines += [(name, row) for name, classes in by_factor(results, factors).items() for row in classes]
    for name, row in lines:
        counts = [str(row[key]) for key in ("scenes", "good", "usable", "failed", "refused")]
        median, most = (f"{v:.2f}" for v in row["ce90_m"][:2]) if row["ce90_m"] else ("", "")
        honest = [
            "" if row[key] is None else f"{row[key]:.2f}" for key in ("normalised", "ground_normalised")
        ]
        success = f"{100.0 * row['success']:.0f} %"
        keys = ("good_but_wrong", "delivered_but_wrong", "delivered_but_wrong_on_earth")
        wrong = [str(row[key]) for key in keys]
        edges = [f"{row[key]:g}" if row[key] != "" else "" for key in ("from", "to")]
        table.add_row(name, *edges, *counts, success, *wrong, median, most, *honest)
    console.print(table)
    for trial, outcome in results:
        if outcome.delivered and (outcome.wrong or outcome.wrong_on_earth):
            console.print(
                f"scene {trial.number} ({trial.place}, {outcome.verdict}): CE90 {outcome.ce90_m:.2f} m, "
                f"{outcome.predicted_m:.2f} m predicted; on the Earth {outcome.ground_ce90_m:.2f} m, "
                f"{outcome.ground_predicted_m:.2f} m predicted; {outcome.active} active points"
            )


def show_acceptance(lines: Sequence[tuple[str, bool, str]]) -> None:
    """Print whether each requirement holds."""
    console = Console(width=165)
    for requirement, holds, figures in lines:
        console.print(
            f"{'holds' if holds else 'DOES NOT HOLD'}: {requirement}: {figures}", highlight=False
        )
