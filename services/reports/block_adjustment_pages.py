"""The report on the adjustment of a block as tables for a terminal and as a page with figures."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from rich.markup import escape
from rich.table import Table

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.geodesy import east_north_up
from amers.services.production.block_residuals import FITS, ImageFit
from amers.services.reports.block_adjustment import ALL_FITS, AdjustmentReport
from amers.services.reports.drawing import ACTIVE, DEACTIVATED, crowding
from amers.services.reports.html import page_template
from amers.services.reports.maps import equal_panel
from amers.services.reports.plot import QUIET, SMALL_TEXT, Figure
from amers.services.types import Array

_HEIGHT = 300.0
_LEGEND_ROW = 16.0
_CLASSES = ("#7fb2e5", "#e6c35c", "#b2453c")
_CIRCLE = np.linspace(0.0, 2.0 * np.pi, 73)
_LISTED = 40
"""Most images that a terminal lists, the odd ones first."""


def format_adjustment_html(report: AdjustmentReport) -> str:
    """The report as a self-contained page for screen, phone and paper."""
    return page_template("block_adjustment.html").render(
        report=report,
        fits=FITS,
        tone="good" if report.verdict == ALL_FITS else "usable",
        points_map=Markup(points_map(report).markup("Residuals of the points of the block")),
        offsets=Markup(offsets(report).markup("Corrections of the images at their centres")),
    )


def adjustment_table(images: Sequence[ImageFit]) -> Table:
    """The images of a block for a terminal, those first that should be looked at."""
    listed = sorted(images, key=lambda image: image.verdict == FITS)[:_LISTED]
    title = "Images of the block"
    if len(images) > _LISTED:
        title += f": {_LISTED} of {len(images)}, all of them in the report"
    table = Table(title=title, title_justify="left")
    for name in ("image", "measures", "used", "rms px", "off E, N m", "stated m", "verdict"):
        text = name in ("image", "verdict")
        table.add_column(name, justify="left" if text else "right", overflow="fold")
    for image in listed:
        table.add_row(*_cells(image))
    return table


def _cells(image: ImageFit) -> tuple[str, ...]:
    return (
        escape(image.name),
        f"{image.measures:,}",
        f"{image.used:,}",
        f"{np.hypot(*image.rms_px):.2f}",
        f"{image.off_m[0]:.1f}, {image.off_m[1]:.1f}",
        f"{image.stated_m:.1f}",
        escape(image.verdict),
    )


def points_map(report: AdjustmentReport) -> Figure:
    """The points by their longest residual against that of the middle point; kilometres."""
    figure = Figure(_HEIGHT + _LEGEND_ROW)
    places = _kilometres(report.lon_lat_h)
    figure.height = _HEIGHT
    panel = equal_panel(figure, places)
    figure.height = _HEIGHT + _LEGEND_ROW
    panel.x_axis("km east", count=8, grid=True)
    panel.y_axis("km north", grid=True)
    largest = report.points.largest_px
    edges = np.array([2.0, 4.0]) * max(float(np.median(largest)), 1e-6)
    kind = np.searchsorted(edges, largest)
    names = (f"up to {edges[0]:.2f} px", f"up to {edges[1]:.2f} px", "more")
    size = 3.6 * max(0.4, crowding(len(places)))
    x = 8.0
    for number, (name, colour) in enumerate(zip(names, _CLASSES, strict=True)):
        rows = kind == number
        figure.discs(panel.places(*places[rows].T), size, colour)
        figure.discs(np.array([[x, _HEIGHT + 8.0]]), 5.0, colour)
        words = f"{name}: {int(rows.sum())}"
        figure.text(x + 7.0, _HEIGHT + 11.0, words, size=SMALL_TEXT)
        x += 24.0 + 5.2 * len(words)
    return figure


def offsets(report: AdjustmentReport) -> Figure:
    """By how much the delivered models were off, metres; the circle is three times what was stated."""
    figure = Figure(_HEIGHT)
    off_m = np.array([image.off_m for image in report.images]).reshape(-1, 2)
    odd = np.array([image.verdict != FITS for image in report.images], dtype=bool)
    stated_m = max(image.stated_m for image in report.images)
    circle = MAX_ERROR_SIGMAS * stated_m * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    panel = equal_panel(figure, np.concatenate([off_m, circle]))
    panel.x_axis("m east", count=8, grid=True)
    panel.y_axis("m north", grid=True)
    figure.line(panel.places(*circle.T), QUIET, 1.0)
    for rows, colour in ((~odd, ACTIVE), (odd, DEACTIVATED)):
        figure.discs(panel.places(*off_m[rows].T), 5.0, colour)
    return figure


def _kilometres(lon_lat_h: Array) -> Array:
    middle = np.array([*np.median(lon_lat_h[:, :2], axis=0), 0.0])
    return np.asarray(east_north_up(lon_lat_h, middle)[:, :2] / 1000.0)
