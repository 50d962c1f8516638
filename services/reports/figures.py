"""The figures of a report, drawn for light and dark pages alike."""

import io
import re
from collections.abc import Callable

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from services.quality.accuracy import statistics
from services.reports.report import Quicklook, RegistrationSummary, count_reasons
from services.types import Array, BoolArray

INK, QUIET = "#0a0b0c", "#0a0b0d"
_PAGE_COLOURS = {INK: "var(--ink)", QUIET: "var(--quiet)"}
"""Colours that the page decides on, so that a figure follows its light or dark scheme."""

ACTIVE, DEACTIVATED, NOT_MATCHED = "#2f7ed8", "#e8862e", "#8b939c"
ARROW = "#ffb000"
WIDTH_IN = 5.2
_TEXT_PT = 9.0
_REASON_MARKERS = ("x", "+", "^", "s", "d")
_MANY_POINTS = 1500
_M_PER_DEG = 111_320.0


def ground_overview(summary: RegistrationSummary) -> Figure:
    """The footprint of the scene and its points, kilometres east and north of its middle."""
    figure, axes = _figure(height_in=3.6)
    outline = summary.footprint
    places = outline if len(outline) else summary.measures.lon_lat_h[:, :2]
    centre = places.mean(axis=0) if len(places) else np.zeros(2)
    km = np.array([np.cos(np.radians(centre[1])), 1.0]) * _M_PER_DEG / 1000.0
    if len(outline):
        ring = (np.concatenate([outline, outline[:1]]) - centre) * km
        axes.fill(*ring.T, facecolor=ACTIVE, alpha=0.10, edgecolor="none")
        axes.plot(*ring.T, color=ACTIVE, linewidth=1.0)
    offset = summary.measures.lon_lat_h[:, :2] - centre
    offset[:, 0] = (offset[:, 0] + 180.0) % 360.0 - 180.0
    _scatter_by_status(
        axes, offset[:, ::-1] * km[::-1], summary.measures.matched, summary.measures.active
    )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("km east")
    axes.set_ylabel("km north")
    axes.grid(color=QUIET, alpha=0.25, linewidth=0.5)
    return figure


def residual_map(summary: RegistrationSummary) -> Figure:
    """Residual vectors of the active points on the image, enlarged, with an arrow for the scale."""
    figure, axes = _image_axes(summary, darkness=0.45)
    measures = summary.measures
    drawn = measures.active & np.isfinite(measures.residual_px).all(axis=1)
    residual, place = measures.residual_px[drawn], measures.line_sample[drawn]
    if not len(residual):
        axes.set_title("no active points", color=INK, fontsize=_TEXT_PT)
        return figure
    length_px = np.hypot(*residual.T)
    key_px = _round_number(float(np.quantile(length_px, 0.9)))
    enlarged = 0.06 * float(np.hypot(*summary.shape)) / key_px
    arrows = axes.quiver(
        place[:, 1],
        place[:, 0],
        residual[:, 1] * enlarged,
        residual[:, 0] * enlarged,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=ARROW if summary.quicklook is not None else ACTIVE,
        width=0.0035,
        rasterized=len(residual) > _MANY_POINTS,
    )
    axes.quiverkey(
        arrows,
        X=0.06,
        Y=1.04,
        U=key_px * enlarged,
        angle=0.0,
        label=f"{key_px:g} px = {key_px * summary.gsd_m:.2g} m",
        labelpos="E",
        color=ACTIVE,
        labelcolor=INK,
        fontproperties={"size": _TEXT_PT},
    )
    return figure


