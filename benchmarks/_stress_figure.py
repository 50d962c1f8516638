"""The figure of a stress campaign."""

from collections.abc import Mapping, Sequence
from operator import attrgetter
from pathlib import Path

import matplotlib as mpl
import numpy as np

from benchmarks._outcome import WRONG, Outcome
from benchmarks._trials import Trial

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

COLOURS = {"good": "#2a7f62", "usable": "#d9a441", "failed": "#b9b9b9", "refused": "#e4e4e4"}

Result = tuple[Trial, Outcome]


def draw_figure(results: Sequence[Result], factors: Mapping[str, Sequence[float]], path: Path) -> None:
    """Verdicts by factor, true against predicted accuracy, and errors over stated deviations.

    Args:
        results: of the campaign.
        factors: edges of the classes of each.
        path: of the picture.
    """
    columns = 5
    rows = -(-len(factors) // columns)
    figure = plt.figure(figsize=(15.0, 3.0 * rows + 4.5), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=[3.0 * rows, 4.5])
    axes = top.subplots(rows, columns, squeeze=False).ravel()
    for axis, (factor, edges) in zip(axes, factors.items(), strict=False):
        _verdicts(axis, results, factor, edges)
    for axis in axes[len(factors) :]:
        axis.remove()
    top.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, frameon=False)
    left, right = bottom.subplots(1, 2)
    _predictions(left, results)
    _normalised(right, results)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _verdicts(axis: Axes, results: Sequence[Result], factor: str, edges: Sequence[float]) -> None:
    """Shares of the verdicts in the classes of a factor, and how many results were right."""
    value = np.array([float(attrgetter(factor)(trial)) for trial, _ in results])
    row = np.clip(np.searchsorted(edges, value, side="right") - 1, 0, len(edges) - 2)
    classes = range(len(edges) - 1)
    count = np.array([max(1, int((row == k).sum())) for k in classes])
    base = np.zeros(len(count))
    for verdict, colour in COLOURS.items():
        has = np.array([outcome.verdict == verdict for _, outcome in results])
        share = np.array([(has & (row == k)).sum() for k in classes]) / count
        axis.bar(classes, share, bottom=base, color=colour, label=verdict, width=0.85)
        base += share
    right = np.array([outcome.delivered and not outcome.wrong for _, outcome in results])
    success = [(right & (row == k)).sum() / n for k, n in zip(classes, count, strict=True)]
    axis.plot(classes, success, "k_", markersize=22, label="delivered and right")
    names = [f"{a:g}\nto {b:g}\n{n}" for a, b, n in zip(edges[:-1], edges[1:], count, strict=True)]
    if factor == "inverted":
        names = [f"{word}\n{n}" for word, n in zip(("no", "yes"), count, strict=True)]
    axis.set_xticks(list(classes), names, fontsize=7)
    axis.set_ylim(0.0, 1.0)
    axis.set_title(factor, fontsize=9)


def _predictions(axis: Axes, results: Sequence[Result]) -> None:
    """True CE90 against the predicted one."""
    for verdict, colour in COLOURS.items():
        chosen = [o for _, o in results if o.verdict == verdict and np.isfinite(o.ce90_m)]
        predicted, true = [o.predicted_m for o in chosen], [o.ce90_m for o in chosen]
        axis.loglog(predicted, true, "o", color=colour, markersize=4, alpha=0.8, label=verdict)
    low, high = axis.get_xlim()
    ends = np.array([low, high])
    axis.plot(ends, ends, "k-", linewidth=0.8, label="as predicted")
    axis.plot(ends, WRONG * ends, "k--", linewidth=0.8, label=f"{WRONG:g} times")
    axis.set_xlabel("predicted CE90, m")
    axis.set_ylabel("true CE90, m")
    axis.legend(fontsize=8, frameon=False)


def _normalised(axis: Axes, results: Sequence[Result]) -> None:
    """Mean square of errors over stated deviations, scene by scene."""
    edges = np.geomspace(0.01, 100.0, 33)
    for verdict in ("good", "usable"):
        values = [o.normalised for _, o in results if o.verdict == verdict]
        if values:
            label = f"{verdict}: mean {np.mean(values):.2f} of {len(values)}"
            clipped = np.clip(values, edges[0], edges[-1])
            axis.hist(clipped, edges, color=COLOURS[verdict], alpha=0.7, label=label)
    axis.axvspan(0.7, 1.5, color="k", alpha=0.08)
    axis.set_xscale("log")
    axis.set_xlabel("mean square of true error / stated deviation, one scene")
    axis.set_ylabel("scenes")
    axis.legend(fontsize=8, frameon=False)
