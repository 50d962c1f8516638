"""The tables of a report for a terminal or a text file."""

import io
from collections.abc import Sequence

from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from amers.services.quality.accuracy import Statistics
from amers.services.quality.stability import Displacement
from amers.services.reports.numbers import (
    ABSENT,
    criterion_limit,
    criterion_value,
    number,
    percent,
    quantile,
)
from amers.services.reports.report import Check, RegistrationReport
from amers.services.reports.stability_words import (
    CELLS_EXPLANATION,
    cells_left_out_text,
    group_means_text,
)

_WIDTH = 100


def report_tables(report: RegistrationReport) -> RenderableType:
    """All tables of a report, to print on a rich console."""
    tables: list[RenderableType] = [
        Text(f"Registration of {report.scene.name}", style="bold"),
        Text("\n".join([report.verdict_line, *report.accuracy_lines])),
        point_count_table(report),
        residual_table(report),
        stability_table(report),
        cell_stability_table(report),
        criteria_table(report),
    ]
    if report.checks:
        tables.append(check_table(report.checks))
    return Group(*tables)


def format_tables(report: RegistrationReport) -> str:
    """All tables of a report as plain text."""
    text = io.StringIO()
    Console(file=text, width=_WIDTH, no_color=True, force_terminal=False).print(report_tables(report))
    return text.getvalue()


def point_count_table(report: RegistrationReport) -> Table:
    """Numbers of visible, matched and active points, under the published heads."""
    counts = report.point_counts
    return _table(
        "Point counts: visible (Popini), matched (Spatio) and active (Actif)",
        ["Scene", "Popini", "Spatio", "Actif", "Actif/Spatio", "Actif/Popini"],
        [
            [
                escape(report.scene.name),
                str(counts.visible),
                str(counts.matched),
                str(counts.active),
                percent(counts.active_of_matched),
                percent(counts.active_of_visible),
            ]
        ],
    )


def residual_table(report: RegistrationReport) -> Table:
    """Residuals of the active points, in the image and on the ground."""
    image, ground = report.image_residuals_px, report.ground_residuals_m
    rows: list[tuple[str, Statistics, str]] = [
        ("x (sample)", image.x, "px"),
        ("y (line)", image.y, "px"),
        ("xy", image.xy, "px"),
        ("east", ground.east, "m"),
        ("north", ground.north, "m"),
        ("horizontal", ground.horizontal, "m"),
    ]
    return _table(
        "Residuals of the active points",
        ["Coordinate", "n", "Mean", "Std", "Rms", "Unit"],
        [
            [name, str(s.n), number(s.mean, 3), number(s.std, 3), number(s.rms, 3), unit]
            for name, s, unit in rows
        ],
    )


def stability_table(report: RegistrationReport) -> Table:
    """Displacements of an adjustment with fewer points, and residuals of the points held out."""
    stability = report.stability
    held_px, held_m = stability.held_out_px.xy, stability.held_out_m.xy
    caption = stability.note or (
        f"{stability.draws} adjustments with {percent(stability.kept_share)} of the active points. "
        f"Residuals of the {stability.held_out_per_draw} points held out each time: mean "
        f"{number(held_px.mean)} px ({number(held_m.mean)} m), std {number(held_px.std)} px "
        f"({number(held_m.std)} m), n = {held_px.n}. {group_means_text(stability.group_means)} Shows "
        "stability, not absolute accuracy."
    )
    return _displacement_table("Stability", stability.displacements, caption)


def cell_stability_table(report: RegistrationReport) -> Table:
    """Displacements of an adjustment without the points of a cell, and mean residuals of the cells."""
    stability = report.cell_stability
    caption = stability.note or (
        f"{cells_left_out_text(stability)} {group_means_text(stability.group_means)} {CELLS_EXPLANATION}"
    )
    return _displacement_table("Stability by cells", stability.displacements, caption)


def _displacement_table(title: str, places: Sequence[Displacement], caption: str) -> Table:
    rows = [
        [place.place, number(place.median_px, 3), number(place.max_px, 3)]
        + [number(place.median_m, 3), number(place.max_m, 3)]
        for place in places
    ]
    columns = ["Displacement", "Median px", "Max px", "Median m", "Max m"]
    return _table(title, columns, rows, caption)


def criteria_table(report: RegistrationReport) -> Table:
    """Every criterion with its value and limit."""
    rows = [
        [
            criterion.label,
            criterion_value(criterion),
            criterion_limit(criterion),
            criterion.needed_for,
            "yes" if criterion.met else "NO",
        ]
        for criterion in report.criteria
    ]
    columns = ["Criterion", "Value", "Limit", "Needed for", "Met"]
    return _table("Criteria", columns, rows, _criteria_caption(report))


def _criteria_caption(report: RegistrationReport) -> str:
    """The verdict, and why criteria have no value."""
    notes = [f"{c.label}: {c.note}" for c in report.criteria if c.note]
    return escape("\n".join([report.verdict_line, *notes]))


def check_table(checks: Sequence[Check]) -> Table:
    """Accuracy at points that had no part in the registration."""
    rows = []
    for check in checks:
        errors, marks = check.accuracy, check.image_residuals_px
        bias, rmse = (" / ".join(map(number, axes)) for axes in (errors.bias_m, errors.rmse_m))
        le90 = quantile(errors.le90_m) if errors.le90_m else ABSENT
        rms_px = ABSENT if marks is None else number(marks.xy.rms)
        rows.append([escape(check.against), bias, rmse, quantile(errors.ce90_m), le90, rms_px])
    columns = ["Against", "Bias m", "RMSE m", "CE90", "LE90", "RMS px"]
    return _table("Accuracy", columns, rows)


def _table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], caption: str = ""
) -> Table:
    """A table with words in its first column and figures in the others."""
    table = Table(title=title, title_justify="left", caption=caption or None, caption_justify="left")
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k == 0 else "right")
    for row in rows:
        table.add_row(*row)
    return table
