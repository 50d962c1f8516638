"""Criteria of a registration: a figure compared with its limit, and the verdict that follows."""

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["good", "usable", "failed"]
Grade = Literal["good", "usable"]

VERDICT_EXPLANATIONS: dict[Verdict, str] = {
    "good": "Every criterion is met.",
    "usable": "Fit for use. Every criterion of a usable registration is met, but not every criterion of "
    "a good one.",
    "failed": "Not fit for use. A criterion that a usable registration must meet is not met.",
}
"""What each verdict means, for people."""


@dataclass(frozen=True)
class Criterion:
    """A figure of a registration, compared with its limit.

    Attributes:
        name: identifier of the criterion.
        label: name of the criterion for people.
        value: the figure; NaN when it could not be computed.
        comparison: "at least" or "at most".
        limit: the threshold, in the unit of the value.
        unit: of value and limit, "" for counts and ratios.
        decimals: digits after the point that are worth showing.
        needed_for: "good" or "usable": the best verdict that is impossible without this criterion.
        met: whether the value meets the limit; a value that could not be computed never does.
        calculation: how the value is calculated, for people.
        note: why there is no value, or what an unmet criterion looks like, for people; "" otherwise.
    """

    name: str
    label: str
    value: float
    comparison: Literal["at least", "at most"]
    limit: float
    unit: str
    decimals: int
    needed_for: Grade
    met: bool
    calculation: str
    note: str = ""


@dataclass(frozen=True)
class _Description:
    """What is the same for a criterion in every registration."""

    label: str
    unit: str
    decimals: int
    calculation: str


_DESCRIPTIONS = {
    "active_points": _Description(
        "Active points", "", 0, "Number of points that the final adjustment uses."
    ),
    "coverage_percent": _Description(
        "Area that points support",
        "%",
        0,
        "Share of the image for which the accuracy is stated: an active point lies within reach (15 % "
        "of a side, or what its chip shows), and of the points tried nearest to a place some are active"
        ", more than agree on another place.",
    ),
    "active_of_matched": _Description(
        "Active / matched", "", 2, "Active points divided by matched points."
    ),
    "residual_std_px": _Description(
        "Unexplained residual, standard deviation",
        "px",
        2,
        "Standard deviation of the active residuals (n - 1 in the denominator), the larger of x and y, "
        "minus the part that chance and the errors of the points explain. For good, these errors are as "
        "stated; for usable, as estimated in the scene; never more than the differences between "
        "neighbouring points. The limit of usable is in pixels of the chips where these are coarser.",
    ),
    "displacement_px": _Description(
        "Displacement with fewer points",
        "px",
        2,
        "The adjustment is repeated on random parts of the active points. Displacement of the four "
        "corners and the centre: median over the draws, largest of the five places.",
    ),
    "predicted_ce90_px": _Description(
        "Predicted CE90, worst place",
        "px",
        2,
        "The covariance of the correction is propagated to a grid over the image. Radius that contains "
        "90 % of the errors by the normal law, largest of the grid.",
    ),
    "ce90_on_earth_m": _Description(
        "CE90 on the Earth, worst place",
        "m",
        2,
        "The covariance of the correction and that of the control points' common error, propagated to "
        "the ground at its true height. Radius that contains 90 % of the errors by the normal law, "
        "largest of the grid. The option max_ce90_on_earth_m sets the limit.",
    ),
    "unit_weight": _Description(
        "Standard deviation of unit weight",
        "",
        2,
        "Square root of the weighted sum of squares of the active residuals over the degrees of "
        "freedom; 1 when the stated sigmas are true.",
    ),
    "marks_in_doubt": _Description(
        "Marks in doubt",
        "",
        0,
        "Number of marks that disagree beyond their sigmas (chi-squared test, corrected for the number "
        "of marks, p < 0.001) while nothing shows which of them are wrong.",
    ),
    "check_points": _Description(
        "Normalised error at check points",
        "",
        2,
        "Root mean square of the residuals at independent check points, in units of the standard "
        "deviation that the covariances of the correction, the marks and the points predict.",
    ),
}


def at_least(name: str, value: float, limit: float, needed_for: Grade) -> Criterion:
    """A criterion that is met from its limit on."""
    return _criterion(name, value, "at least", limit, needed_for)


def at_most(name: str, value: float, limit: float, needed_for: Grade) -> Criterion:
    """A criterion that is met up to its limit."""
    return _criterion(name, value, "at most", limit, needed_for)


def _criterion(
    name: str, value: float, comparison: Literal["at least", "at most"], limit: float, needed_for: Grade
) -> Criterion:
    described = _DESCRIPTIONS[name]
    return Criterion(
        name=name,
        label=described.label,
        value=float(value),
        comparison=comparison,
        limit=float(limit),
        unit=described.unit,
        decimals=described.decimals,
        needed_for=needed_for,
        met=bool(value >= limit if comparison == "at least" else value <= limit),
        calculation=described.calculation,
    )


def verdict_of(criteria: tuple[Criterion, ...]) -> Verdict:
    """The best verdict whose criteria are all met."""
    impossible = {criterion.needed_for for criterion in criteria if not criterion.met}
    if "usable" in impossible:
        return "failed"
    return "usable" if "good" in impossible else "good"


def verdict_scope(criteria: tuple[Criterion, ...]) -> str:
    """The accuracies that a verdict is about, in words."""
    on_the_earth = any(criterion.name == "ce90_on_earth_m" for criterion in criteria)
    return f"relative to the control points{' and on the Earth' if on_the_earth else ''}"
