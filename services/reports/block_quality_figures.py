"""The figures of the report on a block: density, views, height errors and planimetric errors."""

from collections.abc import Sequence

import numpy as np

from amers.services.geodesy import metres_per_degree
from amers.services.quality.block import HALF_PER_KM2, QUARTER_PER_KM2
from amers.services.reports.block_quality import BlockQualityReport
from amers.services.reports.drawing import (
    ACTIVE,
    DEACTIVATED,
    crowding,
    legend,
    rgb_values,
    round_number,
)
from amers.services.reports.maps import equal_panel
from amers.services.reports.plot import (
    INK,
    QUIET,
    SMALL_TEXT,
    WIDTH,
    Figure,
    Panel,
    left_margin,
    widened,
)
from amers.services.types import Array, IntArray

_LEGEND = 20.0
_TALLEST = 300.0
_PIXELS_ACROSS = 900
_LOW, _MIDDLE, _HIGH = "#b2453c", "#e6c35c", "#7fb2e5"
_ABOVE, _BELOW = "#c0392b", "#2f6fb0"
"""Colours of points above and below the height model."""


def density_map(report: BlockQualityReport) -> Figure:
    """The density of the cells of 0.1 degree against what is specified, else 1 point / 2 and / 4 km2.

    Density by cells of 0.1 degree, on ground inside the outline that is not excluded.
    """
    density = np.array([cell.points_per_km2 for cell in report.density.cells])
    required = report.requirements.points_per_km2
    if required is None:
        kind = (density >= QUARTER_PER_KM2).astype(int) + (density >= HALF_PER_KM2)
        names = ("below 1 / 4 km²", "below 1 / 2 km²", "1 / 2 km² or more")
    else:
        met = np.array([cell.outcome == "met" for cell in report.density.cells], dtype=bool)
        kind = np.where(met, 2, (density >= required / 2.0).astype(int))
        names = (f"below {required / 2.0:.3g} / km²", f"below {required:.3g} / km²", "as specified")
    figure = _cell_map(report, kind, (_LOW, _MIDDLE, _HIGH))
    _legend(figure, list(zip(names, (_LOW, _MIDDLE, _HIGH), strict=True)))
    return figure


def views_map(report: BlockQualityReport) -> Figure:
    """The median number of images of the points in each cell of 0.1 degree.

    Median number of images that show a point, by cells of 0.1 degree.
    """
    images = np.array([cell.images for cell in report.density.cells])
    needed = report.requirements.min_views
    shades = ("#7b241c", "#d9776c", "#cfe0f1", "#9fc4e8", "#5f9bd6", "#23588f")
    edges = np.array([1.0, needed, needed + 2.0, needed + 4.0, needed + 8.0])
    kind = np.where(np.isnan(images), 0, np.searchsorted(edges, images, side="right"))
    figure = _cell_map(report, kind, shades)
    texts = ["no points", f"below {needed}", *(f"{edge:.0f} or more" for edge in edges[1:])]
    shown = [k for k in range(len(shades)) if (kind == k).any()]
    _legend(figure, [(texts[k], shades[k]) for k in shown])
    return figure


def height_histogram(report: BlockQualityReport) -> Figure:
    """Distribution of the height errors, cut at the ends, with LE90 on both sides.

    Height of the points minus that of the model; the ends hold all farther points. 90 % lie between
    the orange lines.
    """
    figure = Figure(176.0)
    errors = report.errors.heights
    if errors is None or report.heights is None or not len(errors.error_m):
        return _nothing(figure)
    values = errors.error_m
    low, high = np.quantile(values, [0.005, 0.995])
    le90_m = report.heights.on_the_earth.le90_m.value
    reach = max(abs(low), abs(high), 1.1 * le90_m, 1e-3)
    counts, edges = np.histogram(np.clip(values, -reach, reach), np.linspace(-reach, reach, 42))
    y_range = (0.0, 1.08 * float(counts.max()))
    left = left_margin(y_range)
    panel = Panel(figure, left, 8.0, WIDTH - left - 6.0, 128.0, (-reach, reach), y_range)
    panel.x_axis("point minus model, m", count=6)
    panel.y_axis("points", grid=True)
    tops, bottoms = panel.places(edges[:-1], counts), panel.places(edges[1:], 0.0 * counts)
    for top, bottom in zip(tops, bottoms, strict=True):
        figure.box((top[0], top[1]), tuple(np.maximum(bottom - top - [0.4, 0.0], 0.0)), ACTIVE)
    for side in (-le90_m, le90_m):
        ends = panel.places(np.array([side, side]), np.array(y_range))
        figure.line(ends, DEACTIVATED, 1.2)
    place = panel.places(np.array([le90_m]), np.array([y_range[1]]))[0]
    figure.text(place[0] - 3.0, place[1] + 8.0, f"LE90 {le90_m:.2f} m", anchor="end", size=SMALL_TEXT)
    return figure


