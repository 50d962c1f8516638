"""The report on the adjustment of a block as a page."""

import numpy as np

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.geodesy import east_north_up
from amers.services.production.block_residuals import FITS
from amers.services.reports.block_adjustment import AdjustmentReport
from amers.services.reports.drawing import ACTIVE, DEACTIVATED, crowding
from amers.services.reports.html import Page
from amers.services.reports.maps import ground_panel
from amers.services.reports.plot import QUIET, SMALL_TEXT, Figure
from amers.services.types import Array

_HEIGHT = 300.0
_LEGEND_ROW = 16.0
_CLASSES = ("#7fb2e5", "#e6c35c", "#b2453c")
_CIRCLE = np.linspace(0.0, 2.0 * np.pi, 73)


def points_map(report: AdjustmentReport) -> Figure:
    """The points by their longest residual against that of the middle point; kilometres.

    Longest residual of each point. Where the larger ones lie together, the ground has changed or a
    model is bent.
    """
    places = _kilometres(report.lon_lat_h)
    panel = ground_panel(_HEIGHT, places)
    figure = panel.figure
    figure.height += _LEGEND_ROW
    largest = report.points.largest_px
    edges = np.array([2.0, 4.0]) * max(float(np.median(largest)), 1e-6)
    kind = np.searchsorted(edges, largest)
    names = (f"up to {edges[0]:.2f} px", f"up to {edges[1]:.2f} px", "more")
    size = 3.6 * max(0.4, crowding(len(places)))
    x = 8.0
    for row, (name, colour) in enumerate(zip(names, _CLASSES, strict=True)):
        rows = kind == row
        figure.discs(panel.places(*places[rows].T), size, colour)
        figure.discs(np.array([[x, _HEIGHT + 8.0]]), 5.0, colour)
        words = f"{name}: {int(rows.sum())}"
        figure.text(x + 7.0, _HEIGHT + 11.0, words, size=SMALL_TEXT)
        x += 24.0 + 5.2 * len(words)
    return figure


def offsets(report: AdjustmentReport) -> Figure:
    """By how much the delivered models were off, metres.

    By how much the delivered model of each image was off at its centre. The circle is three times
    the largest accuracy stated; images that should be looked at are red.
    """
    off_m = np.array([image.off_m for image in report.images]).reshape(-1, 2)
    odd = np.array([image.verdict != FITS for image in report.images], dtype=bool)
    stated_m = max(image.stated_m for image in report.images)
    circle = MAX_ERROR_SIGMAS * stated_m * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
    panel = ground_panel(_HEIGHT, np.concatenate([off_m, circle]), "m")
    panel.figure.line(panel.places(*circle.T), QUIET, 1.0)
    for rows, colour in ((~odd, ACTIVE), (odd, DEACTIVATED)):
        panel.figure.discs(panel.places(*off_m[rows].T), 5.0, colour)
    return panel.figure


def _kilometres(lon_lat_h: Array) -> Array:
    middle = np.array([*np.median(lon_lat_h[:, :2], axis=0), 0.0])
    return np.asarray(east_north_up(lon_lat_h, middle)[:, :2] / 1000.0)


ADJUSTMENT_PAGE = Page("block_adjustment.html", (points_map, offsets))
IMAGES_PAGE = Page("block_images.html", ())
"""The images alone, for a terminal: the first 40, those before others that should be looked at."""
