"""Lack of fit: tests of the residuals of a registration for structure, each named with possible
causes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from scipy.spatial import KDTree
from scipy.special import comb

from amers.services.imagery.line_breaks import format_breaks
from amers.services.misfit.broken_image import FEWEST_IN_PART, held_parts, part_of_line
from amers.services.misfit.structure import Family, Structure
from amers.services.quality.criteria import Criterion, Grade, at_most
from amers.services.quality.missed_along import UNFOUND, missed_along, missed_at_borders
from amers.services.types import Array, BoolArray, IntArray

_CRITERIA: dict[Family, str] = {
    "lines": "structure_along_lines",
    "steps": "steps_along_lines",
    "samples": "structure_along_samples",
    "seams": "steps_along_samples",
    "image": "structure_in_image",
    "height": "structure_against_height",
    "chips": "structure_within_chips",
}
_MAX_CHANCE = 1e-4
"""A family of structures that chance explains with a larger probability is not named."""
_GOOD, _USABLE, _FOLLOWED = 0.5, 2.0, 0.1
"""Largest displacement by a structure over the predicted CE90: of a good scene, a usable one, and along
the lines of a usable one."""
_OF_THE_MODEL: tuple[Family, ...] = ("lines", "steps")
"""A model of the whole image follows these, or is wrong."""
_WITHIN = 0.15
"""Active points between the lines of points that lie elsewhere, over these, up to which lines were lost
or repeated rather than ground moved."""
_ALONG = 0.1
"""Displacement along the samples over that along the lines, up to which lines alone were displaced."""
_MOVED = (
    "points next to them do not. Possible causes: ground that moved (a landslide, a quarry, ice), or a "
    "part of another image"
)
_OF_A_PLANE = 3
"""Parameters of a plane."""
_ENOUGH = 4
"""Points that agree elsewhere, from which on one may do so by chance."""
_MISSED_PERCENT = 10.0
"""Share of the lines, or samples, whose points do not agree, beyond which the scene is not usable."""
_WHY_MISSED = {
    "lines": "lines were lost or repeated, the sensor oscillated by more than the search radius",
    "samples": "a detector is out of place, the image was put together from parts",
}
_LARGE_PART = 0.4
"""Share of the image to which points that agree elsewhere are nearest, beyond which neither place is the
scene's."""
_AMONG, _AS_MANY = 0.15, 0.1
"""Share of the active points between points that agree elsewhere, and number of these over the active
ones, beyond which the image has two places. A pattern of the ground displaces a few; of those that were
missed, a part is searched again."""
_CHANCE_OF_SAMPLES = 0.01
"""Of points drawn at random being those of whole samples, at most, to be taken for these."""
_NODES = 30
"""Places along each side of the image at which the nearest point is sought."""
_MOST_WITH_SLOPE = 0.6
"""Percent of a distance by which a correction may grow up the slope of the ground. Attitudes and orbits
drift by less than a tenth of that; campaigns draw up to half as much again, in any direction."""
_ALONG_SLOPE = 1.5
"""Growth of a correction up the slope over that across it, from which on heights explain it; a rotation
or a scale has 1."""
_LARGEST_LEAN = 1.0
"""Tangent of the largest angle between the lines of sight of two images of one place."""
_REFUTES_SIGMAS, _HARDLY_GROWS = 4.0, 0.25
"""Residuals refute that heights move the points where they grow with heights by less than this share of
what would explain the correction, and differ from it by so many standard deviations of that growth."""


@dataclass(frozen=True)
class Elsewhere:
    """Points that agree on another displacement than the rest of the scene.

    Attributes:
        rows: (k,) of the points, among all that the scene may show.
        displacement_px: (2,) line and sample, from where the registered model expects them.
        displacement_m: its length on the ground.
        false_alarms: number of such groups that chance makes.
        slope_px: (2,) line and sample by which a metre of height displaces them; None where they are
            displaced alike.
        farthest_px: largest displacement, where they differ.
    """

    rows: IntArray
    displacement_px: Array
    displacement_m: float
    false_alarms: float
    slope_px: Array | None = None
    farthest_px: float = 0.0


