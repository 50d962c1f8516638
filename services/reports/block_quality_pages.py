"""The report on the quality of a block as tables for a terminal and as a page."""

from collections.abc import Sequence

from markupsafe import Markup
from rich.table import Table

from amers.services.quality.accuracy import NormalisedError
from amers.services.quality.block_requirements import BlockCriterion, BlockVerdict
from amers.services.reports.block_quality import BlockQualityReport, CellQuality, degree_words
from amers.services.reports.block_quality_figures import (
    density_map,
    error_scatter,
    height_histogram,
    height_map,
    site_map,
    views_map,
)
from amers.services.reports.html import page_template
from amers.services.reports.numbers import ABSENT, number, percent, quantile

TONES: dict[BlockVerdict, str] = {"met": "good", "missed": "failed"}
MOST_CELLS = 200
"""Cells that the page lists; the document has all."""
_LISTED_IN_TERMINAL = 10


def format_block_quality_html(report: BlockQualityReport) -> str:
    """The report as a self-contained page for screen, phone and paper."""
    figures = {
        "density": density_map(report).markup("Density of the cells of 0.1 degree"),
        "views": views_map(report).markup("Images per point in the cells of 0.1 degree"),
    }
    if report.heights is not None:
        figures["height_histogram"] = height_histogram(report).markup("Distribution of height errors")
        figures["height_map"] = height_map(report).markup("Height errors on the ground")
    if report.planimetry:
        figures["scatter"] = error_scatter(report).markup("Planimetric errors, east and north")
        figures["sites"] = site_map(report).markup("Sites with their mean errors")
    missing = poor_cells(report)
    return page_template("block_quality.html").render(
        report=report,
        tone=TONES.get(report.verdict, "usable"),
        figures={name: Markup(markup) for name, markup in figures.items()},
        poor=missing[:MOST_CELLS],
        poor_count=len(missing),
        value=value_words,
        limit=limit_words,
        declared=declared_rows(report),
        degree=degree_words,
    )


def poor_cells(report: BlockQualityReport) -> list[CellQuality]:
    """The cells that miss the specified density or number of images, those that lack most first."""
    poor = [c for c in report.density.cells if c.outcome == "missed" or c.short_of_views]
    return sorted(poor, key=lambda cell: (-cell.missing_points, -cell.short_of_views))


def quality_tables(report: BlockQualityReport) -> list[Table]:
    """The report as tables for a terminal."""
    density = report.density
    block = _table("Block", "figure", "value")
    rows = [
        ("points", f"{report.block.points:,}"),
        ("ground that is not excluded", f"{report.block.area_km2 - report.block.excluded_km2:,.1f} km2"),
        ("density", f"{number(density.points_per_km2, 3)} points/km2"),
        ("cells with 1 / 2 km2", _share(density.share_reaching_half)),
        ("cells with 1 / 4 km2", _share(density.share_reaching_quarter)),
        ("images per point, median", number(report.images_per_point.median, 1)),
        ("newest view, median age", _age(report)),
        (report.relative_to_control_points.label, report.relative_to_control_points.words),
        (report.on_the_earth.label, report.on_the_earth.words),
    ]
    for name, value in rows:
        block.add_row(name, value)
    tables = [block]
    if report.heights is not None:
        tables.append(_height_table(report))
    tables += [_site_table(report, k) for k in range(len(report.planimetry))]
    declared = declared_rows(report)
    if declared:
        table = _table("Declared against found", "", "declared", "found", "errors / declared")
        for row in declared:
            table.add_row(*row)
        tables.append(table)
    poor = poor_cells(report)
    if poor:
        shown = f": the first {_LISTED_IN_TERMINAL} of {len(poor)}" if len(poor) > 10 else ""
        table = _table(f"Cells that miss{shown}", "south-west", "points", "missing", "too few images")
        for cell in poor[:_LISTED_IN_TERMINAL]:
            counts = (str(cell.points), str(cell.missing_points), str(cell.short_of_views))
            table.add_row(f"{cell.south:.1f}, {cell.west:.1f}", *counts)
        tables.append(table)
    criteria = _table("Specification", "criterion", "value", "required", "outcome")
    for criterion in report.criteria:
        note = f"{criterion.outcome}: {criterion.note}" if criterion.note else criterion.outcome
        criteria.add_row(criterion.label, value_words(criterion), limit_words(criterion), note)
    return [*tables, criteria]


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


def value_words(criterion: BlockCriterion) -> str:
    """The value of a criterion with its unit."""
    return number(criterion.value, criterion.decimals, criterion.unit)


def limit_words(criterion: BlockCriterion) -> str:
    """What a criterion requires."""
    return f"{criterion.comparison} {number(criterion.limit, criterion.decimals, criterion.unit)}"


def _ratio_words(normalised: NormalisedError, typical: float) -> str:
    """The size of errors in units of what is declared, with and without the influence of outliers."""
    if not normalised.n:
        return ABSENT
    return f"{number(normalised.mean_square**0.5)} in all, {number(typical)} typically"


def _frame_words(normalised: NormalisedError) -> str:
    """The size of a shift in units of the declared frame, and whether it is plausible."""
    size = number(normalised.mean_square**0.5)
    return f"{size}, {'implausible' if normalised.mean_square > normalised.upper else 'plausible'}"


def _height_table(report: BlockQualityReport) -> Table:
    heights = report.heights
    assert heights is not None
    title = f"Heights against {heights.against}"
    table = _table(title, "", "points", "bias, m", "median, m", "NMAD, m", "LE90")
    of_cells = [(degree_words(c.west, c.south), c.accuracy) for c in heights.cells]
    of_classes = [(c.name, c.accuracy) for c in heights.land_cover]
    rows = [(f"{heights.compared} heights", heights.on_the_earth), *of_cells, *of_classes]
    if heights.point_heights is not None:
        rows.append(("points themselves", heights.point_heights))
    for name, one in rows:
        figures = (number(one.bias_m), number(one.median_m), number(one.nmad_m))
        table.add_row(name, str(one.n), *figures, quantile(one.le90_m))
    return table


def _site_table(report: BlockQualityReport, k: int) -> Table:
    source = report.planimetry[k]
    title = f"Planimetry at sites, {source.source}"
    table = _table(title, "site", "found", "tried", "east, m", "north, m", "CE90")
    for site in source.sites:
        bias = [number(value) for value in site.accuracy.bias_m]
        kind = f"{site.name}, control" if site.is_control else site.name
        ce90 = quantile(site.accuracy.ce90_m)
        table.add_row(kind, str(site.accuracy.n), str(site.tried), *bias, ce90)
    for group in source.groups:
        bias = [number(value) for value in group.accuracy.bias_m]
        ce90 = quantile(group.accuracy.ce90_m)
        table.add_row(group.name, str(group.accuracy.n), "", *bias, ce90)
    return table


def _table(title: str, *columns: str) -> Table:
    table = Table(*columns, title=title, title_justify="left")
    numbers: Sequence[str] = ("points", "found", "tried", "missing", "too few images")
    for column in table.columns:
        if str(column.header) in numbers or str(column.header).endswith(", m"):
            column.justify = "right"
    return table


def _share(ratio: float) -> str:
    return percent(ratio) if ratio in (0.0, 1.0) else number(100.0 * ratio, 1, "%")


def _age(report: BlockQualityReport) -> str:
    return "unknown" if report.age_years is None else number(report.age_years.median, 1, "years")
