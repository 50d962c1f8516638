"""Formatting of numbers for people."""

from amers.services.quality.accuracy import Quantile
from amers.services.quality.block_requirements import BlockCriterion
from amers.services.quality.criteria import Criterion

ABSENT = "–"  # noqa: RUF001


def number(value: float, decimals: int = 2, unit: str = "") -> str:
    """A number with its unit; a dash for NaN."""
    if value != value:
        return ABSENT
    without_minus_zero = round(float(value), decimals) + 0.0
    return f"{without_minus_zero:.{decimals}f} {unit}".rstrip()


def metres(value_m: float) -> str:
    """A length; "unknown" for NaN."""
    return "unknown" if value_m != value_m else number(value_m, 2, "m")


def degrees(angle_deg: float) -> str:
    """An angle; a dash for NaN."""
    return ABSENT if angle_deg != angle_deg else f"{angle_deg:.1f}°"


def percent(ratio: float) -> str:
    """A ratio in percent."""
    return number(100.0 * ratio, 0, "%")


def quantile(estimate: Quantile) -> str:
    """A quantile in metres with its confidence interval and the size of its sample."""
    if estimate.lower != estimate.lower:
        bounds = f"not bounded, n = {estimate.n}"
    elif estimate.upper != estimate.upper:
        bounds = f"at least {number(estimate.lower, 2, 'm')}, n = {estimate.n}"
    else:
        bounds = f"{number(estimate.lower)} to {number(estimate.upper, 2, 'm')}, n = {estimate.n}"
    value = number(estimate.value, 2, "m")
    return f"{value} ({100 * estimate.confidence:.0f} % interval: {bounds})"


def criterion_value(criterion: Criterion | BlockCriterion) -> str:
    """The value of a criterion with its unit."""
    return number(criterion.value, criterion.decimals, criterion.unit)


def criterion_limit(criterion: Criterion | BlockCriterion) -> str:
    """The limit of a criterion with its comparison and unit, such as "at most 1.00 px"."""
    return f"{criterion.comparison} {number(criterion.limit, criterion.decimals, criterion.unit)}"
