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
        "Coverage of the image",
        "%",
        0,
        "Cells of the image that hold an active point, as a share of all cells.",
    ),
    "active_of_matched": _Description(
        "Active / matched", "", 2, "Active points divided by matched points."
    ),
    "residual_std_px": _Description(
        "Unexplained residual, standard deviation",
        "px",
        2,
        "Standard deviation of the active residuals (n - 1 in the denominator), the larger of x and y, "
        "without the part that chance and the accuracy of the points explain: as stated for good, as "
        "the scene shows it for usable, at most what separates neighbouring points. The limit of "
        "usable is in pixels of the chips where these are coarser.",
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
        "The covariance of the correction is propagated to a grid over the image. Radius that holds "
        "90 % of its normal law, largest of the grid.",
    ),
    "ce90_on_earth_m": _Description(
        "CE90 on the Earth, worst place",
        "m",
        2,
        "The covariance of the correction, and that of the frame of the control points through the "
        "derivative of the model, on the ground at its true height. Radius that holds 90 % of the "
        "normal law, largest of the grid. The option max_ce90_on_earth_m sets the limit.",
    ),
    "unit_weight": _Description(
        "Standard deviation of unit weight",
        "",
        2,
        "Square root of the weighted sum of squares of the active residuals over the degrees of "
        "freedom; 1 when the stated sigmas are true.",
    ),
    "second_consensus_share": _Description(
        "Second consensus / active",
        "",
        2,
        "Largest group of deactivated points that agree on another displacement, beyond the predicted "
        "CE90, divided by the active points.",
    ),
    "structure_along_lines": _Description(
        "Residuals along the lines",
        "px",
        2,
        "Largest displacement by a swing or bend along the lines that residuals show; 0 where chance "
        "shows one as clearly (F test of the best shape, times the number tried, 0.0001). The limit is "
        "a tenth of the predicted CE90.",
    ),
    "steps_along_lines": _Description(
        "Steps along the lines",
        "px",
        2,
        "Largest step of the residuals at some line; 0 where chance shows one as clearly. The limit is "
        "a tenth of the predicted CE90.",
    ),
    "structure_along_samples": _Description(
        "Residuals along the samples",
        "px",
        2,
        "Largest displacement by a swing or bend along the samples that residuals show; 0 where chance "
        "shows one as clearly. Seams between detectors and distortions of the optics show here. The "
        "limit is half of the predicted CE90 for good, twice it for usable.",
    ),
    "steps_along_samples": _Description(
        "Steps along the samples",
        "px",
        2,
        "Largest step of the residuals at some sample, a seam between two detectors; 0 where chance "
        "shows one as clearly. Limits as for residuals along the samples.",
    ),
    "structure_in_image": _Description(
        "Residuals over the image",
        "px",
        2,
        "Largest displacement by waves in two dimensions that residuals show; 0 where chance shows one "
        "as clearly. Limits as for residuals along the samples.",
    ),
    "structure_against_height": _Description(
        "Residuals against height",
        "px",
        2,
        "Largest displacement that grows with the height of the points, as where the lines of sight of "
        "the model are not those of the image; 0 where chance shows one as clearly.",
    ),
    "correction_against_height": _Description(
        "Correction up the slope of the ground",
        "%",
        2,
        "The displacement of the points from the model before registration, and their heights, as "
        "planes over the image: growth of the first up the slope of the second, less two standard "
        "deviations, as a share of the distance. 0 where it grows as much across the slope, or "
        "where no other view of the place explains it.",
    ),
    "line_of_sight": _Description(
        "Line of sight",
        "deg",
        1,
        "Slopes shear the chips of a point against the scene, by how differently both see the ground. "
        "Angle between the line of sight that shears of all chips imply and that of the model; 0 where "
        "chance explains it (probability above 0.00001).",
    ),
    "structure_within_chips": _Description(
        "Motion within the chips",
        "px",
        2,
        "Largest displacement by a swing over fewer lines than a chip has, by which parts of the chips "
        "at the same lines are displaced alike (F test, as along the lines). The limit of good is half "
        "of the predicted CE90, which holds it.",
    ),
    "lines_behind_breaks": _Description(
        "Lines behind breaks of the image",
        "%",
        0,
        "Where lines are missing or repeated, neighbouring lines differ over the width of the image by "
        "more than elsewhere (1.4 times at least; chance makes 0.0001 such places). Lines of the parts "
        "between these breaks that fewer than three active points hold, as a share of all lines.",
    ),
    "missed_along_lines": _Description(
        "Lines whose points do not agree",
        "%",
        0,
        "Lines between which hardly any of the points tried agree with the scene, fewer than chance "
        "explains (binomial, times the number of intervals, 0.01), as a share of all lines. Points "
        "under clouds and where pixels are missing do not count. Usable up to 10 %.",
    ),
    "missed_along_samples": _Description(
        "Samples whose points do not agree",
        "%",
        0,
        "As for the lines, between samples: detectors out of place show here. Usable up to 10 %.",
    ),
    "points_elsewhere": _Description(
        "Points that agree elsewhere",
        "",
        0,
        "Points that were not found where they are expected are searched again in a wide window. Number "
        "of those that agree on another displacement, beyond chance.",
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
    """The accuracy that a verdict speaks of: that of every place which states both."""
    on_the_earth = any(criterion.name == "ce90_on_earth_m" for criterion in criteria)
    return f"relative to the control points{' and on the Earth' if on_the_earth else ''}"
