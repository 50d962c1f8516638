"""The report on a selection of images as tables for a terminal, as a page, and as maps."""

import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from rich.table import Table

from amers.services.production.image_selection import CellViews, ImageSelection
from amers.services.reports.html import page_template
from amers.services.reports.plot import SMALL_TEXT, WIDTH, Figure, Panel
from amers.services.reports.selection import (
    COMPLETE,
    RELAXED,
    SelectionReport,
    share_words,
    views_words,
)
from amers.services.types import Array

_TONES = {COMPLETE: "good", RELAXED: "usable"}
_REACHED = "#7fb2e5"
_RELAXED = ("#ffe08a", "#f5b041", "#d68910", "#935116")
_SHORT = ("#f1948a", "#e74c3c", "#b3372f", "#7b241c")
_FEW, _ENOUGH, _MANY = np.array([179, 55, 47]), np.array([214, 232, 250]), np.array([0, 72, 160])
_TALLEST = 420.0
_PIXELS_ACROSS = 1000
_LEGEND_HEIGHT = 52.0

Colours = npt.NDArray[np.uint8]


def format_selection_html(report: SelectionReport, selection: ImageSelection) -> str:
    """The report as a self-contained page for screen, phone and paper."""
    return page_template("selection.html").render(
        report=report,
        tone=_TONES.get(report.verdict, "failed"),
        state_map=Markup(state_map(selection).markup("Ground with enough views, relaxed and short")),
        views_map=Markup(views_map(selection).markup("Clear views of the ground")),
        share=share_words,
        views_words=views_words,
        use=use_rows(report),
    )


def selection_tables(report: SelectionReport) -> list[Table]:
    """The report as tables for a terminal."""
    use = Table("images", "number", title="Images of the catalogue", title_justify="left")
    for words, number in use_rows(report):
        use.add_row(words, f"{number:,}")
    limits = Table(
        "cloud below",
        "chosen images",
        "km2 with this limit",
        "share",
        title="Cloud limits",
        title_justify="left",
    )
    for row in report.limits:
        cells = f"{row.images:,}", f"{row.area_km2:,.0f}", share_words(row.share)
        limits.add_row(f"{row.below_percent:g} %", *cells)
    overlap = Table(
        "clear views", "km2", "share", "share by all usable", title="Overlap", title_justify="left"
    )
    for views in report.overlap:
        shares = share_words(views.share), share_words(views.share_available)
        overlap.add_row(views_words(views, report), f"{views.area_km2:,.0f}", *shares)
    for table in (use, limits, overlap):
        for column in table.columns[1:]:
            column.justify = "right"
    return [use, limits, overlap]


def use_rows(report: SelectionReport) -> list[tuple[str, int]]:
    """What became of the items of the catalogue, in words, with their numbers."""
    use, limits = report.use, report.options.cloud_limits_percent
    rows = [
        ("items that cannot be read", report.source.bad),
        ("before the first time asked for", report.source.older),
        ("second products of an acquisition", use.duplicates),
        (f"more than {report.options.max_snow_percent:g} % snow", use.snow),
        ("cloud cover unknown, and no mask", use.cloud_unknown),
        (f"{limits[-1]:g} % cloud or more", use.too_cloudy),
        (f"{limits[0]:g} % cloud or more, and no mask", use.without_mask),
    ]
    shown = [row for row in rows if row[1]]
    return [*shown, ("usable", use.usable), ("chosen", use.selected)]


def state_map(selection: ImageSelection) -> Figure:
    """The ground: enough views below the first cloud limit, with relaxed limits, or too few."""
    cells, options = selection.cells, selection.options
    missing = selection.missing
    steps = len(options.cloud_limits_percent)
    names = [f"{options.min_views} views or more"]
    colours = [_REACHED]
    for step in range(1, steps):
        names.append(f"cloud below {options.cloud_limits_percent[step]:g} %")
        colours.append(_RELAXED[min(step - 1, len(_RELAXED) - 1)])
    kind = cells.step.copy()
    for count in range(1, options.min_views + 1):
        kind[missing == count] = steps + count - 1
        names.append(f"{count} missing")
        place = (count - 1) * len(_SHORT) // options.min_views
        colours.append(_SHORT[place])
    rgb = np.array([[int(c[k : k + 2], 16) for k in (1, 3, 5)] for c in colours], dtype=np.uint8)
    present = [k for k in range(len(names)) if (kind == k).any()]
    figure = _cell_map(cells, rgb[kind])
    _legend(figure, [(names[k], colours[k]) for k in present])
    return figure


