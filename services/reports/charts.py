"""The charts of a report: points by stage and reason, residuals against position and height."""

import numpy as np

from amers.services.quality.accuracy import statistics
from amers.services.reports.drawing import (
    ACTIVE,
    DEACTIVATED,
    MATCHED,
    NOT_MATCHED,
    shortened,
)
from amers.services.reports.numbers import number
from amers.services.reports.plot import (
    INK,
    QUIET,
    SMALL_TEXT,
    TEXT,
    WIDTH,
    Figure,
    Panel,
    data_range,
    left_margin,
    widened,
)
from amers.services.reports.report import RegistrationReport
from amers.services.types import Array

_GAP = 14.0
"""Width between panels, points."""
_BAR = 19.0
"""Height of a bar with the gap to the next one, points."""
_BAR_LABELS = 130.0
"""Width of the labels of bars, points."""


def residual_histograms(report: RegistrationReport) -> Figure:
    """Distribution of the residuals of the active points in x, y and xy.

    Distribution of the residuals; the line is the mean, the title mean ± standard deviation in
    pixels.
    """
    figure = Figure(166.0)
    measures = report.figure_data.measures
    line, sample = measures.residual_px[measures.active].T
    histograms = []
    for name, values in (("x (sample)", sample), ("y (line)", line), ("xy", np.hypot(line, sample))):
        finite = values[np.isfinite(values)]
        reach = max(float(np.abs(finite).max(initial=0.0)), 0.01)
        counts, edges = np.histogram(finite, np.linspace(0.0 if name == "xy" else -reach, reach, 17))
        histograms.append((name, finite, counts, edges))
    highest = max(1, *(int(counts.max()) for _, _, counts, _ in histograms))
    y_range = (0.0, 1.05 * highest)
    left = left_margin(y_range, 4)
    width = (WIDTH - left - 2.0 * _GAP - 4.0) / 3.0
    for k, (name, finite, counts, edges) in enumerate(histograms):
        x_range = widened(float(edges[0]), float(edges[-1]))
        panel = Panel(figure, left + k * (width + _GAP), 20.0, width, 112.0, x_range, y_range)
        panel.x_axis(f"{name}, px", count=3)
        panel.y_axis("points" if k == 0 else "", count=4, numbers=k == 0)
        tops, bottoms = panel.places(edges[:-1], counts), panel.places(edges[1:], 0.0 * counts)
        for top, bottom in zip(tops, bottoms, strict=True):
            figure.box((top[0], top[1]), tuple(bottom - top), ACTIVE, opacity=0.85)
        if len(finite):
            moments = statistics(finite)
            figure.line(panel.places(np.full(2, moments.mean), np.array(y_range)), INK, 1.0)
            title = f"{number(moments.mean, 3)} ± {number(moments.std, 3)}"
            figure.text(panel.left + width / 2.0, 12.0, title, anchor="middle")
    return figure


def funnel(report: RegistrationReport) -> Figure:
    """Visible, matched and active points, with the points lost between them by reason.

    From visible to matched to active points; the points lost between them, by reason.
    """
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
    height = _BAR * len(bars)
    figure = Figure(height + 36.0)
    x_range = (0.0, max(counts.visible, 1) * 1.12)
    panel = Panel(
        figure, _BAR_LABELS, 4.0, WIDTH - _BAR_LABELS - 4.0, height, x_range, (float(len(bars)), 0.0)
    )
    panel.x_axis("points", count=5)
    figure.line(panel.places(np.zeros(2), np.array([0.0, len(bars)])), QUIET, 0.6)
    for row, (name, start, n_points, colour) in enumerate(bars):
        corner, end = panel.places(
            np.array([start, start + n_points]), np.array([row + 0.19, row + 0.81])
        )
        figure.box(tuple(corner), tuple(end - corner), colour, title=f"{name}: {n_points}")
        middle = float(corner[1] + end[1]) / 2.0 + 3.5
        figure.text(_BAR_LABELS - 6.0, middle, name, anchor="end", size=SMALL_TEXT)
        figure.text(float(end[0]) + 4.0, middle, str(n_points))
    return figure


