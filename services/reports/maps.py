"""The maps of a report: what is drawn on the ground or on the image."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from services.reports.drawing import (
    ACTIVE,
    ARROW,
    DEACTIVATED,
    INK,
    MANY_POINTS,
    NOT_MATCHED,
    QUIET,
    TEXT_PT,
    crowding,
    image_axes,
    image_height_in,
    plain_axes,
    round_number,
    shortened,
)
from services.reports.report import count_reasons
from services.reports.summary import RegistrationSummary
from services.reports.tables import reason_words
from services.types import Array, BoolArray

_REASON_MARKERS = ("x", "+", "^", "s", "d")
_M_PER_DEG = 111_320.0


def ground_overview(summary: RegistrationSummary) -> Figure:
    """The footprint of the scene and its points, kilometres east and north of its middle."""
    figure, axes = plain_axes(height_in=3.6)
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
    figure, axes = image_axes(summary, darkness=0.45)
    measures = summary.measures
    drawn = measures.active & np.isfinite(measures.residual_px).all(axis=1)
    residual, place = measures.residual_px[drawn], measures.line_sample[drawn]
    axes.set_title(" " if len(residual) else "no active points", color=INK, fontsize=TEXT_PT, pad=10)
    if not len(residual):
        return figure
    length_px = np.hypot(*residual.T)
    key_px = round_number(float(np.quantile(length_px, 0.9)))
    crowd = crowding(len(residual))
    enlarged = 0.06 * crowd * float(np.hypot(*summary.shape)) / key_px
    arrows = axes.quiver(
        place[:, 1],
        place[:, 0],
        residual[:, 1] * enlarged,
        residual[:, 0] * enlarged,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=ARROW if summary.quicklook is not None else ACTIVE,
        width=0.0035 * crowd,
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
        fontproperties={"size": TEXT_PT},
    )
    return figure


def coverage_map(summary: RegistrationSummary) -> Figure:
    """Where points are in the image, what became of them, and the cells without an active one."""
    figure, axes = image_axes(summary, darkness=0.6)
    cells = summary.qualification.coverage.cells
    line_edges, sample_edges = (np.linspace(-0.5, size - 0.5, len(cells) + 1) for size in summary.shape)
    for row, column in np.argwhere(cells == 0):
        corner = sample_edges[column], line_edges[row]
        size = sample_edges[1] - sample_edges[0], line_edges[1] - line_edges[0]
        axes.add_patch(Rectangle(corner, *size, facecolor=DEACTIVATED, alpha=0.2, edgecolor="none"))
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
            fontsize=TEXT_PT - 1,
            labelcolor=INK,
            handletextpad=0.3,
            markerscale=crowding(len(summary.measures.point_id)) ** -0.5,
        )
    return figure


def predicted_map(summary: RegistrationSummary) -> Figure:
    """CE90 that the covariance of the correction predicts over the image."""
    figure, axes = plain_axes(height_in=image_height_in(summary.shape))
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
            fontsize=TEXT_PT - 1.5,
        )
    axes.set_aspect("equal")
    axes.set_xlim(0, summary.shape[1])
    axes.set_ylim(summary.shape[0], 0)
    axes.set_xlabel("sample")
    axes.set_ylabel("line")
    axes.locator_params(nbins=5)
    return figure


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
            rasterized=len(north_east) > MANY_POINTS,
        )


def _scatter_reasons(axes: Axes, summary: RegistrationSummary) -> None:
    """Points where the refined model sees them: active ones as discs, others by reason."""
    measures = summary.measures
    place = summary.adjustment.correction.apply(measures.predicted)
    many, crowd = len(place) > MANY_POINTS, crowding(len(place))
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
                s=18 * crowd,
                marker=_REASON_MARKERS[min(k, len(_REASON_MARKERS) - 1)],
                color="#c9ced4" if colour == NOT_MATCHED and summary.quicklook is not None else colour,
                linewidths=1.0,
                label=f"{shortened(reason_words(reason.reason))} ({reason.count})",
                rasterized=many,
            )
    active = measures.active
    if active.any():
        axes.scatter(
            place[active, 1],
            place[active, 0],
            s=16 * crowd,
            color=ACTIVE,
            edgecolors="white",
            linewidths=0.4,
            label=f"active ({int(active.sum())})",
            rasterized=many,
        )
