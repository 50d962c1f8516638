"""The charts of a report: points by stage and reason, residuals against position and height."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from services.quality.accuracy import statistics
from services.reports.drawing import (
    ACTIVE,
    DEACTIVATED,
    INK,
    MANY_POINTS,
    MATCHED,
    NOT_MATCHED,
    QUIET,
    TEXT_PT,
    WIDTH_IN,
    plain_axes,
    shortened,
    style,
)
from services.reports.numbers import number
from services.reports.report import RegistrationReport
from services.types import Array


def residual_histograms(report: RegistrationReport) -> Figure:
    """Distribution of the residuals of the active points in x, y and xy."""
    figure = Figure(figsize=(WIDTH_IN, 2.3), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    measures = report.figure_data.measures
    line, sample = measures.residual_px[measures.active].T
    for axes, name, values in zip(
        panels, ("x (sample)", "y (line)", "xy"), (sample, line, np.hypot(line, sample)), strict=True
    ):
        style(axes)
        axes.set_xlabel(f"{name}, px")
        axes.xaxis.set_major_locator(MaxNLocator(nbins=4, prune="both"))
        finite = values[np.isfinite(values)]
        if not len(finite):
            continue
        reach = max(float(np.abs(finite).max()), 0.01)
        bins = np.linspace(0.0 if name == "xy" else -reach, reach, 17)
        axes.hist(finite, bins=bins, color=ACTIVE, alpha=0.85)
        moments = statistics(finite)
        axes.axvline(moments.mean, color=INK, linewidth=1.0)
        axes.set_title(
            f"{number(moments.mean, 3)} ± {number(moments.std, 3)}", color=INK, fontsize=TEXT_PT
        )
    panels[0].set_ylabel("points")
    panels[0].yaxis.get_major_locator().set_params(integer=True)
    return figure


def funnel(report: RegistrationReport) -> Figure:
    """Visible, matched and active points, with the points lost between them by reason."""
    counts = report.point_counts
    bars: list[tuple[str, int, int, str]] = [("visible", 0, counts.visible, QUIET)]
    remaining = counts.visible
    for stage, total, colour in (
        ("not matched", counts.matched, MATCHED),
        ("deactivated", counts.active, ACTIVE),
    ):
        for reason in (r for r in report.reasons if r.stage == stage):
            remaining -= reason.count
            bars.append((shortened(reason.label), remaining, reason.count, NOT_MATCHED))
        bars.append(("matched" if stage == "not matched" else "active", 0, total, colour))
    figure, axes = plain_axes(height_in=0.5 + 0.26 * len(bars))
    for row, (_, start, width, colour) in enumerate(bars):
        axes.barh(row, width, left=start, height=0.62, color=colour)
        axes.annotate(
            str(width),
            (start + width, row),
            (4, 0),
            textcoords="offset points",
            va="center",
            color=INK,
            fontsize=TEXT_PT,
        )
    axes.set_yticks(range(len(bars)), [name for name, *_ in bars])
    axes.invert_yaxis()
    axes.set_xlim(0, max(counts.visible, 1) * 1.12)
    axes.set_xlabel("points")
    return figure


def residuals_along(report: RegistrationReport) -> Figure:
    """Residuals of the active points against line and sample: drift and jitter show here."""
    figure = Figure(figsize=(WIDTH_IN, 3.8), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col", sharey="row")
    measures = report.figure_data.measures
    residual, place = measures.residual_px[measures.active], measures.line_sample[measures.active]
    for k, residual_name in enumerate(("y (line)", "x (sample)")):
        for j, place_name in enumerate(("line", "sample")):
            axes = panels[k, j]
            style(axes)
            axes.axhline(0.0, color=QUIET, linewidth=0.7)
            axes.scatter(
                place[:, j],
                residual[:, k],
                s=7,
                color=ACTIVE,
                alpha=0.7,
                linewidths=0,
                rasterized=len(place) > MANY_POINTS,
            )
            axes.plot(*_running_median(place[:, j], residual[:, k]), color=DEACTIVATED, linewidth=1.4)
            axes.set_xlim(0, report.scene.shape[j])
            axes.locator_params(axis="x", nbins=4)
            if k == 1:
                axes.set_xlabel(place_name)
            if j == 0:
                axes.set_ylabel(f"{residual_name}, px")
    return figure


def residuals_by_height(report: RegistrationReport) -> Figure:
    """Residuals of the active points on the ground against their height, along and across the view."""
    figure = Figure(figsize=(WIDTH_IN, 2.6), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    measures = report.figure_data.measures
    azimuth = np.radians(report.scene.acquisition.azimuth_deg)
    names = ("along the view", "across the view") if np.isfinite(azimuth) else ("north", "east")
    north_first = np.nan_to_num(azimuth)
    away = np.array([-np.sin(north_first), -np.cos(north_first)])
    if not np.isfinite(azimuth):
        away = -away
    across = np.array([-away[1], away[0]]) if np.isfinite(azimuth) else np.array([1.0, 0.0])
    height_m = measures.lon_lat_h[measures.active, 2]
    for axes, name, direction in zip(panels, names, (away, across), strict=True):
        residual_m = measures.residual_m[measures.active] @ direction
        style(axes)
        axes.axhline(0.0, color=QUIET, linewidth=0.7)
        axes.scatter(
            height_m,
            residual_m,
            s=7,
            color=ACTIVE,
            alpha=0.7,
            linewidths=0,
            rasterized=len(height_m) > MANY_POINTS,
        )
        axes.plot(*_running_median(height_m, residual_m), color=DEACTIVATED, linewidth=1.4)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=4, prune="both"))
        axes.set_xlabel("height, m")
        axes.set_title(name, color=INK, fontsize=TEXT_PT, loc="left")
    panels[0].set_ylabel("residual, m")
    return figure


def _running_median(position: Array, value: Array) -> tuple[Array, Array]:
    """Medians of equal parts of the points in order of position; empty for too few or one position.

    There are 4 to 40 parts, of a dozen points each where there are enough: few points show a slope, many
    show an oscillation, and the median hides the noise of single points.
    """
    finite = np.isfinite(position) & np.isfinite(value)
    n = int(finite.sum())
    bins = min(40, max(4, n // 12))
    if n < 6 * bins or np.ptp(position[finite]) == 0.0:
        return np.empty(0), np.empty(0)
    order = np.argsort(position[finite])
    parts = zip(
        np.array_split(position[finite][order], bins),
        np.array_split(value[finite][order], bins),
        strict=True,
    )
    medians = np.array([(np.median(place), np.median(part)) for place, part in parts])
    return medians[:, 0], medians[:, 1]