def views_map(selection: ImageSelection) -> Figure:
    """Clear views of the ground by the chosen images."""
    needed = selection.options.min_views
    views = np.arange(2 * needed + 1)
    below = (views / needed)[:, None]
    above = ((views - needed) / needed)[:, None]
    ramp = np.where(
        below < 1.0, _FEW + 0.8 * below * (_ENOUGH - _FEW), _ENOUGH + above * (_MANY - _ENOUGH)
    )
    rgb = np.clip(np.round(ramp), 0, 255).astype(np.uint8)
    figure = _cell_map(selection.cells, rgb[np.minimum(selection.cells.views, 2 * needed)])
    shown = sorted({0, needed // 2, needed - 1, needed, needed + needed // 2, 2 * needed})
    names = {2 * needed: f"{2 * needed} or more"}
    _legend(figure, [(names.get(k, str(k)), "#{:02x}{:02x}{:02x}".format(*rgb[k])) for k in shown])
    return figure


def _cell_map(cells: CellViews, rgb: Colours) -> Figure:
    """A map, longitude by latitude, of cells (n,) with colours (n, 3)."""
    low, high = cells.grid.boxes(cells.cell)
    west, east = _longitudes(low[:, 0], high[:, 0])
    south, north = float(low[:, 1].min()), float(high[:, 1].max())
    squeeze = max(0.2, float(np.cos(np.radians((south + north) / 2.0))))
    room = np.array([WIDTH - 64.0, _TALLEST])
    size = np.array([(east - west) * squeeze, north - south])
    width, height = (size * float((room / size).min())).tolist()
    figure = Figure(height + 46.0 + _LEGEND_HEIGHT)
    panel = Panel(figure, 52.0, 6.0, width, height, (west, east), (south, north))
    columns = _PIXELS_ACROSS
    rows = max(1, round(columns * height / width))
    lon = west + (np.arange(columns) + 0.5) / columns * (east - west)
    lat = north - (np.arange(rows) + 0.5) / rows * (north - south)
    place = np.stack(np.meshgrid(lon, lat), axis=-1).reshape(-1, 2)
    number = cells.grid.cell_of(place)
    row = np.minimum(np.searchsorted(cells.cell, number), len(cells.cell) - 1)
    pixels = np.zeros((len(number), 4), dtype=np.uint8)
    found = cells.cell[row] == number
    pixels[found] = np.column_stack([rgb[row[found]], np.full(int(found.sum()), 255)])
    panel.picture(pixels.reshape(rows, columns, 4))
    panel.frame()
    panel.x_axis("degrees east", count=8)
    panel.y_axis("degrees north")
    return figure


def _longitudes(west: Array, east: Array) -> tuple[float, float]:
    """The shortest range of longitudes that includes cells; across the antimeridian where it must."""
    starts = np.unique(west)
    gaps = np.diff(np.concatenate([starts, [starts[0] + 360.0]]))
    after = int(gaps.argmax())
    if gaps[after] < 2.0 * float((east - west).max()) + 1e-9:
        return -180.0, 180.0
    first = float(starts[(after + 1) % len(starts)])
    return first, first + float(((east - first - 1e-9) % 360.0).max())


def _legend(figure: Figure, entries: list[tuple[str, str]]) -> None:
    """Write names with boxes of their colours below a map."""
    columns = 3
    for k, (name, colour) in enumerate(entries):
        x = 52.0 + (k % columns) * (WIDTH - 60.0) / columns
        y = figure.height - _LEGEND_HEIGHT + 12.0 * (k // columns) + 8.0
        figure.box((x, y - 7.0), (9.0, 8.0), colour)
        figure.text(x + 13.0, y, name, size=SMALL_TEXT)