def structure_criteria(
    structures: Sequence[Structure], sight: Array, shape: tuple[int, int], predicted_px: float
) -> list[Criterion]:
    """A criterion for each family of structures: structures beyond chance have to be small.

    A structure that is larger than the predicted accuracy makes the prediction wrong: the registration
    is not usable. Structures that the profile should follow are limited to a tenth of the prediction,
    because points on the other side of a step, or at the crest of a wave, are not among the active
    points. A model with other lines of sight is wrong wherever the ground has other heights than the
    points: the registration is not usable.

    Args:
        structures: of the residuals of the final adjustment.
        sight: (2,) pixels by which a metre of height moves a point in the image, line and sample.
        shape: lines and samples of the image.
        predicted_px: CE90 that is stated, median over the image.
    """
    criteria = []
    for structure in structures:
        size_px = structure.largest_px if structure.chance < _MAX_CHANCE else 0.0
        grade: Grade = "good"
        limit_px = _GOOD * predicted_px
        if structure.family in _OF_THE_MODEL:
            grade, limit_px = "usable", _FOLLOWED * predicted_px
        elif structure.family == "height":
            grade = "usable"
        elif size_px > _USABLE * predicted_px:
            grade, limit_px = "usable", _USABLE * predicted_px
        criterion = at_most(_CRITERIA[structure.family], size_px, float(np.nan_to_num(limit_px)), grade)
        if not criterion.met:
            described = f"{_looks_like(structure, sight, shape)} (p = {structure.chance:.1g})"
            criterion = replace(criterion, note=described)
        criteria.append(criterion)
    return criteria


def breaks_criterion(breaks: IntArray, line: Array, followed: bool, lines: int) -> Criterion:
    """The criterion on lines between breaks of an image in parts with too few points.

    The position of such a part is unknown, so that no usable scene has one.

    Args:
        breaks: (k,) first lines behind breaks, one at least.
        line: (n,) of the active points.
        followed: whether the correction has a step at each break; else the part with most points counts.
        lines: of the image.
    """
    part = part_of_line(breaks, line)
    most = np.bincount(part, minlength=len(breaks) + 1).argmax()
    held = held_parts(breaks, line, np.ones(len(line), dtype=bool))
    held &= followed | (np.arange(len(held)) == most)
    edges = np.concatenate([[0], breaks, [lines]])
    percent = 100.0 * float(np.diff(edges)[~held].sum()) / lines
    criterion = at_most("lines_behind_breaks", percent, 0.0, "usable")
    if criterion.met:
        return criterion
    why = (
        f"fewer than {FEWEST_IN_PART} points agree in {int((~held).sum())} of the {len(held)} parts"
        if followed
        else "this correction does not follow that"
    )
    shown = f"{format_breaks(breaks)}; {why}"
    return replace(criterion, note=f"{shown}: cut the image there, and register its parts")


def missed_criterion(
    along: Literal["lines", "samples"],
    position: Array,
    active: BoolArray,
    reason: np.ndarray,
    size: int,
    *,
    misfit_px: Array | None = None,
    counts: BoolArray | None = None,
) -> Criterion:
    """The criterion on lines, or samples, in which almost no point agrees with the scene.

    For samples, and at the borders, only points that were found count: haze or water may hide one side
    of an image.

    Args:
        along: of what.
        position: (n,) line or sample where the points are expected.
        active: (n,) those that the adjustment uses.
        reason: (n,) why others are not.
        size: lines or samples of the image.
        misfit_px: (n, 2) from where the scene places the points to where they were found; without, the
            borders are not looked at by themselves.
        counts: (n,) points that count in addition to the active ones: not cut by a break of the image,
            and farther from their place in the scene than its accuracy; all when None.
    """
    name = f"missed_along_{along}"
    disagree = (*UNFOUND, "deactivated") if along == "lines" else ("deactivated",)
    tried = active | np.isin(reason, disagree)
    if counts is not None:
        tried &= counts | active
    missed = missed_along(position, active, tried)
    if misfit_px is not None:
        found = tried & (active | (reason == "deactivated"))
        missed |= missed_at_borders(position, active, found, misfit_px)
    if not missed.any():
        return at_most(name, 0.0, 0.0, "good")
    beside = tried & ~missed
    first, last = float(position[missed].min()), float(position[missed].max())
    percent = 100.0 * _missed_share(position, missed, beside, size)
    severe = percent > _MISSED_PERCENT
    criterion = at_most(
        name, percent, _MISSED_PERCENT if severe else 0.0, "usable" if severe else "good"
    )
    seen = (
        f"between {along} {first:.0f} and {last:.0f}, {int((missed & active).sum())} of "
        f"{int(missed.sum())} points tried agree with the scene, elsewhere "
        f"{int((beside & active).sum())} of {int(beside.sum())}. Possible causes: {_WHY_MISSED[along]}, "
        "or the ground has changed there"
    )
    return replace(criterion, note=seen)


