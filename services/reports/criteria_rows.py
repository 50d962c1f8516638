"""Criteria of a report, one row for each: value, limits, and the level that is reached."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amers.services.quality.criteria import Criterion
from amers.services.reports.numbers import ABSENT, criterion_limit, criterion_value

NOT_USABLE = "not usable"


@dataclass(frozen=True)
class CriterionRow:
    """A criterion with its limits of both levels, as text for people.

    Attributes:
        value: one figure, or that of each level where they differ.
        level: the best verdict that the criterion allows: "good", "usable" or "not usable".
        is_met: whether the limits of both levels are met.
        usable, good: the limits; a dash where a level has none.
        margin: to the limit of good, else to that of usable.
        note, calculation: as of the criterion.
    """

    label: str
    value: str
    level: str
    is_met: bool
    usable: str
    good: str
    margin: str
    note: str
    calculation: str


def criterion_rows(criteria: Sequence[Criterion]) -> tuple[CriterionRow, ...]:
    """A row for each criterion, those that cost most first."""
    by_name: dict[str, list[Criterion]] = {}
    for criterion in criteria:
        by_name.setdefault(criterion.name, []).append(criterion)
    rows = [_row(levels) for levels in by_name.values()]
    order = (NOT_USABLE, "usable", "good")
    return tuple(sorted(rows, key=lambda row: order.index(row.level)))


def unmet_criteria(criteria: Sequence[Criterion]) -> list[Criterion]:
    """The criteria that are not met, each at the lowest level that it misses, that level first."""
    by_name: dict[str, Criterion] = {}
    for criterion in sorted(criteria, key=lambda criterion: criterion.needed_for == "good"):
        if not criterion.met:
            by_name.setdefault(criterion.name, criterion)
    return list(by_name.values())


def margin_words(criterion: Criterion) -> str:
    """Distance from value to limit in percent of the limit, positive where the criterion is met."""
    if criterion.limit == 0.0 or not np.isfinite(criterion.value):
        return ABSENT
    distance = (criterion.value - criterion.limit) / criterion.limit
    return f"{100.0 * (distance if criterion.comparison == 'at least' else -distance):+.0f} %"


def _row(levels: Sequence[Criterion]) -> CriterionRow:
    """The row of a criterion with one or two levels."""
    of = {criterion.needed_for: criterion for criterion in levels}
    strictest = of.get("good") or of["usable"]
    missed = {criterion.needed_for for criterion in levels if not criterion.met}
    values = {level: criterion_value(criterion) for level, criterion in of.items()}
    return CriterionRow(
        label=strictest.label,
        value=(
            ", ".join(f"{value} ({level})" for level, value in values.items())
            if len(set(values.values())) > 1
            else criterion_value(strictest)
        ),
        level=NOT_USABLE if "usable" in missed else "usable" if missed else "good",
        is_met=not missed,
        usable=criterion_limit(of["usable"]) if "usable" in of else ABSENT,
        good=criterion_limit(of["good"]) if "good" in of else ABSENT,
        margin=margin_words(strictest),
        note=next((criterion.note for criterion in levels if criterion.note), ""),
        calculation=strictest.calculation,
    )
