"""The reports on a surface and on the difference of two as pages, and their maps."""

from collections.abc import Sequence

import numpy as np

from amers.services.reports.drawing import legend, rgb_values
from amers.services.reports.html import Page
from amers.services.reports.plot import SMALL_TEXT, WIDTH, Figure, Panel
from amers.services.reports.surface import DifferenceReport, ReducedMap, SurfaceReport
from amers.services.surface.match import REASON_LABELS, Reason
from amers.services.surface.relief import (
    CHANGE_COLOURS,
    HEIGHT_COLOURS,
    Colours,
    colours_of,
    relief,
    shown_range,
)
from amers.services.types import BoolArray

_SIGMA_COLOURS = ("#f7fcf0", "#a8ddb5", "#2b8cbe", "#084081")
_REASON_COLOURS = {
    Reason.OUTSIDE: "#c3c8cd",
    Reason.NO_DATA: "#7d8790",
    Reason.SATURATED: "#f5b041",
    Reason.WATER: "#00b7c7",
    Reason.NO_TEXTURE: "#a56bc4",
    Reason.ISOLATED: "#c0392b",
    Reason.HIDDEN: "#3b3030",
}
_CHANGES = (
    ("within 1 sigma", "#e3e5e8"),
    ("1 to 3 sigma", "#b9bfc6"),
    ("lower, over 3 sigma", CHANGE_COLOURS[0]),
    ("higher, over 3 sigma", CHANGE_COLOURS[-1]),
)
_TALLEST = 340.0
_LEFT, _AXIS, _BAR, _ROW = 44.0, 34.0, 44.0, 12.0
_SHADES = np.linspace(0.0, 1.0, 256)


def surface_map(report: SurfaceReport) -> Figure:
    """The surface in colours of its heights, under a light from the north-west.

    Height of the surface, under a light from the north-west. Cells without a height are left out.
    """
    height_m = report.map.bands[0]
    limits_m = shown_range(height_m)
    pixels = relief(height_m, float(report.map.grid.step_xy[0, 1]), limits_m)
    figure = _map(report.map, pixels)
    _bar(figure, limits_m, HEIGHT_COLOURS, "m above the ellipsoid")
    return figure


def sigma_map(report: SurfaceReport) -> Figure:
    """The standard deviation of the heights, and why other cells have none.

    Standard deviation of the heights, and cells without a height by their reason.
    """
    _, sigma_m, _, reason = report.map.bands
    limits_m = (0.0, shown_range(sigma_m)[1])
    pixels = colours_of(sigma_m, limits_m, _SIGMA_COLOURS)
    present = [one for one in _REASON_COLOURS if REASON_LABELS[one] in report.cells]
    for one in present:
        pixels[reason == one] = _opaque(_REASON_COLOURS[one])
    figure = _map(report.map, pixels)
    _bar(figure, limits_m, _SIGMA_COLOURS, "m, one standard deviation")
    for one in present:
        figure.box((_LEFT, figure.height), (9.0, 8.0), _REASON_COLOURS[one])
        figure.text(_LEFT + 13.0, figure.height + 7.5, REASON_LABELS[one], size=SMALL_TEXT)
        figure.height += _ROW
    return figure


def difference_map(report: DifferenceReport) -> Figure:
    """The height of the later above the earlier surface: red where it rose, blue where it sank.

    Height of the later above the earlier surface.
    """
    low, high = shown_range(np.abs(report.map.bands[0]))
    limits_m = (-high, high) if low < high else (-1.0, 1.0)
    figure = _map(report.map, colours_of(report.map.bands[0], limits_m, CHANGE_COLOURS))
    _bar(figure, limits_m, CHANGE_COLOURS, "m, later less earlier")
    return figure


def significance_map(report: DifferenceReport) -> Figure:
    """Where the difference is larger than its standard deviation can explain.

    The same against its standard deviation. Noise alone exceeds 3 sigma in 3 of 1,000 cells.
    """
    significance = report.map.bands[2]
    size = np.abs(significance)
    kinds: tuple[BoolArray, ...] = (size <= 1.0, size <= 3.0, significance < -3.0, significance > 3.0)
    pixels = np.zeros((*significance.shape, 4), dtype=np.uint8)
    for cells, (_, colour) in reversed(list(zip(kinds, _CHANGES, strict=True))):
        pixels[cells] = _opaque(colour)
    figure = _map(report.map, pixels)
    legend(figure, figure.height + 8.0, _CHANGES)
    figure.height += 2.0 * _ROW + 2.0
    return figure


def _opaque(colour: str) -> Colours:
    return np.append(rgb_values([colour])[0], np.uint8(255))


def _map(shown: ReducedMap, pixels: Colours) -> Figure:
    """A figure with a map of pixels (lines, samples, 4), in metres from its south-western corner."""
    (lines, samples), step_m = shown.grid.shape, np.abs(shown.grid.step_xy)
    height_m, width_m = lines * float(step_m[1, 0]), samples * float(step_m[0, 1])
    scale = min((WIDTH - _LEFT - 8.0) / width_m, _TALLEST / height_m)
    figure = Figure(height_m * scale + 6.0 + _AXIS)
    panel = Panel(figure, _LEFT, 6.0, width_m * scale, height_m * scale, (0.0, width_m), (0.0, height_m))
    panel.picture(pixels)
    panel.frame()
    panel.x_axis("m east", count=6)
    panel.y_axis("m north")
    return figure


def _bar(figure: Figure, limits: tuple[float, float], ramp: Sequence[str], unit: str) -> None:
    """Write the colours of values below a figure, which grows."""
    bar = Panel(figure, _LEFT, figure.height, WIDTH - _LEFT - 8.0, 8.0, limits, (0.0, 1.0))
    bar.picture(colours_of(_SHADES, (0.0, 1.0), ramp)[None])
    bar.x_axis(unit, count=6)
    figure.height += _BAR


SURFACE_PAGE = Page("surface.html", (surface_map, sigma_map))
DIFFERENCE_PAGE = Page("surface_difference.html", (difference_map, significance_map))