def _missed_share(position: Array, missed: BoolArray, others: BoolArray, size: int) -> float:
    """Share of the image that lies with missed points between the same two others, or the border."""
    edges = np.concatenate([[0.0], np.sort(np.clip(position[others], 0.0, size)), [float(size)]])
    gap = np.clip(np.searchsorted(edges, position[missed]), 1, len(edges) - 1)
    return float(np.diff(edges)[np.unique(gap) - 1].sum() / size)


def against_height(elsewhere: Elsewhere | None, sight: Array, predicted_px: float) -> Criterion | None:
    """The criterion on points that are displaced in proportion to their heights; None without any.

    Args:
        elsewhere: points that agree on another displacement.
        sight: (2,) pixels by which a metre of height moves a point in the image, line and sample.
        predicted_px: CE90 that is stated, median over the image.
    """
    if elsewhere is None or elsewhere.slope_px is None:
        return None
    limit_px = float(np.nan_to_num(_GOOD * predicted_px))
    criterion = at_most("structure_against_height", elsewhere.farthest_px, limit_px, "usable")
    seen = (
        f"{len(elsewhere.rows)} points that do not agree with the scene are displaced in proportion to "
        f"their heights, by up to {elsewhere.farthest_px:.1f} px ({elsewhere.false_alarms:.1g} such "
        "groups expected by chance)"
    )
    return replace(criterion, note=f"{seen}; {_wrong_sight(elsewhere.slope_px, sight)}")


def correction_against_height(
    displacement_px: Array, line_sample: Array, height_m: Array, gsd_m: float
) -> Criterion:
    """The criterion on a correction that grows up the slope of the ground, and hardly across it.

    Where the model belongs to another view, relief moves points in proportion to their heights. On a
    slope an affine follows this, so that the residuals do not show it; but the correction is wrong
    beyond the points, and wherever the ground leaves their plane. Points that leave the plane and still
    fit the correction show that it is a drift that happens to run up the slope.

    Args:
        displacement_px: (n, 2) of the active points from where the model was before registration.
        line_sample: (n, 2) where that was, line and sample.
        height_m: (n,) their heights.
        gsd_m: of the scene.
    """
    name = "correction_against_height"
    if len(height_m) <= _OF_A_PLANE:
        return at_most(name, 0.0, _MOST_WITH_SLOPE, "usable")
    design = np.column_stack([np.ones(len(height_m)), line_sample - line_sample.mean(axis=0)])
    inverse = np.linalg.pinv(design)
    of_height, of_displacement = inverse @ height_m, inverse @ displacement_px
    steepness = float(np.hypot(*of_height[1:]))
    if steepness == 0.0:
        return at_most(name, 0.0, _MOST_WITH_SLOPE, "usable")
    up = of_height[1:] / steepness
    growth, beside = up @ of_displacement[1:], np.array([-up[1], up[0]]) @ of_displacement[1:]
    misfit_px = displacement_px - design @ of_displacement
    sigma_px = np.sqrt((misfit_px**2).sum() / (len(height_m) - _OF_A_PLANE))
    percent, across = 100.0 * float(np.hypot(*growth)), 100.0 * float(np.hypot(*beside))
    by_chance = 200.0 * float(sigma_px * np.linalg.norm(up @ inverse[1:]))
    lean = percent / 100.0 / steepness * gsd_m
    explained = percent >= _ALONG_SLOPE * across and lean <= _LARGEST_LEAN
    explained &= not _refuted(growth / steepness, misfit_px, height_m - design @ of_height, sigma_px)
    least = max(percent - by_chance, 0.0) if explained else 0.0
    criterion = at_most(name, least, _MOST_WITH_SLOPE, "usable")
    seen = (
        f"the correction grows by {percent:.2f} % of the distance up the slope of the ground, and by "
        f"{across:.2f} % across it, as if seen {np.degrees(np.arctan(lean)):.0f} degrees from the lines "
        "of sight of the model. Possible causes: the model belongs to another view, or the heights of "
        "the points have another datum or scale"
    )
    return replace(criterion, note="" if criterion.met else seen)


