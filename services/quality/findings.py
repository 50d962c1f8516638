"""All findings of a scene: errors that its correction does not contain, each with its harm.

A finding has no limit of its own. What it leaves in the delivered image, one standard deviation of a
position, enters the accuracy that is stated for every place; what makes a part of the image unknown
takes that part out of the area for which accuracy is stated. Verdicts follow from these two alone.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.spatial import KDTree

from amers.services.conventions import CHIP_SIZE
from amers.services.imagery.line_breaks import format_breaks
from amers.services.imagery.pixel_checks import Fault, PixelFinding
from amers.services.matching.consensus import consensus_tolerance_px
from amers.services.matching.predict import in_image
from amers.services.misfit.broken_image import FEWEST_IN_PART, held_parts
from amers.services.misfit.structure import Structure
from amers.services.quality.finding import Finding
from amers.services.quality.held_area import HeldArea, TriedPoints, held_area
from amers.services.quality.line_of_sight import ImpliedSight, implied_sight
from amers.services.quality.normal_law import CIRCULAR_CE90, normal_ce90
from amers.services.quality.points_elsewhere import agree_elsewhere, elsewhere_words
from amers.services.quality.sight_errors import SightError, sight_error
from amers.services.quality.stability import AdjustedScene
from amers.services.quality.structure_words import structure_words
from amers.services.types import Array, Measures

_FEWEST_NEIGHBOURS = 12
"""Points that show what neighbours share, as they do any structure of the residuals."""
MOST_CHANCE = 1e-4
"""A structure that chance explains with a larger probability is not told; its harm counts."""


def with_findings(scene: AdjustedScene) -> AdjustedScene:
    """A scene with what its correction does not follow, whose harm every accuracy includes.

    Args:
        scene: after its final adjustment.
    """
    notes = [
        *_of_breaks(scene),
        *_of_structures(scene),
        *_of_neighbours(scene),
        *_of_sight(scene),
        *_of_pixels(scene.pixel_findings),
        *scene.model_findings,
    ]
    held = _held(scene)
    if scene.elsewhere is not None and scene.elsewhere.slope_px is None:
        notes.append(_of_elsewhere(scene, held))
    notes.sort(key=lambda one: -float(np.hypot(*one.harm_px)))
    harm_px = np.sqrt(np.sum([one.harm_px**2 for one in notes], axis=0)) if notes else np.zeros(2)
    local_px = np.hypot(scene.adjustment.local_sigma_px, harm_px)
    adjustment = replace(scene.adjustment, local_sigma_px=local_px)
    ce90_px = normal_ce90(adjustment.covariance_at(held.places))
    held = held.where_known(ce90_px)
    return replace(scene, adjustment=adjustment, findings=tuple(notes), held=held)


def _of_breaks(scene: AdjustedScene) -> list[Finding]:
    """Breaks of the image; each part holds its own place by its own points, or no accuracy is stated."""
    if scene.breaks is None or not len(scene.breaks):
        return []
    line = scene.measures.line_sample[scene.measures.active, 0]
    parts = held_parts(scene.breaks, line, np.ones(len(line), dtype=bool))
    unheld = int((~parts).sum())
    words = format_breaks(scene.breaks)
    if unheld:
        words += (
            f"; fewer than {FEWEST_IN_PART} points agree in {unheld} of the {len(parts)} parts: cut the "
            "image there, and register its parts"
        )
    return [Finding("breaks", np.zeros(2), words)]


def _of_structures(scene: AdjustedScene) -> list[Finding]:
    """Structures of the residuals, which the stated accuracy includes."""
    found = scene.adjustment.structures
    told = [one for one in found if one.chance < MOST_CHANCE and one.family != "height"]
    return [_note(one, scene.shape) for one in told]


def _of_neighbours(scene: AdjustedScene) -> list[Finding]:
    """What neighbouring points are displaced by together, beyond what the adjustment states.

    Errors of points differ between neighbours, whatever sigmas the points state; an error of the model
    does not.
    """
    shared_px = shared_residual_px(scene.measures)
    harm_px = np.sqrt(np.maximum(shared_px**2 - scene.adjustment.local_sigma_px**2, 0.0))
    if not harm_px.any():
        return []
    line_px, sample_px = shared_px.tolist()
    words = (
        f"neighbouring points are displaced together by {line_px:.2f} px in line and {sample_px:.2f} px "
        "in sample (one standard deviation), which the correction does not follow. Possible causes: "
        "errors that the points share, the terrain, or a model with too few free parameters"
    )
    return [Finding("neighbours", harm_px, words)]


def shared_residual_px(measures: Measures) -> Array:
    """Standard deviation (2,), line and sample, of the part of the residuals that neighbours share.

    The variance, less half of the mean square of the differences between nearest neighbours, and less
    two standard deviations of chance: the variance of n residuals has a relative one of sqrt(2 / n).
    """
    residual = measures.residual_px[measures.active]
    if len(residual) < _FEWEST_NEIGHBOURS:
        return np.zeros(2)
    place = measures.line_sample[measures.active]
    _, nearest = KDTree(place).query(place, k=2)
    between = ((residual - residual[nearest[:, 1]]) ** 2).mean(axis=0) / 2.0
    chance = 1.0 + 2.0 * np.sqrt(2.0 / len(residual))
    shared = (residual**2).mean(axis=0) - chance * between
    return np.asarray(np.sqrt(np.maximum(shared, 0.0)))


def _note(structure: Structure, shape: tuple[int, int]) -> Finding:
    words = f"{structure_words(structure, shape)} (p = {structure.chance:.1g})"
    return Finding(f"structure_{structure.family}", np.zeros(2), words)


def _of_sight(scene: AdjustedScene) -> list[Finding]:
    """The most harmful sign of another line of sight, if there is one."""
    slopes = [one.slope_px for one in scene.adjustment.structures if _moves_with_height(one)]
    if scene.elsewhere is not None and scene.elsewhere.slope_px is not None:
        slopes.append(scene.elsewhere.slope_px)
    error = sight_error(scene, slopes, _implied(scene))
    return [] if error is None else [_sight_note(error)]


def _moves_with_height(structure: Structure) -> bool:
    return structure.family == "height" and structure.chance < MOST_CHANCE


def _implied(scene: AdjustedScene) -> ImpliedSight | None:
    """The line of sight that shears of chips imply; None where they hardly tell."""
    if scene.shears is None:
        return None
    derivative = scene.model.project_derivative(scene.measures.lon_lat_h[scene.shears.point])
    lean = np.linalg.solve(derivative[:, :, :2], derivative[:, :, 2:])[:, :, 0]
    return implied_sight(scene.shears, np.asarray(lean, np.float64))


def _sight_note(error: SightError) -> Finding:
    return Finding("line_of_sight", error.harm_px, error.words)


_EVERYWHERE = (Fault.ODD_LINES, Fault.ODD_SAMPLES, Fault.BANDS, Fault.SECOND_IMAGE)
"""Faults that displace pixels everywhere. Others have a place, and points beside it tell what it
displaces."""
_PULL_PX = 1.0
"""Displacement of matches by a second image, at most, however far it lies: one of half the contrast
moved real scenes by up to 0.84 px (CE90, `python -m benchmarks.real_scenes`)."""


def _of_pixels(found: Sequence[PixelFinding]) -> list[Finding]:
    """Faults of the pixels."""
    nothing = np.zeros(2)
    return [
        Finding(one.kind.value, _harm_of_pixels(one) if one.kind in _EVERYWHERE else nothing, one.words)
        for one in found
    ]


def _harm_of_pixels(fault: PixelFinding) -> Array:
    """Standard deviation (2,) whose CE90 is the displacement: points follow one of both places."""
    amount_px = float(np.nan_to_num(fault.amount_px))
    if fault.kind == Fault.SECOND_IMAGE:
        amount_px = min(amount_px, _PULL_PX)
    return np.full(2, amount_px / CIRCULAR_CE90)


def _of_elsewhere(scene: AdjustedScene, held: HeldArea) -> Finding:
    """Points that agree on another place: harm where they lie among those that agree with the scene."""
    group = scene.elsewhere
    assert group is not None
    expected = scene.model.project(scene.measures.lon_lat_h)
    among = int(held.holds(expected[group.rows]).sum())
    share = among / max(among + int(scene.measures.active.sum()), 1)
    harm_px = np.sqrt(share) * np.abs(group.displacement_px) / np.sqrt(2.0)
    parts = [one for one in scene.pixel_findings if one.kind == Fault.PART]
    shown = any(_inside_part(one, expected[group.rows]) for one in parts)
    words = elsewhere_words(group, expected, scene.measures.active, in_part=shown)
    return Finding("points_elsewhere", harm_px, words)


def _inside_part(part: PixelFinding, line_sample: Array) -> bool:
    """Whether most places (n, 2) lie in a part of another image that the pixels show."""
    first = np.array([part.line, part.sample])
    within = (line_sample >= first) & (line_sample <= first + [part.lines, part.samples])
    return bool(within.all(axis=1).mean() > 0.5)


def _held(scene: AdjustedScene) -> HeldArea:
    """The area that the points of a scene hold."""
    measures = scene.measures
    expected = scene.model.project(measures.lon_lat_h)
    active_px = measures.residual_px[measures.active]
    rms_px = float(np.sqrt((active_px**2).mean())) if len(active_px) else 0.0
    away = agree_elsewhere(
        expected,
        measures.line_sample - expected,
        measures.matched & ~measures.active,
        consensus_tolerance_px(rms_px),
    )
    if scene.elsewhere is not None:
        away[scene.elsewhere.rows] = True
    chip_side_px = CHIP_SIZE * scene.control_gsd_m / scene.gsd_m
    # A chip that reaches beyond the border has no pixels there, but the image has.
    empty = (measures.reason == "nodata") & in_image(expected, scene.shape, -chip_side_px / 2.0)
    tried = in_image(expected, scene.shape, 0.0) & (measures.reason != "not_tried")
    tried &= empty | (measures.reason != "nodata")
    points = TriedPoints(expected, measures.active, away, empty).take(tried)
    return held_area(_with_ties(points, scene.tie_places), scene.shape, chip_side_px, _parts(scene))


def _with_ties(points: TriedPoints, tie_places: Array | None) -> TriedPoints:
    """Points, and ties with other scenes, which hold an image as well."""
    if tie_places is None:
        return points
    ties = np.ones(len(tie_places), dtype=bool)
    return TriedPoints(
        np.concatenate([points.line_sample, tie_places]),
        np.concatenate([points.agrees, ties]),
        np.concatenate([points.elsewhere, ~ties]),
        np.concatenate([points.empty, ~ties]),
    )


def _parts(scene: AdjustedScene) -> Array:
    """Parts (p, 4) of the image that lie by themselves: first and last lines and samples."""
    lines, samples = scene.shape
    breaks = np.zeros(0, dtype=np.int64) if scene.breaks is None else scene.breaks
    edges = [0, *breaks.tolist(), lines]
    parts = [(first, end - 1, 0, samples - 1) for first, end in pairwise(edges) if len(edges) > 2]
    for one in scene.pixel_findings:
        if one.kind in (Fault.LOST_SAMPLES, Fault.REPEATED_SAMPLES):
            behind = one.sample + (1 if one.kind == Fault.LOST_SAMPLES else 0)
            parts += [(0, lines - 1, 0, behind - 1), (0, lines - 1, behind, samples - 1)]
        elif one.kind == Fault.PART:
            last = one.line + one.lines - 1, one.sample + one.samples - 1
            parts.append((one.line, last[0], one.sample, last[1]))
    return np.array(parts, dtype=np.float64).reshape(-1, 4)
