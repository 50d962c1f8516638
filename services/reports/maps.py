"""The maps of a report: points, residuals and predicted accuracy, on the ground or on the image."""

import numpy as np

from amers.services.geodesy import metres_per_degree, wrapped_degrees
from amers.services.reports.drawing import (
    ACTIVE,
    ARROW,
    DEACTIVATED,
    NOT_MATCHED,
    crowding,
    image_panel,
    round_number,
    shortened,
)
from amers.services.reports.plot import (
    MARKS,
    SMALL_TEXT,
    WIDTH,
    Figure,
    Panel,
    left_margin,
    widened,
)
from amers.services.reports.reasons import NO_REASON
from amers.services.reports.report import RegistrationReport
from amers.services.sensors.correction import ImageCorrection
from amers.services.types import Array, BoolArray

_ON_IMAGE = "#c9ced4"
"""Colour of points that are not matched, on the dark quicklook."""
_LEGEND_ROW = 14.0
_PALE, _DEEP = np.array([247.0, 251.0, 255.0]), np.array([0.0, 92.0, 190.0])
"""Ends of the colours of the predicted accuracy, red, green and blue."""


def ground_overview(report: RegistrationReport) -> Figure:
    """The footprint of the scene and its points, kilometres east and north of its middle.

    Footprint of the scene and its points: blue active, orange deactivated, grey not matched.
    """
    outline, measures = report.scene.footprint_lon_lat, report.figure_data.measures
    places = outline if len(outline) else measures.lon_lat_h[:, :2]
    centre = places.mean(axis=0) if len(places) else np.zeros(2)
    points_km, outline_km = (kilometres(one, centre) for one in (measures.lon_lat_h[:, :2], outline))
    panel = ground_panel(272.0, np.concatenate([points_km, outline_km]))
    figure = panel.figure
    if len(outline):
        panel.outline(outline_km, ACTIVE, 0.10)
    for shown, colour, diameter in (
        (~measures.matched, NOT_MATCHED, 2.6),
        (measures.matched & ~measures.active, DEACTIVATED, 3.2),
        (measures.active, ACTIVE, 3.2),
    ):
        figure.discs(panel.places(*points_km[shown].T), diameter, colour)
    return figure


def kilometres(lon_lat: Array, centre: Array) -> Array:
    """Kilometres (n, 2) east and north of a centre, of lon, lat (n, 2); across the antimeridian too."""
    offset = lon_lat - centre
    offset[:, 0] = wrapped_degrees(offset[:, 0])
    return np.asarray(offset * np.array(metres_per_degree(float(centre[1]), 0.0)) / 1000.0)


def ground_panel(height: float, shown: Array, unit: str = "km") -> Panel:
    """A panel with a grid that shows places (n, 2) east and north, in a figure of its own."""
    panel = equal_panel(Figure(height), shown)
    panel.x_axis(f"{unit} east", count=8, grid=True)
    panel.y_axis(f"{unit} north", grid=True)
    return panel


def equal_panel(figure: Figure, shown: Array) -> Panel:
    """A panel that shows places (n, 2) with the same scale on both axes."""
    if not len(shown):
        shown = np.zeros((1, 2))
    low, high = shown.min(axis=0), shown.max(axis=0)
    ranges = np.array([widened(*pair) for pair in zip(low.tolist(), high.tolist(), strict=True)])
    left = left_margin((ranges[1, 0], ranges[1, 1]))
    size = np.array([WIDTH - left - 8.0, figure.height - 38.0])
    middle = ranges.mean(axis=1)
    half = size / 2.0 * float((np.ptp(ranges, axis=1) / size).max())
    (west, south), (east, north) = (middle - half).tolist(), (middle + half).tolist()
    return Panel(figure, left, 4.0, float(size[0]), float(size[1]), (west, east), (south, north))


def residual_map(report: RegistrationReport) -> Figure:
    """Residual vectors of the active points on the image, enlarged, with an arrow for the scale.

    Residual vectors on the image, enlarged; the arrow above gives the scale.
    """
    panel = image_panel(report, darkness=0.45, above=20.0, below=2.0)
    figure, measures = panel.figure, report.figure_data.measures
    drawn = measures.active & np.isfinite(measures.residual_px).all(axis=1)
    residual, place = measures.residual_px[drawn], measures.line_sample[drawn]
    if not len(residual):
        figure.text(WIDTH / 2.0, 12.0, "no active points", anchor="middle")
        return figure
    length_px = np.hypot(*residual.T)
    key_px = round_number(float(np.quantile(length_px, 0.9)))
    crowd = crowding(len(residual))
    enlarged = 0.06 * crowd * float(np.hypot(*report.scene.shape)) / key_px
    tips = place + enlarged * residual
    width = 1.3 * crowd
    colour = ARROW if report.figure_data.quicklook is not None else ACTIVE
    tails, heads = panel.places(place[:, 1], place[:, 0]), panel.places(tips[:, 1], tips[:, 0])
    with panel.clipped():
        figure.arrows(tails, heads, colour, width)
    key = key_px * enlarged * panel.width / report.scene.samples
    figure.arrows(np.array([[2.0, 9.0]]), np.array([[2.0 + key, 9.0]]), colour, 1.3)
    words = f"{key_px:g} px = {key_px * report.scene.gsd_m:.2g} m"
    figure.text(8.0 + key, 12.5, words)
    return figure


