"""One page that summarises the reports of many scenes, registered one by one."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from amers.services.reports.html import Page, format_html


@dataclass(frozen=True)
class OverviewRow:
    """A scene of the page.

    Attributes:
        verdict: of the registration, or "not registered".
        relative, on_the_earth: its two accuracies in words.
        points: active points of visible ones, "" without a registration.
        shift_m: displacement at the centre; NaN without a registration.
        reason: why the model is not to be used; "" where it is.
        report: address of its report, relative to the page; "" without one.
    """

    scene: str
    verdict: str
    relative: str
    on_the_earth: str
    points: str
    shift_m: float
    reason: str
    report: str


def format_overview(rows: Sequence[OverviewRow]) -> str:
    """The page, with links to the report of each scene."""
    counts = Counter(row.verdict for row in rows)
    words = ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
    return format_html(
        Page("overview.html", ()), {"rows": rows, "title": f"{len(rows)} scenes: {words}"}
    )