def residuals_along(report: RegistrationReport) -> Figure:
    """Residuals of the active points against line and sample: drift and jitter show here.

    Residuals along lines and samples; orange: running median. A slope shows a drift that the
    correction does not remove, a wave along the lines shows jitter of the platform.
    """
    figure = Figure(274.0)
    measures = report.figure_data.measures
    residual, place = measures.residual_px[measures.active], measures.line_sample[measures.active]
    y_ranges = [data_range(residual[:, k]) for k in range(2)]
    left = max(map(left_margin, y_ranges))
    width = (WIDTH - left - _GAP - 8.0) / 2.0
    for k, residual_name in enumerate(("y (line)", "x (sample)")):
        for j, place_name in enumerate(("line", "sample")):
            panel = Panel(
                figure,
                left + j * (width + _GAP),
                6.0 + k * 118.0,
                width,
                108.0,
                (0.0, float(report.scene.shape[j])),
                y_ranges[k],
            )
            panel.x_axis(place_name if k == 1 else "", count=5, numbers=k == 1)
            panel.y_axis(f"{residual_name}, px" if j == 0 else "", numbers=j == 0)
            _draw_residuals(panel, place[:, j], residual[:, k])
    return figure


def displacement(report: RegistrationReport) -> Figure:
    """What the correction follows beyond an affine one, and what points show of it.

    What the correction follows beyond an affine one (orange, with twice its standard deviation), and
    what the active points show of it.
    """
    figure = Figure(274.0)
    sections, measures = report.figure_data.sections, report.figure_data.measures
    if not sections:
        return figure
    place = measures.predicted[measures.active]
    residual = measures.residual_px[measures.active]
    shown = [residual + one.at(place[:, one.axis]) for one in sections]
    y_ranges = [data_range(np.concatenate([one[:, k] for one in shown])) for k in range(2)]
    left = max(map(left_margin, y_ranges))
    width = (WIDTH - left - 8.0 + _GAP) / len(sections) - _GAP
    for j, section in enumerate(sections):
        x_range = (0.0, float(report.scene.shape[section.axis]))
        for k, name in enumerate(("y (line)", "x (sample)")):
            top = 6.0 + k * 118.0
            panel = Panel(figure, left + j * (width + _GAP), top, width, 108.0, x_range, y_ranges[k])
            panel.x_axis(("line", "sample")[section.axis] if k == 1 else "", numbers=k == 1)
            panel.y_axis(f"{name}, px" if j == 0 else "", numbers=j == 0)
            value, sigma = section.displacement_px[:, k], section.sigma_px[:, k]
            above = panel.places(section.position, value + 2.0 * sigma)
            below = panel.places(section.position, value - 2.0 * sigma)
            with panel.clipped():
                figure.area(np.concatenate([above, below[::-1]]), DEACTIVATED, 0.25)
                figure.discs(panel.places(place[:, section.axis], shown[j][:, k]), 3.0, ACTIVE, 0.7)
                figure.line(panel.places(section.position, value), DEACTIVATED, 1.4)
    return figure


def residuals_by_height(report: RegistrationReport) -> Figure:
    """Residuals of the active points on the ground against their height, along and across the view.

    Residuals on the ground against the height of the points. A slope along the view shows an error
    of the heights, of the points or of the terrain they come from; across the view no slope is
    expected.
    """
    figure = Figure(188.0)
    measures = report.figure_data.measures
    azimuth = np.radians(report.scene.acquisition.azimuth_deg)
    names = ("along the view", "across the view") if np.isfinite(azimuth) else ("north", "east")
    north_first = np.nan_to_num(azimuth)
    away = np.array([-np.sin(north_first), -np.cos(north_first)])
    if not np.isfinite(azimuth):
        away = -away
    across = np.array([-away[1], away[0]]) if np.isfinite(azimuth) else np.array([1.0, 0.0])
    height_m = measures.lon_lat_h[measures.active, 2]
    residual_m = measures.residual_m[measures.active] @ np.column_stack([away, across])
    y_range = data_range(residual_m)
    x_range = widened(float(height_m.min(initial=np.inf)), float(height_m.max(initial=-np.inf)))
    if not np.isfinite(x_range).all():
        x_range = (0.0, 1.0)
    left = left_margin(y_range)
    width = (WIDTH - left - _GAP - 8.0) / 2.0
    for k, name in enumerate(names):
        panel = Panel(figure, left + k * (width + _GAP), 18.0, width, 136.0, x_range, y_range)
        panel.x_axis("height, m")
        panel.y_axis("residual, m" if k == 0 else "", numbers=k == 0)
        figure.text(panel.left, 11.0, name, size=TEXT)
        _draw_residuals(panel, height_m, residual_m[:, k])
    return figure


def _draw_residuals(panel: Panel, position: Array, residual: Array) -> None:
    """Draw residuals against a position, with the zero line and a running median."""
    figure = panel.figure
    figure.line(panel.places(np.array(panel.x_range), np.zeros(2)), QUIET, 0.7)
    figure.discs(panel.places(position, residual), 3.0, ACTIVE, 0.7)
    figure.line(panel.places(*_running_median(position, residual)), DEACTIVATED, 1.4)


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
