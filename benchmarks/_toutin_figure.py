"""The figure of the simulation of Toutin and Carbonneau: their graphs, and what they state of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

COLOURS = {"X": "#1f5fa8", "Y": "#c0582b", "Z": "#2a7f62"}
_SIX = 6
"""Control points from which the published levels hold."""


def draw_figure(outcome: Mapping[str, Any], path: Path) -> None:
    """Errors at check points by the number of control points and of images, beside published ones.

    Args:
        outcome: of the benchmark: `graphs` and `tables_4_and_5`.
        path: of the picture.
    """
    figure, axes = plt.subplots(1, 4, figsize=(15.0, 4.2), layout="constrained")
    rows = outcome["graphs"]
    _by_points(axes[0], "one image (graph 1)", rows[:3], "XY", {"X": 4.7, "Y": 4.8})
    _heights(axes[1], rows[3:6])
    _by_points(axes[2], "three images (graph 3)", rows[6:], "XYZ", {"X": 3.8, "Y": 3.9, "Z": 3.6})
    _by_images(axes[3], outcome["tables_4_and_5"])
    for axis in axes:
        axis.set_ylim(0.0)
        axis.spines[["top", "right"]].set_visible(False)
    for axis in axes[:3]:
        axis.set_xlabel("control points")
    axes[0].set_ylabel("root mean square at check points, m")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _by_points(
    axis: Axes, title: str, rows: Sequence[Any], coordinates: str, published: Mapping[str, float]
) -> None:
    """One curve a coordinate and configuration; dashes where the paper states a level."""
    for row in rows:
        for k, name in enumerate(coordinates):
            values = [one["rms_m"][k] for one in row["ours"]]
            axis.plot(row["points"], values, color=COLOURS[name], label=name if row is rows[0] else None)
    most = max(rows[0]["points"])
    for name, level in published.items():
        axis.hlines(level, _SIX, most, COLOURS[name], linestyles="dotted", label=f"{name}, published")
    axis.set_title(title)
    axis.legend(frameon=False, fontsize=8, loc="lower left", ncols=2)


def _heights(axis: Axes, rows: Sequence[Any]) -> None:
    """Heights of pairs, by their base."""
    for row, style in zip(rows, (":", "--", "-"), strict=True):
        values = [one["rms_m"][2] for one in row["ours"]]
        axis.plot(row["points"], values, style, color=COLOURS["Z"], label=f"Z, B/H {row['ratio']:g}")
        axis.hlines(row["published"], 3, 10, "0.5", linestyles=style)
    axis.plot([], [], color="0.5", label="published")
    axis.set_title("heights of two images (graph 2)")
    axis.legend(frameon=False, fontsize=8, loc="lower left", ncols=2)


def _by_images(axis: Axes, rows: Sequence[Any]) -> None:
    """One, two and three images on six control points."""
    count = np.array([row["images"] for row in rows])
    for k, name in enumerate("XYZ"):
        shown = count > 1 if name == "Z" else count > 0
        ours = np.array([row["ours"][0]["rms_m"][k] for row in rows])
        published = np.array([row["published"][k] for row in rows])
        axis.plot(count[shown], ours[shown], "o-", color=COLOURS[name], label=name)
        axis.plot(count[shown], published[shown], "s:", color=COLOURS[name], label=f"{name}, published")
    axis.set_xticks([1, 2, 3])
    axis.set_xlabel("images")
    axis.set_title("six control points (graph 4, table 4)")
    axis.legend(frameon=False, fontsize=8, ncols=2)
