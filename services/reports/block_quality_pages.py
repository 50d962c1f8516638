"""The report on the quality of a block as a page."""

from amers.services.quality.accuracy import NormalisedError
from amers.services.reports.block_quality import BlockQualityReport, CellQuality, degree_words
from amers.services.reports.block_quality_figures import (
    density_map,
    error_scatter,
    height_histogram,
    height_map,
    site_map,
    views_map,
)
from amers.services.reports.html import Page
from amers.services.reports.numbers import ABSENT, number, percent


def figure_rows(report: BlockQualityReport) -> list[tuple[str, str]]:
    """The key figures, where there is only text."""
    block, density, age = report.block, report.density, report.age_years
    return [
        ("points", f"{block.points:,}"),
        ("ground that is not excluded", f"{block.area_km2 - block.excluded_km2:,.1f} km2"),
        ("density", f"{number(density.points_per_km2, 3)} points/km2"),
        ("cells with 1 / 2 km2", _share(density.share_reaching_half)),
        ("cells with 1 / 4 km2", _share(density.share_reaching_quarter)),
        ("images per point, median", number(report.images_per_point.median, 1)),
        ("newest view, median age", "unknown" if age is None else number(age.median, 1, "years")),
        (report.relative_to_control_points.label, report.relative_to_control_points.words),
        (report.on_the_earth.label, report.on_the_earth.words),
    ]


def poor_cells(report: BlockQualityReport) -> list[CellQuality]:
    """The cells that miss the specified density or number of images, those that lack most first."""
    poor = [c for c in report.density.cells if c.outcome == "missed" or c.short_of_views]
    return sorted(poor, key=lambda cell: (-cell.missing_points, -cell.short_of_views))


def declared_rows(report: BlockQualityReport) -> list[tuple[str, str, str, str]]:
    """What is declared and what was found, in words: name, declared, found, ratio."""
    rows = []
    for source in report.planimetry:
        if source.normalised.n:
            found = source.relative.ce90_m.value
            declared = f"CE90 {number(source.declared_ce90_m, 2, 'm')}"
            ratio = _ratio_words(source.normalised, source.typical_ratio)
            rows.append(("Points, relative", declared, f"CE90 {number(found, 2, 'm')}", ratio))
        if source.normalised_frame.n:
            shift = f"{number(source.shift_east_m)}, {number(source.shift_north_m, 2, 'm')}"
            row = (f"Frame, {source.source}", "its covariance", f"shift {shift}")
            rows.append((*row, _frame_words(source.normalised_frame)))
    heights = report.heights
    if heights is not None:
        found = heights.relative.le90_m.value
        declared = f"LE90 {number(heights.declared_le90_m, 2, 'm')}"
        ratio = _ratio_words(heights.normalised, heights.typical_ratio)
        rows.append(("Heights, relative", declared, f"LE90 {number(found, 2, 'm')}", ratio))
        if heights.normalised_frame.n:
            shift = f"shift {number(heights.on_the_earth.median_m, 2, 'm')}"
            words = _frame_words(heights.normalised_frame)
            rows.append(("Frame, heights", "its sigma", shift, words))
    return rows


def _ratio_words(normalised: NormalisedError, typical: float) -> str:
    """The size of errors in units of what is declared, with and without the influence of outliers."""
    if not normalised.n:
        return ABSENT
    return f"{number(normalised.mean_square**0.5)} in all, {number(typical)} typically"


def _frame_words(normalised: NormalisedError) -> str:
    """The size of a shift in units of the declared frame, and whether it is plausible."""
    size = number(normalised.mean_square**0.5)
    return f"{size}, {'implausible' if normalised.mean_square > normalised.upper else 'plausible'}"


def _share(ratio: float) -> str:
    return percent(ratio) if ratio in (0.0, 1.0) else number(100.0 * ratio, 1, "%")


QUALITY_PAGE = Page(
    "block_quality.html",
    (
        density_map,
        views_map,
        error_scatter,
        site_map,
        height_map,
        height_histogram,
        declared_rows,
        degree_words,
        figure_rows,
        poor_cells,
    ),
)
