"""All figures of a report."""

from services.reports.charts import funnel, residual_histograms, residuals_along, residuals_by_height
from services.reports.maps import coverage_map, ground_overview, predicted_map, residual_map

FIGURES = (
    ground_overview,
    residual_map,
    coverage_map,
    residual_histograms,
    funnel,
    residuals_along,
    residuals_by_height,
    predicted_map,
)
"""Each draws one figure of a report; the page refers to them by their names."""