def _refuted(slope_px: Array, misfit_px: Array, above_m: Array, sigma_px: float) -> bool:
    """Whether residuals (n, 2) of points above a plane (n,) show that heights move none by a slope.

    Args:
        slope_px: (2,) line and sample by which a metre of height would move a point.
        misfit_px: residuals beside the plane of the displacements.
        above_m: heights above the plane of the heights.
        sigma_px: of the residuals, both coordinates together.
    """
    weight = float(above_m @ above_m)
    if weight == 0.0:
        return False
    seen_px = above_m @ misfit_px / weight
    differs = np.hypot(*(slope_px - seen_px)) > _REFUTES_SIGMAS * sigma_px / np.sqrt(weight)
    return bool(differs and np.hypot(*seen_px) < _HARDLY_GROWS * np.hypot(*slope_px))


def elsewhere_criterion(
    elsewhere: Elsewhere | None, line_sample: Array, active: BoolArray, shape: tuple[int, int]
) -> Criterion:
    """The criterion on points that agree on another displacement.

    Args:
        elsewhere: these points; None when there are none.
        line_sample: (n, 2) where all points are expected.
        active: (n,) those that the adjustment uses.
        shape: lines and samples of the image.
    """
    if elsewhere is None or elsewhere.slope_px is not None:
        return at_most("points_elsewhere", 0, 0, "good")
    some, others = line_sample[elsewhere.rows], line_sample[active]
    line = some[:, 0]
    first, last = float(line.min()), float(line.max())
    moved = (
        f"{len(line)} points of lines {first:.0f} to {last:.0f} agree on a place "
        f"{np.hypot(*elsewhere.displacement_px):.1f} px ({elsewhere.displacement_m:.1f} m) away "
        f"({elsewhere.displacement_px[0]:+.1f} lines, {elsewhere.displacement_px[1]:+.1f} samples; "
        f"{elsewhere.false_alarms:.1g} such groups expected by chance)"
    )
    broken = _broken_by(some, others, elsewhere.displacement_px, shape)
    criterion = at_most("points_elsewhere", len(line), 0, "usable" if broken else "good")
    return replace(criterion, note=f"{moved}; {broken or _MOVED}")


def _broken_by(some: Array, others: Array, displacement_px: Array, shape: tuple[int, int]) -> str:
    """How points (n, 2) that agree elsewhere than others (m, 2) break an image; "" by moved ground."""
    if _belong_to_whole_lines(some[:, 0], others[:, 0], displacement_px):
        return (
            "almost no other point lies between these lines: lines of the image were lost or repeated, "
            "or belong to another image"
        )
    sample, samples_of_others = some[:, 1], others[:, 1]
    by_chance = chance_of_contiguous(sample, samples_of_others)
    if are_contiguous(sample, samples_of_others) and by_chance <= _CHANCE_OF_SAMPLES:
        return (
            f"almost no other point lies between their samples, {sample.min():.0f} to "
            f"{sample.max():.0f}: a detector is out of place, or the image was put together from parts"
        )
    among = float(np.mean(shapely.contains_xy(shapely.MultiPoint(some).convex_hull, others)))
    if among > _AMONG and len(some) > _AS_MANY * len(others):
        return (
            f"{among:.0%} of the other points lie among them: detectors alternate, or the image was put "
            "together from parts, so that neither place is that of the whole scene"
        )
    part = _nearest_share(some, others, shape)
    if part > _LARGE_PART:
        return (
            f"{_MOVED}. They are the nearest points for {part:.0%} of the image, so that neither place "
            "is that of the whole scene"
        )
    return ""


