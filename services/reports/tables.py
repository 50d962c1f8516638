"""The published tables of a registration, for a terminal or a text file."""

import io
from collections.abc import Sequence

from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from services.quality.accuracy import Quantile, Statistics
from services.quality.qualification import Criterion
from services.reports.report import RegistrationReport
from services.reports.summary import Check

ABSENT = "–"  # noqa: RUF001
CRITERION_NAMES = {
    "active_points": ("Active points", "", 0),
    "coverage_percent": ("Coverage of the image", "%", 0),
    "active_of_matched": ("Active / matched", "", 2),
    "residual_std_px": ("Unexplained residual, standard deviation", "px", 2),
    "displacement_px": ("Displacement with fewer points", "px", 2),
    "predicted_ce90_px": ("Predicted CE90, worst place", "px", 2),
    "unit_weight": ("Residuals over what is expected", "", 2),
    "second_consensus_share": ("Points that tell another story", "", 2),
    "check_points": ("Check points over what is expected", "", 2),
}

CRITERION_WAYS = {
    "active_points": "points kept by the final adjustment",
    "coverage_percent": "cells of the image with an active point, of all cells",
    "active_of_matched": "active points, of those matched",
    "residual_std_px": "standard deviation of the active residuals, n - 1, the worse of x and y, "
    "without what the accuracy stated for the points and chance explain",
    "displacement_px": "adjustment redone on a part of the points: median over the draws, worst of four "
    "corners and centre; points coarser than the pixels allow a share of their own",
    "predicted_ce90_px": "covariance of the correction carried over the image: radius that holds 90 % "
    "of its normal law, largest of the grid; points coarser than the pixels allow a share of their own",
    "unit_weight": "root of the weighted squares of the active residuals over the degrees of freedom: "
    "one when the stated sigmas are true",
    "second_consensus_share": "largest group of deactivated points that agree on another place, over "
    "the active points",
    "check_points": "residuals at independent check points, in units of what the covariances of the "
    "correction, the marks and the points let expect, rms",
}
"""How the value of each criterion is calculated."""

REASON_WORDS = {
    "not_tried": "not tried: others stand for it",
    "no_chip": "no chip at this sampling",
    "nodata": "no data there",
    "flat": "nothing to correlate",
    "low_score": "low score",
    "cloud": "under a cloud",
    "border_peak": "at the edge of the search",
    "ambiguous": "a second place as likely",
    "views_disagree": "views disagree",
    "deactivated": "does not fit the others",
}
"""What the codes of matching and adjustment mean, for people."""


def reason_words(reason: str) -> str:
    """Why a point is not active, for people."""
    return REASON_WORDS.get(reason, reason)


def number(value: float, decimals: int = 2, unit: str = "") -> str:
    """A number for people; a dash when there is none."""
    if value != value:
        return ABSENT
    without_minus_zero = round(float(value), decimals) + 0.0
    return f"{without_minus_zero:.{decimals}f} {unit}".rstrip()


def percent(ratio: float) -> str:
    """A ratio for people, in percent."""
    return number(100.0 * ratio, 0, "%")


def quantile(found: Quantile, unit: str = "m") -> str:
    """A quantile for people, with its interval."""
    if found.lower != found.lower:
        bounds = f"not bounded, n = {found.n}"
    elif found.upper != found.upper:
        bounds = f"at least {number(found.lower, 2, unit)}, n = {found.n}"
    else:
        bounds = f"{number(found.lower)} to {number(found.upper, 2, unit)}, n = {found.n}"
    return f"{number(found.value, 2, unit)} ({100 * found.confidence:.0f} % interval: {bounds})"


def criterion_words(criterion: Criterion) -> tuple[str, str, str]:
    """Name, value and limit of a criterion, for people."""
    name, unit, decimals = CRITERION_NAMES.get(criterion.name, (criterion.name.replace("_", " "), "", 3))
    limit = f"{criterion.comparison} {number(criterion.limit, decimals, unit)}"
    return name, number(criterion.value, decimals, unit), limit


