"""The report on a plan as a page, and its maps."""

import numpy as np

from amers.services.reports.html import Page
from amers.services.reports.maps import equal_panel, kilometres
from amers.services.reports.plan import PlanReport
from amers.services.reports.plot import INK, SMALL_TEXT, Figure, Panel
from amers.services.types import Array

_COLOURS = ("#2166ac", "#67a9cf", "#d1e5f0", "#fddbc7", "#ef8a62", "#b2182b")
_PROPOSED, _SITE = "#b3372f", "#1b7837"
_HEIGHT, _LEGEND = 300.0, 34.0


def accuracy_map(report: PlanReport) -> Figure:
    """CE90 on the Earth over the ground, with the sites that are known and proposed.

    Predicted CE90 on the Earth. Triangles: known sites. Squares: proposed sites, in order.
    """
    found = report.forecast
    figure, panel = _panel(report)
    km = _km(report, found.lon_lat)
    limits = np.quantile(found.ce90_m, np.linspace(0.0, 1.0, len(_COLOURS) + 1))
    bins = np.clip(np.searchsorted(limits, found.ce90_m, side="right") - 1, 0, len(_COLOURS) - 1)
    diameter = float(np.clip(220.0 / np.sqrt(len(km)), 1.5, 9.0))
    for k, colour in enumerate(_COLOURS):
        figure.discs(panel.places(*km[bins == k].T), diameter, colour)
        x = 50.0 + k * 50.0
        figure.box((x, figure.height - 26.0), (48.0, 8.0), colour)
        figure.text(x, figure.height - 8.0, f"{limits[k]:.2f}", size=SMALL_TEXT)
    figure.text(50.0 + len(_COLOURS) * 50.0, figure.height - 8.0, "m", size=SMALL_TEXT)
    _sites(report, panel)
    return figure


def gain_map(report: PlanReport) -> Figure:
    """By how much each candidate alone lowers the mean CE90 of the ground.

    One more site: the larger the disc, the more it lowers the mean CE90 on the Earth.
    """
    figure, panel = _panel(report)
    gain_m = report.forecast.proposed[0].gain_m
    shown = np.flatnonzero(np.isfinite(gain_m))
    lon_lat = np.array([report.plan.candidates[k].lon_lat for k in shown])
    most = max(float(gain_m[shown].max()), 1e-9)
    size = 4.0 + 14.0 * np.sqrt(np.maximum(gain_m[shown], 0.0) / most)
    places = panel.places(*_km(report, lon_lat).T)
    for place, diameter in zip(places, size.tolist(), strict=True):
        figure.discs(place[None], diameter, _COLOURS[1], 0.8)
    figure.text(50.0, figure.height - 8.0, f"largest disc: {most:.2f} m less", size=SMALL_TEXT)
    _sites(report, panel)
    return figure


def _panel(report: PlanReport) -> tuple[Figure, Panel]:
    figure = Figure(_HEIGHT)
    everything = [report.forecast.lon_lat]
    marked = [site.lon_lat for site in report.plan.sites]
    marked += [one.site.lon_lat for one in report.forecast.proposed]
    if marked:
        everything.append(np.array(marked))
    panel = equal_panel(figure, _km(report, np.concatenate(everything)))
    figure.height += _LEGEND
    panel.frame()
    panel.x_axis("km east", count=6)
    panel.y_axis("km north")
    return figure, panel


def _sites(report: PlanReport, panel: Panel) -> None:
    known = np.array([site.lon_lat for site in report.plan.sites]).reshape(-1, 2)
    panel.figure.marks(panel.places(*_km(report, known).T), "^", 7.0, _SITE)
    for rank, one in enumerate(report.forecast.proposed):
        place = panel.places(*_km(report, np.array([one.site.lon_lat])).T)
        panel.figure.marks(place, "s", 7.0, _PROPOSED)
        panel.figure.text(float(place[0, 0]) + 5.0, float(place[0, 1]) + 3.0, str(rank + 1), colour=INK)


def _km(report: PlanReport, lon_lat: Array) -> Array:
    """Kilometres (n, 2) east and north of the first point of the ground."""
    return kilometres(lon_lat, report.forecast.lon_lat[0])


PLAN_PAGE = Page("plan.html", (accuracy_map, gain_map))