def coverage_map(report: RegistrationReport) -> Figure:
    """The points on the image by status and reason, and the area that they hold.

    Points on the image. The outline surrounds the area that active points support;
    """
    groups = _groups(report)
    below = 8.0 + _LEGEND_ROW * ((len(groups) + 1) // 2)
    panel = image_panel(report, darkness=0.6, above=2.0, below=below)
    figure = panel.figure
    for ring in report.coverage.outline:
        figure.line(panel.places(ring[:, 1], ring[:, 0]), ACTIVE, 1.5)
    crowd = crowding(len(report.figure_data.measures.point_id))
    rows = (len(groups) + 1) // 2
    for k, (label, place, shape, colour) in enumerate(groups):
        _draw_group(figure, panel.places(place[:, 1], place[:, 0]), shape, colour, crowd)
        x = 8.0 + (k // rows) * WIDTH / 2.0
        y = panel.top + panel.height + 12.0 + (k % rows) * _LEGEND_ROW
        shown_colour = NOT_MATCHED if colour == _ON_IMAGE else colour
        _draw_group(figure, np.array([[x, y - 3.0]]), shape, shown_colour, 1.0)
        figure.text(x + 8.0, y, label, size=SMALL_TEXT)
    return figure


def _groups(report: RegistrationReport) -> list[tuple[str, Array, str, str]]:
    """Label, places (n, 2), shape and colour of the points by status and reason, active points last.

    The places are the projections by the refined model.
    """
    measures, record = report.figure_data.measures, report.correction
    displacement = report.figure_data.displacement
    correction = ImageCorrection(
        record.parameters_px, record.centre_px, record.half_size_px, displacement
    )
    place = correction.apply(measures.predicted)
    codes = np.where(measures.reason == "", NO_REASON, measures.reason)
    on_image = report.figure_data.quicklook is not None
    kinds: list[tuple[BoolArray, str, str]] = [
        (~measures.matched, _ON_IMAGE if on_image else NOT_MATCHED, "not matched"),
        (measures.matched & ~measures.active, DEACTIVATED, "deactivated"),
    ]
    groups = []
    for rows, colour, stage in kinds:
        for k, reason in enumerate(r for r in report.reasons if r.stage == stage):
            label = f"{shortened(reason.label)} ({reason.count})"
            shape = MARKS[min(k, len(MARKS) - 1)]
            groups.append((label, place[rows & (codes == reason.reason)], shape, colour))
    if measures.active.any():
        label = f"active ({int(measures.active.sum())})"
        groups.append((label, place[measures.active], "disc", ACTIVE))
    return groups


def _draw_group(figure: Figure, places: Array, shape: str, colour: str, crowd: float) -> None:
    """Draw marks of one shape; discs get a white rim."""
    if shape == "disc":
        figure.discs(places, 4.8 * crowd, "white")
        figure.discs(places, 4.0 * crowd, colour)
    else:
        figure.marks(places, shape, 4.2 * crowd**0.5, colour)


def predicted_map(report: RegistrationReport) -> Figure:
    """CE90 that the covariance of the correction predicts over the image.

    CE90 predicted by the covariance of the correction, pixels.
    """
    lines, samples = (float(size) for size in report.scene.shape)
    left = left_margin((lines, 0.0))
    scale = min((WIDTH - left - 10.0) / samples, 540.0 / lines)
    width, height = samples * scale, lines * scale
    figure = Figure(height + 38.0)
    panel = Panel(figure, left, 6.0, width, height, (0.0, samples), (lines, 0.0))
    ce90_px = report.predicted.ce90_px
    finite = ce90_px[np.isfinite(ce90_px)]
    top = float(finite.max()) if len(finite) and finite.max() > 0.0 else 1.0
    cell = width / ce90_px.shape[1], height / ce90_px.shape[0]
    for row, column in np.argwhere(np.isfinite(ce90_px)).tolist():
        x, y = panel.left + column * cell[0], panel.top + row * cell[1]
        red, green, blue = _PALE + (_DEEP - _PALE) * (ce90_px[row, column] / (1.6 * top))
        colour = f"rgb({red:.0f} {green:.0f} {blue:.0f})"
        figure.box((x, y), (cell[0] + 0.3, cell[1] + 0.3), colour)
        words, middle = f"{ce90_px[row, column]:.2f}", y + cell[1] / 2.0 + 3.0
        figure.text(x + cell[0] / 2.0, middle, words, anchor="middle", size=8.5, colour="#10243a")
    panel.x_axis("sample", count=5)
    panel.y_axis("line")
    return figure
