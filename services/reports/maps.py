"""The maps of a report: points, residuals and predicted accuracy, on the ground or on the image."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from services.geodesy import metres_per_degree
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
from services.reports.reasons import NO_REASON
from services.reports.report import RegistrationReport
from services.sensors.correction import ImageCorrection
from services.types import Array, BoolArray

_REASON_MARKERS = ("x", "+", "^", "s", "d")


def ground_overview(report: RegistrationReport) -> Figure:
    """The footprint of the scene and its points, kilometres east and north of its middle."""
    figure, axes = plain_axes(height_in=3.6)
    outline, measures = report.scene.footprint_lon_lat, report.figure_data.measures
    places = outline if len(outline) else measures.lon_lat_h[:, :2]
    centre = places.mean(axis=0) if len(places) else np.zeros(2)
    km = np.array(metres_per_degree(float(centre[1]), 0.0)) / 1000.0
    if len(outline):
        ring = (np.concatenate([outline, outline[:1]]) - centre) * km
        axes.fill(*ring.T, facecolor=ACTIVE, alpha=0.10, edgecolor="none")
        axes.plot(*ring.T, color=ACTIVE, linewidth=1.0)
    offset = measures.lon_lat_h[:, :2] - centre
    offset[:, 0] = (offset[:, 0] + 180.0) % 360.0 - 180.0
    _scatter_by_status(axes, offset[:, ::-1] * km[::-1], measures.matched, measures.active)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("km east")
    axes.set_ylabel("km north")
    axes.grid(color=QUIET, alpha=0.25, linewidth=0.5)
    return figure


def residual_map(report: RegistrationReport) -> Figure:
    """Residual vectors of the active points on the image, enlarged, with an arrow for the scale."""
    figure, axes = image_axes(report, darkness=0.45)
    measures = report.figure_data.measures
    drawn = measures.active & np.isfinite(measures.residual_px).all(axis=1)
    residual, place = measures.residual_px[drawn], measures.line_sample[drawn]
    axes.set_title(" " if len(residual) else "no active points", color=INK, fontsize=TEXT_PT, pad=10)
    if not len(residual):
        return figure
    length_px = np.hypot(*residual.T)
    key_px = round_number(float(np.quantile(length_px, 0.9)))
    crowd = crowding(len(residual))
    enlarged = 0.06 * crowd * float(np.hypot(*report.scene.shape)) / key_px
    arrows = axes.quiver(
        place[:, 1],
        place[:, 0],
        residual[:, 1] * enlarged,
        residual[:, 0] * enlarged,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=ARROW if report.figure_data.quicklook is not None else ACTIVE,
        width=0.0035 * crowd,
    )
    axes.quiverkey(
        arrows,
        X=0.06,
        Y=1.04,
        U=key_px * enlarged,
        angle=0.0,
        label=f"{key_px:g} px = {key_px * report.scene.gsd_m:.2g} m",
        labelpos="E",
        color=ACTIVE,
        labelcolor=INK,
        fontproperties={"size": TEXT_PT},
    )
    return figure


def coverage_map(report: RegistrationReport) -> Figure:
    """The points on the image by status and reason, and the cells without an active point."""
    figure, axes = image_axes(report, darkness=0.6)
    cells = report.coverage.cells
    line_edges, sample_edges = (
        np.linspace(-0.5, size - 0.5, len(cells) + 1) for size in report.scene.shape
    )
    for row, column in np.argwhere(cells == 0):
        corner = sample_edges[column], line_edges[row]
        size = sample_edges[1] - sample_edges[0], line_edges[1] - line_edges[0]
        axes.add_patch(Rectangle(corner, *size, facecolor=DEACTIVATED, alpha=0.2, edgecolor="none"))
    axes.vlines(sample_edges[1:-1], line_edges[0], line_edges[-1], color=NOT_MATCHED, linewidth=0.5)
    axes.hlines(line_edges[1:-1], sample_edges[0], sample_edges[-1], color=NOT_MATCHED, linewidth=0.5)
    _scatter_reasons(axes, report)
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
            markerscale=crowding(len(report.figure_data.measures.point_id)) ** -0.5,
        )
    return figure


def predicted_map(report: RegistrationReport) -> Figure:
    """CE90 that the covariance of the correction predicts over the image."""
    figure, axes = plain_axes(height_in=image_height_in(report.scene.shape))
    ce90_px = report.predicted.ce90_px
    edges = [np.linspace(0.0, size, len(ce90_px) + 1) for size in report.scene.shape]
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
    axes.set_xlim(0, report.scene.samples)
    axes.set_ylim(report.scene.lines, 0)
    axes.set_xlabel("sample")
    axes.set_ylabel("line")
    axes.locator_params(nbins=5)
    return figure


def _scatter_by_status(axes: Axes, north_east: Array, matched: BoolArray, active: BoolArray) -> None:
    """Draw points (n, 2) in the colour of their status."""
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


def _scatter_reasons(axes: Axes, report: RegistrationReport) -> None:
    """Draw points where the refined model projects them: active points as discs, others by reason."""
    measures, record = report.figure_data.measures, report.correction
    correction = ImageCorrection(record.parameters_px, record.centre_px, record.half_size_px)
    place = correction.apply(measures.predicted)
    many, crowd = len(place) > MANY_POINTS, crowding(len(place))
    kinds = [
        (~measures.matched, NOT_MATCHED, "not matched"),
        (measures.matched & ~measures.active, DEACTIVATED, "deactivated"),
    ]
    codes = np.where(measures.reason == "", NO_REASON, measures.reason)
    for rows, colour, stage in kinds:
        reasons = [r for r in report.reasons if r.stage == stage]
        for k, reason in enumerate(reasons):
            shown = rows & (codes == reason.reason)
            axes.scatter(
                place[shown, 1],
                place[shown, 0],
                s=18 * crowd,
                marker=_REASON_MARKERS[min(k, len(_REASON_MARKERS) - 1)],
                color="#c9ced4"
                if colour == NOT_MATCHED and report.figure_data.quicklook is not None
                else colour,
                linewidths=1.0,
                label=f"{shortened(reason.label)} ({reason.count})",
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
