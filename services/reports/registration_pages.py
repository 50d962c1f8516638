"""The report of a registration as a page."""

from amers.services.reports.charts import (
    displacement,
    funnel,
    residual_histograms,
    residuals_along,
    residuals_by_height,
)
from amers.services.reports.criteria_rows import criterion_rows, unmet_criteria
from amers.services.reports.gallery import choose_comparisons
from amers.services.reports.html import Page
from amers.services.reports.maps import coverage_map, ground_overview, predicted_map, residual_map
from amers.services.reports.published import published_tables
from amers.services.reports.stability_words import (
    cells_left_out_text,
    group_means_text,
    held_out_text,
)

FIGURES = (
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
REGISTRATION_PAGE = Page(
    "registration.html",
    (
        *FIGURES,
        cells_left_out_text,
        choose_comparisons,
        criterion_rows,
        group_means_text,
        held_out_text,
        published_tables,
        unmet_criteria,
    ),
    has_text=True,
)