def report_tables(report: RegistrationReport) -> RenderableType:
    """All tables of a report, to print on a rich console."""
    tables: list[RenderableType] = [
        Text.assemble(f"{report.scene.name}: ", (report.verdict, "bold")),
        equipment_table(report),
        residual_table(report),
        stability_table(report),
        criteria_table(report),
    ]
    if report.checks:
        tables.append(check_table(report.checks))
    return Group(*tables)


def format_tables(report: RegistrationReport, width: int = 100) -> str:
    """All tables of a report as plain text."""
    text = io.StringIO()
    Console(file=text, width=width, no_color=True, force_terminal=False).print(report_tables(report))
    return text.getvalue()


def criterion_way(criterion: Criterion) -> str:
    """How the value of a criterion is calculated, for people."""
    return CRITERION_WAYS.get(criterion.name, "")


def equipment_table(report: RegistrationReport) -> Table:
    """Points visible (Popini), matched (Spatio) and active (Actif)."""
    found = report.equipment
    return _table(
        "Equipment",
        ["Scene", "Popini", "Spatio", "Actif", "Actif/Spatio", "Actif/Popini"],
        [
            [
                escape(report.scene.name),
                str(found.visible),
                str(found.matched),
                str(found.active),
                percent(found.active_of_matched),
                percent(found.active_of_visible),
            ]
        ],
    )


def residual_table(report: RegistrationReport) -> Table:
    """Residuals of the active points, image side and ground side."""
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
    """The adjustment redone with fewer points, and the residuals of those held out."""
    stability = report.stability
    rows = [
        [place.place, number(place.median_px, 3), number(place.max_px, 3)]
        + [number(place.median_m, 3), number(place.max_m, 3)]
        for place in stability.displacements
    ]
    held_px, held_m = stability.held_out_px.xy, stability.held_out_m.xy
    caption = stability.note or (
        f"{stability.draws} adjustments with {percent(stability.kept_share)} of the active points; "
        f"{stability.held_out_per_draw} held out each time: mean {number(held_px.mean)} px "
        f"({number(held_m.mean)} m), std {number(held_px.std)} px ({number(held_m.std)} m), "
        f"n = {held_px.n}. Shows stability, not absolute accuracy."
    )
    columns = ["Displacement", "Median px", "Max px", "Median m", "Max m"]
    return _table("Stability", columns, rows, caption)


def criteria_table(report: RegistrationReport) -> Table:
    """Every threshold with the value held against it."""
    rows = [
        [*criterion_words(criterion), criterion.needed_for, "yes" if criterion.passed else "NO"]
        for criterion in report.criteria
    ]
    columns = ["Criterion", "Value", "Limit", "Needed for", "Met"]
    return _table("Criteria", columns, rows, f"Verdict: {report.verdict}")


def check_table(checks: Sequence[Check]) -> Table:
    """Accuracy against points that had no part in the registration."""
    rows = []
    for check in checks:
        found, marks = check.accuracy, check.image_residuals_px
        bias, rmse = (" / ".join(map(number, axes)) for axes in (found.bias_m, found.rmse_m))
        le90 = quantile(found.le90_m) if found.le90_m else ABSENT
        rms_px = ABSENT if marks is None else number(marks.xy.rms)
        rows.append([escape(check.against), bias, rmse, quantile(found.ce90_m), le90, rms_px])
    columns = ["Against", "Bias m", "RMSE m", "CE90", "LE90", "RMS px"]
    return _table("Accuracy", columns, rows)


def _table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], caption: str = ""
) -> Table:
    """A table whose first column is words and whose others are figures."""
    table = Table(title=title, title_justify="left", caption=caption or None, caption_justify="left")
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k == 0 else "right")
    for row in rows:
        table.add_row(*row)
    return table