def coverage_map(summary: RegistrationSummary) -> Figure:
    """Where points are in the image, what became of them, and the cells without an active one."""
    figure, axes = _image_axes(summary, darkness=0.6)
    cells = summary.qualification.coverage.cells
    line_edges, sample_edges = (np.linspace(-0.5, size - 0.5, len(cells) + 1) for size in summary.shape)
    for row, column in np.argwhere(cells == 0):
        corner = sample_edges[column], line_edges[row]
        size = sample_edges[1] - sample_edges[0], line_edges[1] - line_edges[0]
        axes.add_patch(Rectangle(corner, *size, facecolor=DEACTIVATED, alpha=0.28, edgecolor="none"))
    axes.vlines(sample_edges[1:-1], line_edges[0], line_edges[-1], color=NOT_MATCHED, linewidth=0.5)
    axes.hlines(line_edges[1:-1], sample_edges[0], sample_edges[-1], color=NOT_MATCHED, linewidth=0.5)
    _scatter_reasons(axes, summary)
    handles, _ = axes.get_legend_handles_labels()
    if handles:
        axes.legend(
            loc="upper left",
            bbox_to_anchor=(-0.02, -0.02),
            ncols=2,
            frameon=False,
            fontsize=_TEXT_PT - 1,
            labelcolor=INK,
            handletextpad=0.3,
        )
    return figure


