"""Requirements on a block, criterion by criterion: met, missed, or not shown by the measurements."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from amers.services.quality.accuracy import MIN_CHECK_POINTS, Quantile
from amers.services.quality.block_cells import BlockCells
from amers.services.quality.block_heights import HeightQuality
from amers.services.quality.planimetry import CHECK_ONLY, CONTROL, PlanimetricQuality, SiteGroup

Outcome = Literal["met", "not shown", "missed"]
BlockVerdict = Literal["met", "not shown", "missed", "not specified"]

VERDICT_WORDS: dict[BlockVerdict, str] = {
    "met": "The block meets its specification.",
    "not shown": "No measurement contradicts the specification, but the measurements do not prove that "
    "the block meets all of it.",
    "missed": "The block misses its specification.",
    "not specified": "No required accuracy or density was given.",
}


@dataclass(frozen=True)
class BlockRequirements:
    """What a block shall reach.

    Attributes:
        points_per_km2: density of every cell of 0.1 degree; None where it is not specified.
        min_share: share of the ground, by cells, that shall reach the density, 0 to 1.
        min_views: number of images that shall show every point.
        ce90_m: largest CE90 on the Earth; None where it is not specified.
        le90_m: largest LE90 of the heights on the Earth; None where it is not specified.
    """

    points_per_km2: float | None = None
    min_share: float = 0.95
    min_views: int = 1
    ce90_m: float | None = None
    le90_m: float | None = None


@dataclass(frozen=True)
class BlockCriterion:
    """A figure of a block, compared with what is required.

    Attributes:
        name: identifier.
        label: for people.
        value: the figure; null when nothing was measured.
        comparison: "at least" or "at most".
        limit: what is required.
        unit: of both.
        decimals: digits after the point that are worth showing.
        outcome: "met"; "missed"; "not shown" when nothing was measured, when fewer than 30 points were,
            when the confidence interval of the figure includes the limit, or when the limit is met at
            control sites only.
        note: how the outcome came about, one sentence; "" where that is plain.
    """

    name: str
    label: str
    value: float
    comparison: Literal["at least", "at most"]
    limit: float
    unit: str
    decimals: int
    outcome: Outcome
    note: str


def block_criteria(
    requirements: BlockRequirements,
    cells: BlockCells,
    fewest_images: int,
    heights: HeightQuality | None,
    planimetry: Sequence[PlanimetricQuality],
) -> tuple[BlockCriterion, ...]:
    """The criteria of a block that its requirements state.

    Args:
        requirements: what is required.
        cells: of the block.
        fewest_images: smallest number of images that show a point.
        heights: against a height model; None when there was none.
        planimetry: at sites, the source that counts first.
    """
    criteria = []
    if requirements.points_per_km2 is not None:
        criteria.append(_density(requirements.points_per_km2, requirements.min_share, cells))
    criteria.append(_views(requirements.min_views, fewest_images, cells))
    if requirements.ce90_m is not None:
        group = checking_group(planimetry[0]) if planimetry else None
        measured = None if group is None else group.accuracy.ce90_m
        label = "CE90 on the Earth" if group is None else f"CE90 on the Earth, {group.name}"
        why = "no reference ortho-images were given (--site)"
        criterion = _accuracy("ce90_m", label, measured, requirements.ce90_m, why)
        if group is not None and group.name == CONTROL and criterion.outcome == "met":
            note = "all sites were used as control: add check-only ones (--site)"
            criterion = replace(criterion, outcome="not shown", note=note)
        criteria.append(criterion)
    if requirements.le90_m is not None:
        measured = None if heights is None else heights.on_the_earth.le90_m
        why = "no height model was given (--dem)"
        label = "LE90 on the Earth"
        criteria.append(_accuracy("le90_m", label, measured, requirements.le90_m, why))
    return tuple(criteria)


def block_verdict(criteria: Sequence[BlockCriterion], requirements: BlockRequirements) -> BlockVerdict:
    """The verdict on a block: the worst outcome of its criteria."""
    outcomes = {criterion.outcome for criterion in criteria}
    if "missed" in outcomes:
        return "missed"
    if "not shown" in outcomes:
        return "not shown"
    stated = (requirements.points_per_km2, requirements.ce90_m, requirements.le90_m)
    return "not specified" if all(limit is None for limit in stated) else "met"


def checking_group(quality: PlanimetricQuality) -> SiteGroup:
    """The sites that judge a block: the check-only ones where there are any."""
    return next((g for g in quality.groups if g.name == CHECK_ONLY), quality.groups[0])


def outcome_of(measured: Quantile | None, limit: float) -> Outcome:
    """Whether a quantile shows that a limit is met: its whole confidence interval lies on one side."""
    if measured is None or measured.n < MIN_CHECK_POINTS:
        return "not shown"
    if measured.upper <= limit:
        return "met"
    return "missed" if measured.lower > limit else "not shown"


def _density(limit: float, min_share: float, cells: BlockCells) -> BlockCriterion:
    missing = cells.missing_points(limit)
    area_km2 = cells.density.area_km2
    share = float(area_km2[missing == 0].sum() / area_km2.sum()) if len(area_km2) else 0.0
    poor, all_cells = int((missing > 0).sum()), len(missing)
    note = f"{poor:,} of {all_cells:,} cells lack {int(missing.sum()):,} points" if poor else ""
    return BlockCriterion(
        name="density",
        label=f"Ground with {limit:.3g} points/km2",
        value=100.0 * share,
        comparison="at least",
        limit=100.0 * min_share,
        unit="%",
        decimals=1,
        outcome="met" if share >= min_share else "missed",
        note=note,
    )


def _views(limit: int, fewest: int, cells: BlockCells) -> BlockCriterion:
    short = int(cells.short_of_views.sum())
    return BlockCriterion(
        name="images_per_point",
        label="Images that show a point, fewest",
        value=float(fewest),
        comparison="at least",
        limit=float(limit),
        unit="",
        decimals=0,
        outcome="met" if fewest >= limit else "missed",
        note=f"{short:,} points have fewer" if short else "",
    )


def _accuracy(
    name: str, label: str, measured: Quantile | None, limit: float, why_not: str
) -> BlockCriterion:
    outcome = outcome_of(measured, limit)
    note = ""
    if measured is None or not measured.n:
        note = why_not if measured is None else "no point was found"
    elif outcome == "not shown" and measured.n >= MIN_CHECK_POINTS:
        note = measured.note or "the confidence interval includes the limit"
    elif outcome == "not shown":
        note = measured.note
    return BlockCriterion(
        name=name,
        label=label,
        value=float("nan") if measured is None else measured.value,
        comparison="at most",
        limit=limit,
        unit="m",
        decimals=2,
        outcome=outcome,
        note=note,
    )