def height_map(report: BlockQualityReport) -> Figure:
    """The points by their height error: red above the model, blue below, pale within half of LE90.

    Points by the error of their heights.
    """
    figure = Figure(300.0)
    errors = report.errors.heights
    if errors is None or report.heights is None or not len(errors.error_m):
        return _nothing(figure)
    panel = _ground_panel(figure, report, _LEGEND)
    le90_m = report.heights.on_the_earth.le90_m.value
    x, y = _continuous(errors.lon_lat, report.errors.outline).T
    size = 3.6 * max(0.4, crowding(len(x)))
    value = errors.error_m
    classes = (
        (np.abs(value) <= le90_m / 2.0, "#aab4be", f"within {le90_m / 2.0:.1f} m"),
        ((value > le90_m / 2.0) & (value <= le90_m), "#e7a29a", f"up to {le90_m:.1f} m above"),
        ((value < -le90_m / 2.0) & (value >= -le90_m), "#9fc0e2", f"up to {le90_m:.1f} m below"),
        (value > le90_m, _ABOVE, "farther above"),
        (value < -le90_m, _BELOW, "farther below"),
    )
    for rows, colour, _ in classes:
        figure.discs(panel.places(x[rows], y[rows]), size, colour)
    _legend(figure, [(name, colour) for rows, colour, name in classes if rows.any()])
    return figure


def error_scatter(report: BlockQualityReport) -> Figure:
    """Planimetric errors, east and north, of the first source; the circle holds 90 %.

    Errors east and north: blue at check-only sites, orange at control sites. The circle holds 90 %
    of all.
    """
    figure = Figure(330.0)
    if not report.planimetry:
        return _nothing(figure)
    source = report.planimetry[0]
    sites = [s for s in report.errors.sites if (s.source == "points") == (source.source == "points")]
    ce90_m = source.groups[0].accuracy.ce90_m.value
    error_m = np.concatenate([site.error_m for site in sites])
    if not len(error_m):
        return _nothing(figure)
    reach = max(1.15 * ce90_m, float(np.quantile(np.abs(error_m), 0.98)), 1e-3)
    panel = equal_panel(figure, np.array([[-reach, -reach], [reach, reach]]))
    panel.x_axis("m east", count=8, grid=True)
    panel.y_axis("m north", count=6, grid=True)
    with panel.clipped():
        for is_control, colour in ((True, DEACTIVATED), (False, ACTIVE)):
            of_kind = [site.error_m for site in sites if site.is_control == is_control]
            if of_kind:
                errors = np.concatenate(of_kind)
                figure.discs(panel.places(*errors.T), 3.4 * crowding(len(error_m)), colour, 0.7)
        angle = np.linspace(0.0, 2.0 * np.pi, 90)
        circle = panel.places(ce90_m * np.cos(angle), ce90_m * np.sin(angle))
        figure.line(circle, INK, 1.0)
        top = panel.places(np.zeros(1), np.array([ce90_m]))[0]
        figure.text(top[0], top[1] - 4.0, f"CE90 {ce90_m:.2f} m", anchor="middle", size=SMALL_TEXT)
    return figure


def site_map(report: BlockQualityReport) -> Figure:
    """The sites in the outline of the block, with their mean errors as arrows, enlarged.

    Mean error of each site, enlarged, in the outline of the block.
    """
    figure = Figure(300.0)
    if not report.planimetry:
        return _nothing(figure)
    panel = _ground_panel(figure, report, _LEGEND)
    sites = [site for site in report.planimetry[0].sites if site.accuracy.n]
    if not sites:
        return figure
    place = _continuous(np.array([(site.lon, site.lat) for site in sites]), report.errors.outline)
    bias_m = np.array([site.accuracy.bias_m for site in sites])
    key_m = round_number(float(np.hypot(*bias_m.T).max()))
    points_per_metre = 34.0 / key_m
    tails = panel.places(*place.T)
    heads = tails + points_per_metre * bias_m * [1.0, -1.0]
    for is_control, colour in ((True, DEACTIVATED), (False, ACTIVE)):
        of_kind = np.array([site.is_control == is_control for site in sites])
        figure.discs(tails[of_kind], 6.0, colour)
        figure.arrows(tails[of_kind], heads[of_kind], colour, 1.4)
    if len(sites) <= 12:
        for (x, y), site in zip(tails.tolist(), sites, strict=True):
            figure.text(x + 6.0, y + 10.0, site.name[:24], size=SMALL_TEXT, colour=QUIET)
    y = figure.height - 6.0
    figure.arrows(np.array([[52.0, y - 3.0]]), np.array([[86.0, y - 3.0]]), INK, 1.2)
    figure.text(92.0, y, f"{key_m:g} m", size=SMALL_TEXT)
    return figure


