"""The report on a selection of images as a page, and its maps."""

import numpy as np
import numpy.typing as npt

from amers.services.production.image_selection import CellViews
from amers.services.reports.drawing import legend, rgb_values
from amers.services.reports.html import Page
from amers.services.reports.plot import WIDTH, Figure, Panel
from amers.services.reports.selection import SelectionReport, share_words, views_words
from amers.services.types import Array

_REACHED = "#7fb2e5"
_RELAXED = ("#ffe08a", "#f5b041", "#d68910", "#935116")
_SHORT = ("#f1948a", "#e74c3c", "#b3372f", "#7b241c")
_FEW, _ENOUGH, _MANY = np.array([179, 55, 47]), np.array([214, 232, 250]), np.array([0, 72, 160])
_TALLEST = 420.0
_PIXELS_ACROSS = 1000
_LEGEND_HEIGHT, _LEGEND_TOP = 52.0, 44.0

Colours = npt.NDArray[np.uint8]


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


def state_map(report: SelectionReport) -> Figure:
    """The ground: enough views below the first cloud limit, with relaxed limits, or too few.

    Blue: enough clear views by images below the first cloud limit. Yellow to brown: the catalogue
    has too few of these, and cloudier images count outside of their masks. Red: short of views with
    all usable images.
    """
    selection = report.selection
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
    present = [k for k in range(len(names)) if (kind == k).any()]
    figure = _cell_map(cells, rgb_values(colours)[kind])
    legend(figure, figure.height - _LEGEND_TOP, [(names[k], colours[k]) for k in present])
    return figure


def views_map(report: SelectionReport) -> Figure:
    """Clear views of the ground by the chosen images.

    Clear views by the chosen images that count in each cell.
    """
    selection = report.selection
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
    entries = [(names.get(k, str(k)), "#{:02x}{:02x}{:02x}".format(*rgb[k])) for k in shown]
    legend(figure, figure.height - _LEGEND_TOP, entries)
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


SELECTION_PAGE = Page("selection.html", (state_map, views_map, share_words, use_rows, views_words))