def residual_histograms(summary: RegistrationSummary) -> Figure:
    """Distribution of the residuals of the active points in x, y and xy."""
    figure = Figure(figsize=(WIDTH_IN, 2.3), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    line, sample = summary.measures.residual_px[summary.measures.active].T
    for axes, name, values in zip(
        panels, ("x (sample)", "y (line)", "xy"), (sample, line, np.hypot(line, sample)), strict=True
    ):
        _style(axes)
        axes.set_xlabel(f"{name}, px")
        finite = values[np.isfinite(values)]
        if not len(finite):
            continue
        reach = max(float(np.abs(finite).max()), 0.01)
        bins = np.linspace(0.0 if name == "xy" else -reach, reach, 17)
        axes.hist(finite, bins=bins, color=ACTIVE, alpha=0.85)
        found = statistics(finite)
        axes.axvline(found.mean, color=INK, linewidth=1.0)
        axes.set_title(f"{found.mean:+.2f} ± {found.std:.2f}", color=INK, fontsize=_TEXT_PT)
    panels[0].set_ylabel("points")
    return figure


def funnel(summary: RegistrationSummary) -> Figure:
    """From visible to matched to active points, with what was lost on the way and why."""
    equipment = summary.qualification.equipment
    reasons = count_reasons(summary.measures)
    bars: list[tuple[str, int, int, str]] = [("visible", 0, equipment.visible, QUIET)]
    left = equipment.visible
    for stage, total, colour in (
        ("not matched", equipment.matched, DEACTIVATED),
        ("deactivated", equipment.active, ACTIVE),
    ):
        for reason in (r for r in reasons if r.stage == stage):
            left -= reason.count
            bars.append((_shortened(reason.reason), left, reason.count, NOT_MATCHED))
        bars.append(("matched" if stage == "not matched" else "active", 0, total, colour))
    figure, axes = _figure(height_in=0.5 + 0.26 * len(bars))
    for row, (_, start, width, colour) in enumerate(bars):
        axes.barh(row, width, left=start, height=0.62, color=colour)
        axes.annotate(
            str(width),
            (start + width, row),
            (4, 0),
            textcoords="offset points",
            va="center",
            color=INK,
            fontsize=_TEXT_PT,
        )
    axes.set_yticks(range(len(bars)), [name for name, *_ in bars])
    axes.invert_yaxis()
    axes.set_xlim(0, max(equipment.visible, 1) * 1.12)
    axes.set_xlabel("points")
    return figure


def residuals_along(summary: RegistrationSummary) -> Figure:
    """Residuals of the active points against their line and their sample: what a drift would leave."""
    figure = Figure(figsize=(WIDTH_IN, 3.8), layout="constrained")
    panels = figure.subplots(2, 2, sharex="col", sharey="row")
    active = summary.measures.active
    residual, place = summary.measures.residual_px[active], summary.measures.line_sample[active]
    for k, residual_name in enumerate(("y (line)", "x (sample)")):
        for j, place_name in enumerate(("line", "sample")):
            axes = panels[k, j]
            _style(axes)
            axes.axhline(0.0, color=QUIET, linewidth=0.7)
            axes.scatter(
                place[:, j],
                residual[:, k],
                s=7,
                color=ACTIVE,
                alpha=0.7,
                linewidths=0,
                rasterized=len(place) > _MANY_POINTS,
            )
            axes.plot(*_running_median(place[:, j], residual[:, k]), color=DEACTIVATED, linewidth=1.4)
            axes.set_xlim(0, summary.shape[j])
            axes.locator_params(axis="x", nbins=4)
            if k == 1:
                axes.set_xlabel(place_name)
            if j == 0:
                axes.set_ylabel(f"{residual_name}, px")
    return figure


def predicted_map(summary: RegistrationSummary) -> Figure:
    """CE90 that the covariance of the correction predicts over the image."""
    figure, axes = _figure(height_in=_image_height_in(summary.shape))
    ce90_px = summary.qualification.predicted.ce90_px
    edges = [np.linspace(0.0, size, len(ce90_px) + 1) for size in summary.shape]
    finite = ce90_px[np.isfinite(ce90_px)]
    top = float(finite.max()) if len(finite) and finite.max() > 0.0 else 1.0
    axes.pcolormesh(edges[1], edges[0], ce90_px, cmap="Blues", vmin=0.0, vmax=1.6 * top)
    middles = [(edge[1:] + edge[:-1]) / 2.0 for edge in edges]
    for row, column in np.argwhere(np.isfinite(ce90_px)):
        axes.text(
            middles[1][column],
            middles[0][row],
            f"{ce90_px[row, column]:.2f}",
            ha="center",
            va="center",
            color="#10243a",
            fontsize=_TEXT_PT - 1.5,
        )
    axes.set_aspect("equal")
    axes.set_xlim(0, summary.shape[1])
    axes.set_ylim(summary.shape[0], 0)
    axes.set_xlabel("sample")
    axes.set_ylabel("line")
    axes.locator_params(nbins=5)
    return figure


def svg(draw: Callable[[RegistrationSummary], Figure], summary: RegistrationSummary) -> str:
    """A figure as markup for a page: no address, no fixed size, colours and fonts of the page.

    Args:
        draw: one of the functions above.
        summary: what it draws.
    """
    name = draw.__name__
    text = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure = draw(summary)
        figure.patch.set_alpha(0.0)
        figure.savefig(text, format="svg", dpi=160, metadata=nothing)
    markup = text.getvalue()
    markup = markup[markup.index("<svg") :]
    label = (draw.__doc__ or name).splitlines()[0]
    markup = re.sub(
        r'<svg [^>]*viewBox="([^"]*)"[^>]*>',
        rf'<svg viewBox="\1" role="img" aria-label="{label}">',
        markup,
        count=1,
    )
    markup = re.sub(r' id="[A-Za-z][A-Za-z0-9.]*_\d+"', "", markup)
    for drawn, of_the_page in _PAGE_COLOURS.items():
        markup = markup.replace(drawn, of_the_page)
    return markup


def _figure(height_in: float) -> tuple[Figure, Axes]:
    """A figure with one plain pair of axes."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots()
    _style(axes)
    return figure, axes


def _style(axes: Axes) -> None:
    """Thin lines, small text, no box."""
    axes.patch.set_alpha(0.0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(QUIET)
    axes.spines[["left", "bottom"]].set_linewidth(0.6)
    axes.tick_params(colors=QUIET, labelcolor=INK, labelsize=_TEXT_PT - 1, width=0.6, length=3)
    axes.xaxis.label.set(color=INK, fontsize=_TEXT_PT)
    axes.yaxis.label.set(color=INK, fontsize=_TEXT_PT)


def _image_height_in(shape: tuple[int, int]) -> float:
    """Height of a figure that shows an image of that shape over its whole width."""
    return float(np.clip(WIDTH_IN * shape[0] / shape[1], 1.5, 7.5)) + 0.5


def _image_axes(summary: RegistrationSummary, darkness: float) -> tuple[Figure, Axes]:
    """Axes in pixels of the image, over its quicklook."""
    figure, axes = _figure(_image_height_in(summary.shape))
    lines, samples = summary.shape
    axes.set_xlim(-0.5, samples - 0.5)
    axes.set_ylim(lines - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(True)
    axes.spines[:].set_color(QUIET)
    if summary.quicklook is not None:
        _show_quicklook(axes, summary.quicklook, darkness)
    return figure, axes


def _show_quicklook(axes: Axes, quicklook: Quicklook, darkness: float) -> None:
    """The reduced scene, stretched and darkened so that what lies on it is seen."""
    pixels = np.where(quicklook.pixels == 0.0, np.nan, quicklook.pixels)
    finite = pixels[np.isfinite(pixels)]
    if not len(finite):
        return
    low, high = np.percentile(finite, [1.0, 99.0])
    high = low + max(float(high - low), 1e-6) / darkness
    height, width = pixels.shape
    axes.imshow(
        np.ma.masked_invalid(pixels),
        cmap="gray",
        vmin=low,
        vmax=high,
        extent=(
            -0.5,
            width * quicklook.reduction - 0.5,
            height * quicklook.reduction - 0.5,
            -0.5,
        ),
        aspect="equal",
    )


def _scatter_by_status(axes: Axes, north_east: Array, matched: BoolArray, active: BoolArray) -> None:
    """Points (n, 2) in the colour of what became of them."""
    for shown, colour, size in (
        (~matched, NOT_MATCHED, 6),
        (matched & ~active, DEACTIVATED, 9),
        (active, ACTIVE, 9),
    ):
        axes.scatter(
            north_east[shown, 1],
            north_east[shown, 0],
            s=size,
            color=colour,
            linewidths=0,
            rasterized=len(north_east) > _MANY_POINTS,
        )


def _scatter_reasons(axes: Axes, summary: RegistrationSummary) -> None:
    """Points where the refined model sees them: active ones as discs, others by reason."""
    measures = summary.measures
    place = summary.adjustment.correction.apply(measures.predicted)
    many = len(place) > _MANY_POINTS
    kinds = [
        (~measures.matched, NOT_MATCHED, "not matched"),
        (measures.matched & ~measures.active, DEACTIVATED, "deactivated"),
    ]
    for left, colour, stage in kinds:
        reasons = [r for r in count_reasons(measures) if r.stage == stage]
        for k, reason in enumerate(reasons):
            shown = left & (
                np.where(measures.reason == "", "no reason given", measures.reason) == reason.reason
            )
            axes.scatter(
                place[shown, 1],
                place[shown, 0],
                s=18,
                marker=_REASON_MARKERS[min(k, len(_REASON_MARKERS) - 1)],
                color="#c9ced4" if colour == NOT_MATCHED and summary.quicklook is not None else colour,
                linewidths=1.0,
                label=f"{_shortened(reason.reason)} ({reason.count})",
                rasterized=many,
            )
    active = measures.active
    if active.any():
        axes.scatter(
            place[active, 1],
            place[active, 0],
            s=16,
            color=ACTIVE,
            edgecolors="white",
            linewidths=0.4,
            label=f"active ({int(active.sum())})",
            rasterized=many,
        )


def _running_median(position: Array, value: Array, bins: int = 8) -> tuple[Array, Array]:
    """Medians of equal parts of the points in order of position; empty with too few of them."""
    finite = np.isfinite(position) & np.isfinite(value)
    if finite.sum() < 3 * bins:
        return np.empty(0), np.empty(0)
    order = np.argsort(position[finite])
    parts = zip(
        np.array_split(position[finite][order], bins),
        np.array_split(value[finite][order], bins),
        strict=True,
    )
    medians = np.array([(np.median(place), np.median(part)) for place, part in parts])
    return medians[:, 0], medians[:, 1]


def _round_number(value: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten; 1 for nothing."""
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * min((1.0, 2.0, 5.0, 10.0), key=lambda step: abs(step - value / power)))


def _shortened(text: str, length: int = 34) -> str:
    """Text that fits a label; signs that matplotlib would read as formulas are taken as they are."""
    short = text if len(text) <= length else text[: length - 1] + "…"
    return short.replace("$", r"\$")