def _nothing(figure: Figure) -> Figure:
    figure.text(WIDTH / 2.0, 20.0, "nothing was measured", anchor="middle")
    return figure


def _cell_map(report: BlockQualityReport, kind: IntArray, colours: Sequence[str]) -> Figure:
    """The cells of 0.1 degree in the outline, each in the colour of its kind."""
    cells = report.density.cells
    corner = np.array([(cell.west, cell.south) for cell in cells]).reshape(-1, 2)
    outline = report.errors.outline
    figure, panel = _map_panel(outline.min(axis=0), outline.max(axis=0))
    if not len(cells):
        return figure
    west, south = corner.min(axis=0).tolist()
    index = np.rint((corner - [west, south]) * 10.0).astype(int)
    across, up = (index.max(axis=0) + 1).tolist()
    pixels = np.zeros((up, across, 4), dtype=np.uint8)
    opaque = np.full((len(cells), 1), 255, dtype=np.uint8)
    pixels[up - 1 - index[:, 1], index[:, 0]] = np.concatenate(
        [rgb_values(colours)[kind], opaque], axis=1
    )
    factor = max(1, _PIXELS_ACROSS // across)
    with panel.clipped():
        whole = Panel(
            figure,
            *_box_of(panel, west, south, across / 10.0, up / 10.0),
            (west, west + across / 10.0),
            (south, south + up / 10.0),
        )
        whole.picture(pixels.repeat(factor, axis=0).repeat(factor, axis=1))
        ring = np.concatenate([outline, outline[:1]])
        figure.line(panel.places(*ring.T), INK, 0.9)
    return figure


def _box_of(
    panel: Panel, west: float, south: float, width: float, height: float
) -> tuple[float, float, float, float]:
    """Left, top, width and height in the figure of a box on the ground."""
    corners = panel.places(np.array([west, west + width]), np.array([south + height, south]))
    (left, top), (right, bottom) = corners.tolist()
    return left, top, right - left, bottom - top


def _map_panel(low: Array, high: Array) -> tuple[Figure, Panel]:
    """A figure with a panel in degrees, as high as the ground is."""
    middle = float((low[1] + high[1]) / 2.0)
    east, north = metres_per_degree(middle, 0.0)
    (west, east_end), (south, north_end) = (widened(*pair, 0.03) for pair in zip(low, high, strict=True))
    room = WIDTH - 64.0
    width = room
    height = width * (north_end - south) * north / ((east_end - west) * east)
    if height > _TALLEST:
        width, height = width * _TALLEST / height, _TALLEST
    figure = Figure(height + 40.0 + _LEGEND)
    panel = Panel(figure, 56.0, 6.0, width, height, (west, east_end), (south, north_end))
    panel.frame()
    panel.x_axis("degrees east", count=5)
    panel.y_axis("degrees north")
    return figure, panel


def _ground_panel(figure: Figure, report: BlockQualityReport, below: float) -> Panel:
    """The panel of a map with the outline of the block; sets the height of the figure."""
    outline = report.errors.outline
    made, panel = _map_panel(outline.min(axis=0), outline.max(axis=0))
    figure.height = made.height - _LEGEND + below
    figure.parts.extend(made.parts)
    placed = Panel(
        figure, panel.left, panel.top, panel.width, panel.height, panel.x_range, panel.y_range
    )
    ring = np.concatenate([outline, outline[:1]])
    figure.line(placed.places(*ring.T), QUIET, 0.9)
    return placed


def _continuous(lon_lat: Array, outline: Array) -> Array:
    """Positions (n, 2) with longitudes near those of the outline."""
    middle = float(outline[:, 0].mean())
    lon = middle + (lon_lat[:, 0] - middle + 180.0) % 360.0 - 180.0
    return np.column_stack([lon, lon_lat[:, 1]])


def _legend(figure: Figure, entries: Sequence[tuple[str, str]]) -> None:
    """Write names with boxes of their colours at the foot of a figure, which grows with their rows."""
    rows = (len(entries) + 2) // 3
    figure.height += 12.0 * max(0, rows - 1)
    legend(figure, figure.height - 12.0 * rows + 6.0, entries)
