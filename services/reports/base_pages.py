"""The report on a base as a page: its points on the map, and the frames of its dates."""

import numpy as np

from amers.services.reports.base import BaseReport
from amers.services.reports.drawing import ACTIVE, DEACTIVATED, NOT_MATCHED, crowding, legend
from amers.services.reports.html import Page
from amers.services.reports.maps import equal_panel, kilometres
from amers.services.reports.plot import SMALL_TEXT, Figure
from amers.services.types import Array

_COLOURS = ("#d68910", "#7fb2e5", "#0048a0")
"""Of points in few, some and many images."""
_ORBITS = (ACTIVE, DEACTIVATED, "#1a7a4a", "#7d3c98")
_HEIGHT, _LEGEND = 300.0, 18.0


def points_map(report: BaseReport) -> Figure:
    """The points of the base in its region, kilometres east and north.

    Points by the number of images in which they were found. The line is the region.
    """
    centre = report.lon_lat_h[:, :2].mean(axis=0)
    points_km = kilometres(report.lon_lat_h[:, :2], centre)
    outlines_km = [kilometres(ring, centre) for ring in report.outlines]
    figure = Figure(_HEIGHT)
    panel = equal_panel(figure, np.concatenate([points_km, *outlines_km]))
    figure.height += _LEGEND
    panel.x_axis("km east", count=6, grid=True)
    panel.y_axis("km north", grid=True)
    for ring in outlines_km:
        panel.outline(ring, NOT_MATCHED, 0.06)
    low, high = np.quantile(report.dates_of_points, [1.0 / 3.0, 2.0 / 3.0])
    level = (report.dates_of_points > low).astype(int) + (report.dates_of_points > high)
    entries = []
    for number, colour in enumerate(_COLOURS):
        of_level = report.dates_of_points[level == number]
        if len(of_level):
            size = 4.0 * crowding(len(points_km))
            figure.discs(panel.places(*points_km[level == number].T), size, colour)
            span = sorted({int(of_level.min()), int(of_level.max())})
            entries.append((f"{' to '.join(map(str, span))} images", colour))
    legend(figure, figure.height - 10.0, entries)
    return figure


def dates_figure(report: BaseReport) -> Figure:
    """Errors of the dates east and north of the frame of the base, metres, by orbit.

    Where each date lies against the frame of all of them, by orbit. The ring holds the true place of the
    frame with 90 % probability.
    """
    error_m = report.frames.error_m
    radius_m = float(np.sqrt(2.0 * np.log(10.0))) * report.frames.sigma_m
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    ring_m = radius_m * np.column_stack([np.cos(angle), np.sin(angle)])
    figure = Figure(_HEIGHT)
    panel = equal_panel(figure, np.concatenate([error_m, ring_m]))
    figure.height += _LEGEND
    panel.x_axis("m east", count=6, grid=True)
    panel.y_axis("m north", grid=True)
    panel.outline(ring_m, NOT_MATCHED, 0.10)
    orbit_of = {image.date: image.orbit for image in report.images}
    orbits = sorted(set(orbit_of.values()))
    of_date = [orbit_of[date] for date in report.date_names]
    for number, orbit in enumerate(orbits):
        rows = np.array([one == orbit for one in of_date])
        figure.discs(panel.places(*error_m[rows].T), 5.0, _ORBITS[number % len(_ORBITS)])
    _name_far_dates(report, panel.places(*error_m.T), figure)
    entries = [
        (f"orbit {orbit or 'unknown'}", _ORBITS[number % len(_ORBITS)])
        for number, orbit in enumerate(orbits[: len(_ORBITS)])
    ]
    legend(figure, figure.height - 10.0, entries)
    return figure


def _name_far_dates(report: BaseReport, places: Array, figure: Figure) -> None:
    """Name the dates whose errors are larger than what their producer states."""
    stated_m = {image.date: image.stated_m for image in report.images}
    for place, date, error_m in zip(
        places.tolist(), report.date_names, report.frames.error_m, strict=True
    ):
        if np.linalg.norm(error_m) > stated_m[date]:
            left = place[0] > 250.0
            x, anchor = (place[0] - 5.0, "end") if left else (place[0] + 5.0, "start")
            figure.text(x, place[1] + 3.0, date[:10], anchor=anchor, size=SMALL_TEXT)


BASE_PAGE = Page("base.html", (points_map, dates_figure))
