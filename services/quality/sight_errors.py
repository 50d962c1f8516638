"""Errors of the line of sight: displacements that grow with height, unlike in the model.

A model that belongs to another view, and points whose heights have another datum or scale, displace a
place by its height above the surface that the correction follows, times a slope. Three things show that
slope: residuals that grow with heights, an affine correction that grows up the slope of the ground, and
chips that are sheared on slopes. The harm is the slope times the relief of the scene.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amers.services.quality.line_of_sight import MOST_CHANCE, ImpliedSight
from amers.services.quality.stability import AdjustedScene
from amers.services.types import Array

_OF_A_PLANE = 3
"""Parameters of a plane."""
_FEWEST = 7
"""Points from which a correction that grows with heights is told from chance: beyond twice a plane."""
_MOST_WITH_SLOPE = 0.006
"""Growth of a correction with the distance that drifts of attitudes and orbits may have. They are less
than a tenth of that; simulated scenes have half as much again, in any direction."""
_ALONG_SLOPE = 1.5
"""Growth of a correction up the slope over that across it, from which on heights explain it; a rotation
or a scale has 1."""
_LARGEST_LEAN = 1.0
"""Tangent of the largest angle between the lines of sight of two images of one place: 45 degrees."""
_SIGMAS = 2.0
"""Standard deviations by which a growth exceeds chance."""
_REFUTES_SIGMAS, _HARDLY_GROWS = 4.0, 0.25
"""Residuals refute that heights move the points where they grow with heights by less than this share of
what would explain the correction, and differ from it by so many standard deviations of that growth."""


@dataclass(frozen=True)
class SightError:
    """Heights that move points otherwise than the model says.

    Attributes:
        harm_px: (2,) line and sample, slope times the relief of the scene.
        words: what shows it.
    """

    harm_px: Array
    words: str


def sight_error(
    scene: AdjustedScene, slopes_px: Sequence[Array], implied: ImpliedSight | None
) -> SightError | None:
    """The most harmful sign that heights move points otherwise than the model says; None without any.

    Args:
        scene: after its final adjustment.
        slopes_px: (2,) each, line and sample by which a metre of height moves points in the residuals.
        implied: by the chips.
    """
    measures = scene.measures
    if len(measures.lon_lat_h) <= _OF_A_PLANE:
        return None
    expected = scene.model.project(measures.lon_lat_h)
    relief_m = float(_beside_plane(expected, measures.lon_lat_h[:, 2]).std())
    sight = scene.model.project_derivative(measures.lon_lat_h)[:, :, 2].mean(axis=0)
    found = [SightError(relief_m * np.abs(slope), _residual_words(slope, sight)) for slope in slopes_px]
    slope = _slope_of_correction(scene)
    if slope is not None:
        found.append(SightError(relief_m * np.abs(slope), _correction_words(slope, scene.gsd_m)))
    if implied is not None and implied.chance <= MOST_CHANCE:
        px = relief_m * np.tan(np.radians(implied.angle_deg)) / scene.gsd_m
        found.append(SightError(np.full(2, px / np.sqrt(2.0)), _chip_words(implied)))
    return max(found, key=lambda one: float(np.hypot(*one.harm_px)), default=None)


def _beside_plane(line_sample: Array, height_m: Array) -> Array:
    """Heights (n,) above the plane that fits those at image positions (n, 2)."""
    known = np.isfinite(line_sample).all(axis=1)
    design = np.column_stack([np.ones(known.sum()), line_sample[known]])
    left = height_m[known] - design @ np.linalg.lstsq(design, height_m[known], rcond=None)[0]
    return np.asarray(left)


def _slope_of_correction(scene: AdjustedScene) -> Array | None:
    """Line and sample (2,) that a metre of height moves points, by a correction that grows up a slope.

    On a slope an affine follows the relief, so that residuals do not show it; but the correction is
    wrong beyond the points, and wherever the ground leaves their plane. Points that leave the plane and
    still fit the correction show that it is a drift that happens to run up the slope. Steps between
    lines are no growth: where they are followed, the affine part beside them counts.
    """
    measures, adjustment = scene.measures, scene.adjustment
    predicted = measures.predicted[measures.active]
    measured = measures.line_sample[measures.active]
    height_m = measures.lon_lat_h[measures.active, 2]
    if len(height_m) < _FEWEST:
        return None
    if any(one.is_step for one in adjustment.components):
        affine = replace(adjustment.correction, displacement=None)
        measured = affine.apply(predicted) + measures.residual_px[measures.active]
    return slope_of_growth(measured - predicted, predicted, height_m, scene.gsd_m)


def slope_of_growth(
    displacement_px: Array, line_sample: Array, height_m: Array, gsd_m: float
) -> Array | None:
    """Line and sample (2,) that a metre of height moves points; None where heights explain no growth.

    Args:
        displacement_px: (n, 2) of the points from where the model was before registration.
        line_sample: (n, 2) where that was.
        height_m: (n,) their heights.
        gsd_m: of the scene.
    """
    design = np.column_stack([np.ones(len(height_m)), line_sample - line_sample.mean(axis=0)])
    inverse = np.linalg.pinv(design)
    of_height, of_displacement = inverse @ height_m, inverse @ displacement_px
    steepness = float(np.hypot(*of_height[1:]))
    if steepness == 0.0:
        return None
    up = of_height[1:] / steepness
    growth, beside = up @ of_displacement[1:], np.array([-up[1], up[0]]) @ of_displacement[1:]
    misfit_px = displacement_px - design @ of_displacement
    sigma_px = np.sqrt((misfit_px**2).sum() / (len(height_m) - _OF_A_PLANE))
    along, across = float(np.hypot(*growth)), float(np.hypot(*beside))
    by_chance = _SIGMAS * float(sigma_px * np.linalg.norm(up @ inverse[1:]))
    slope_px = growth / steepness
    explained = along >= _ALONG_SLOPE * across and along / steepness * gsd_m <= _LARGEST_LEAN
    if not explained or along - by_chance <= _MOST_WITH_SLOPE:
        return None
    if _refuted(slope_px, misfit_px, height_m - design @ of_height, sigma_px):
        return None
    return np.asarray(slope_px)


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


_CAUSES = (
    "Possible causes: the model belongs to another view, or the heights of the points have another "
    "datum or scale"
)


def _residual_words(slope_px: Array, sight: Array) -> str:
    slope = float(np.hypot(*slope_px))
    share = slope / max(float(np.hypot(*sight)), 1e-9)
    return (
        f"residuals grow by {100.0 * slope:.2f} px for 100 m of height, {share:.0%} of the displacement "
        f"by relief in this model. {_CAUSES}"
    )


def _correction_words(slope_px: Array, gsd_m: float) -> str:
    lean = float(np.hypot(*slope_px)) * gsd_m
    return (
        f"the correction grows up the slope of the ground, and hardly across it, as if seen "
        f"{np.degrees(np.arctan(lean)):.0f} degrees from the lines of sight of the model. {_CAUSES}"
    )


def _chip_words(implied: ImpliedSight) -> str:
    return (
        f"the chips of {implied.points} points are sheared on slopes as if seen {implied.angle_deg:.0f} "
        f"degrees (standard deviation {implied.sigma_deg:.0f}) from the lines of sight of the model "
        f"(p = {implied.chance:.1g}). Possible causes: the model of the scene belongs to another "
        "view, or a model of the images that the chips come from does"
    )
