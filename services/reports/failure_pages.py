"""The report of a failed registration as one HTML file, and as plain text."""

import io

import numpy as np
from markupsafe import Markup
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from amers.services.geodesy import metres_per_degree
from amers.services.reports.drawing import ACTIVE, DEACTIVATED, NOT_MATCHED
from amers.services.reports.failure import FailureReport, significance_words
from amers.services.reports.html import centre_words, flat_options, page_template
from amers.services.reports.maps import equal_panel
from amers.services.reports.numbers import number
from amers.services.reports.plot import Figure
from amers.services.reports.reasons import reason_label
from amers.services.reports.report import SceneRecord
from amers.services.types import Array

_WIDTH = 100


def format_failure_html(report: FailureReport) -> str:
    """The report as a self-contained page for screen, phone and paper."""
    scene = report.scene if isinstance(report.scene, SceneRecord) else None
    return page_template("failure.html").render(
        report=report,
        scene=scene,
        last=report.search_stages[-1] if report.search_stages else None,
        centre="" if scene is None else centre_words(scene.footprint_lon_lat),
        search_map="" if scene is None else Markup(_search_map(scene, report).markup("The search")),
        significance=significance_words,
        options=list(flat_options(report.run.options)),
    )


def format_failure_tables(report: FailureReport) -> str:
    """The report as plain text."""
    text = io.StringIO()
    console = Console(file=text, width=_WIDTH, no_color=True, force_terminal=False)
    console.print(f"{escape(report.scene.name)}: {report.verdict}")
    for line in report.accuracy_lines:
        console.print(escape(line))
    console.print(f"{escape(report.reason)}\n")
    if report.search_stages:
        console.print(_stage_table(report))
        if report.search_stages[-1].not_found:
            console.print(_reason_table(report))
        console.print(_candidate_table(report))
    console.print("What to try next")
    for step in report.next_steps:
        console.print(f"* {escape(step.text)}")
        if step.command:
            console.print(f"      {escape(step.command)}", soft_wrap=True)
    return text.getvalue()


def _stage_table(report: FailureReport) -> Table:
    title = "Searches, in order; the last one was refused"
    table = Table("Search", "Ground sampling m", "Radius m", title=title, title_justify="left")
    for name in ("Tried", "Found", "At border", "Agree"):
        table.add_column(name, justify="right")
    for stage in report.search_stages:
        counts = (stage.tried, stage.matched, stage.at_border, stage.inliers)
        radius = number(stage.search_radius_m, 1)
        table.add_row(stage.name, number(stage.chip_gsd_m, 1), radius, *map(str, counts))
    return table


def _reason_table(report: FailureReport) -> Table:
    table = Table("Points", "Number", title="Why points were not found", title_justify="left")
    for one in report.search_stages[-1].not_found:
        table.add_row(escape(reason_label(one.reason)), str(one.count))
    return table


def _candidate_table(report: FailureReport) -> Table:
    title = "Best candidates: groups of points that agree on a displacement"
    columns = ("Points", "East m", "North m", "Against chance")
    table = Table(*columns, title=title, title_justify="left")
    for one in report.search_stages[-1].candidates:
        words = significance_words(one.false_alarms)
        table.add_row(str(one.points), number(one.east_m, 1), number(one.north_m, 1), words)
    if not report.search_stages[-1].candidates:
        table.add_row("none", "", "", "no two of the points found agree")
    return table


def _search_map(scene: SceneRecord, report: FailureReport) -> Figure:
    """The footprint of the scene, how far it was searched, and the points, km from its middle."""
    figure = Figure(272.0)
    outline = scene.footprint_lon_lat
    centre = outline.mean(axis=0)
    km = np.array(metres_per_degree(float(centre[1]), 0.0)) / 1000.0
    outline_km, points_km = (_offset(places, centre) * km for places in (outline, report.ground))
    reach_km = max((stage.search_radius_m for stage in report.search_stages), default=0.0) / 1000.0
    low, high = outline_km.min(axis=0) - reach_km, outline_km.max(axis=0) + reach_km
    searched = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    panel = equal_panel(figure, np.concatenate([searched, outline_km, points_km]))
    panel.x_axis("km east", count=8, grid=True)
    panel.y_axis("km north", grid=True)
    if reach_km:
        figure.line(panel.places(*np.concatenate([searched, searched[:1]]).T), DEACTIVATED, 1.0)
    ring = panel.places(*np.concatenate([outline_km, outline_km[:1]]).T)
    figure.area(ring, ACTIVE, 0.10)
    figure.line(ring, ACTIVE, 1.0)
    figure.discs(panel.places(*points_km.T), 2.6, NOT_MATCHED)
    return figure


def _offset(lon_lat: Array, centre: Array) -> Array:
    """Degrees from a centre, across the antimeridian too."""
    offset = lon_lat - centre
    offset[:, 0] = (offset[:, 0] + 180.0) % 360.0 - 180.0
    return np.asarray(offset)
