"""The report of a failed registration as a page."""

import numpy as np

from amers.services.reports.drawing import ACTIVE, DEACTIVATED, NOT_MATCHED
from amers.services.reports.failure import FailureReport, significance_words
from amers.services.reports.html import Page
from amers.services.reports.maps import ground_panel, kilometres
from amers.services.reports.plot import Figure
from amers.services.reports.report import SceneRecord


def search_map(report: FailureReport) -> Figure:
    """The footprint of the scene, how far it was searched, and the points, km from its middle.

    Footprint of the scene by the delivered model (blue)
    """
    assert isinstance(report.scene, SceneRecord)
    outline = report.scene.footprint_lon_lat
    centre = outline.mean(axis=0)
    outline_km, points_km = (kilometres(places, centre) for places in (outline, report.ground))
    reach_km = max((stage.search_radius_m for stage in report.search_stages), default=0.0) / 1000.0
    low, high = outline_km.min(axis=0) - reach_km, outline_km.max(axis=0) + reach_km
    searched = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    panel = ground_panel(272.0, np.concatenate([searched, outline_km, points_km]))
    figure = panel.figure
    if reach_km:
        figure.line(panel.places(*np.concatenate([searched, searched[:1]]).T), DEACTIVATED, 1.0)
    panel.outline(outline_km, ACTIVE, 0.10)
    figure.discs(panel.places(*points_km.T), 2.6, NOT_MATCHED)
    return figure


FAILURE_PAGE = Page("failure.html", (search_map, significance_words), has_text=True)
