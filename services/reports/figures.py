"""All figures of a report."""

from collections.abc import Callable

from amers.services.reports.charts import (
    displacement,
    funnel,
    residual_histograms,
    residuals_along,
    residuals_by_height,
)
from amers.services.reports.maps import coverage_map, ground_overview, predicted_map, residual_map
from amers.services.reports.plot import Figure
from amers.services.reports.report import RegistrationReport

FIGURES: tuple[Callable[[RegistrationReport], Figure], ...] = (
    ground_overview,
    residual_map,
    coverage_map,
    residual_histograms,
    funnel,
    residuals_along,
    displacement,
    residuals_by_height,
    predicted_map,
)
"""Each draws one figure of a report; the page refers to them by their names."""


def figure_markup(draw: Callable[[RegistrationReport], Figure], report: RegistrationReport) -> str:
    """One of the figures as SVG markup, in the colours and fonts of the page."""
    return draw(report).markup((draw.__doc__ or draw.__name__).splitlines()[0])
