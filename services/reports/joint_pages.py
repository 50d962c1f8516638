"""The report of scenes registered together as a page."""

import numpy as np

from amers.services.reports.drawing import ACTIVE, DEACTIVATED, crowding
from amers.services.reports.html import Page
from amers.services.reports.joint import JointReport, block_tables
from amers.services.reports.maps import ground_panel, kilometres
from amers.services.reports.plot import Figure

_HEIGHT = 300.0


def overview(report: JointReport) -> Figure:
    """The outlines of the scenes and the control points that agree, kilometres.

    Outlines of the scenes, and control points that agree, kilometres from the middle.
    """
    outlines = [one.scene.footprint_lon_lat for one in report.reports]
    middle = np.concatenate(outlines).mean(axis=0)
    rings = [kilometres(outline, middle) for outline in outlines]
    points = kilometres(report.misfits[:, :2], middle)
    panel = ground_panel(_HEIGHT, np.concatenate([*rings, points]))
    for scene, ring in zip(report.scenes, rings, strict=True):
        panel.outline(ring, DEACTIVATED if scene.verdict == "failed" else ACTIVE, 0.06)
    panel.figure.discs(panel.places(*points.T), 3.2 * max(0.4, crowding(len(points))), ACTIVE)
    return panel.figure


def misfit_figure(report: JointReport) -> Figure:
    """Known minus adjusted position of the active control points, metres.

    Known minus adjusted position of the control points, metres east and north.
    """
    misfit_m = report.misfits[:, 2:4]
    misfit_m = misfit_m[np.isfinite(misfit_m).all(axis=1)]
    panel = ground_panel(_HEIGHT, np.concatenate([misfit_m, [[-1.0, -1.0], [1.0, 1.0]]]), "m")
    panel.figure.discs(panel.places(*misfit_m.T), 4.0 * max(0.4, crowding(len(misfit_m))), ACTIVE)
    return panel.figure


JOINT_PAGE = Page("joint.html", (overview, misfit_figure, block_tables), has_text=True)