def _nearest_share(some: Array, others: Array, shape: tuple[int, int]) -> float:
    """Share of an image that is nearer to some points (n, 2) than to others (m, 2)."""
    if not len(others):
        return 1.0
    axes = [(np.arange(_NODES) + 0.5) / _NODES * size for size in shape]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    nearest_some, nearest_others = (KDTree(points).query(places)[0] for points in (some, others))
    return float(np.mean(nearest_some < nearest_others))


def _belong_to_whole_lines(line: Array, others: Array, displacement_px: Array) -> bool:
    """Whether points on another displacement are those of whole lines.

    Lost lines displace along the lines alone: then one point beyond the others may be there by chance.
    """
    along = abs(displacement_px[1]) <= _ALONG * abs(displacement_px[0])
    ordered = np.sort(line)
    parts = [ordered, ordered[1:], ordered[:-1]] if along and len(line) >= _ENOUGH else [ordered]
    return any(are_contiguous(part, others) for part in parts)


def chance_of_contiguous(position: Array, others: Array) -> float:
    """Chance that n of all n + m points, drawn at random, are contiguous, at most."""
    n = len(position)
    places = int(n + max(1.0, _WITHIN * n))
    total = n + len(others)
    if places >= total:
        return 1.0
    windows = (total - places + 1) * float(comb(places, n))
    return min(windows / float(comb(total, n)), 1.0)


def are_contiguous(position: Array, others: Array) -> bool:
    """Whether hardly any other points (m,) lie between points (n,), by their lines or their samples."""
    between = int(((others >= position.min()) & (others <= position.max())).sum())
    return between <= max(1.0, _WITHIN * len(position))


def _looks_like(structure: Structure, sight: Array, shape: tuple[int, int]) -> str:
    """A sentence on what a structure looks like."""
    line_px, sample_px = (structure.size_px * np.sqrt(2.0)).tolist()
    size = f"{line_px:.2f} px in line and {sample_px:.2f} px in sample"
    if structure.family == "height":
        return _wrong_sight(structure.slope_px, sight)
    if structure.family == "chips":
        return (
            f"parts of chips are displaced against each other by {size}, most clearly with a period of "
            f"{structure.at:.0f} lines. Possible cause: attitude jitter that is shorter than a chip. No "
            "correction follows it; the predicted accuracy includes it"
        )
    if structure.shape == "step":
        where, cause = "line", "lines that were lost or repeated"
        if structure.family == "seams":
            where, cause = "sample", "a seam between detectors"
        return (
            f"the residuals have a step of {size} at {where} {structure.at:.0f}. Possible cause: {cause}"
        )
    if structure.family == "image":
        return (
            f"neighbouring points are displaced together by {size}. Possible cause: errors of the "
            "terrain, or relief that the model does not have"
        )
    along = "lines" if structure.family == "lines" else "samples"
    if structure.shape != "period":
        cause = "a bow of the attitude" if along == "lines" else "a bent detector line"
        return (
            f"a bend of {size} along the {along} remains in the residuals. Possible cause: {cause}; the "
            "correction does not follow it"
        )
    length = shape[0] if along == "lines" else shape[1]
    cause = "seams between detectors, or a distortion of the optics"
    if along == "lines":
        cause = "a bow of the attitude" if structure.at > length else "attitude jitter"
    return (
        f"an oscillation of {size} along the {along}, with a period of {structure.at:.0f} {along}, "
        f"remains in the residuals. Possible cause: {cause}; the correction does not follow it"
    )


def _wrong_sight(slope_px: Array, sight: Array) -> str:
    """A sentence on residuals that grow with height by (2,) pixels of line and sample a metre."""
    slope = float(np.hypot(*slope_px))
    share = slope / max(float(np.hypot(*sight)), 1e-9)
    return (
        f"residuals grow by {100.0 * slope:.2f} px for 100 m of height, {share:.0%} of the displacement "
        "by relief in this model. Possible causes: the model belongs to another view, or the heights of "
        "the points have another datum or scale"
    )
