"""One search of points with one model, and the adjustment on its result; used by all stages."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.errors import NoConsensus, NotEnoughPoints
from amers.services.geodesy import continuous, ecef_from_east_north_up
from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m
from amers.services.imagery.source import image_gsds_m
from amers.services.matching.chip_shears import ChipShears
from amers.services.matching.consensus import (
    Consensus,
    Voters,
    a_contrario_consensus,
    consensus_tolerance_px,
    robust_affine_inliers,
)
from amers.services.matching.control_points import PointMatches
from amers.services.misfit.control_observations import ControlObservations
from amers.services.misfit.image_correction import adjust_scene
from amers.services.misfit.scene_adjustment import AdjustmentOptions, SceneAdjustment
from amers.services.quality.frames import shared_frame
from amers.services.registration.context import Candidate, NotFound, Prediction, SearchStage
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel
from amers.services.sensors.displacement import DisplacementGrid
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Array, BoolArray, ControlPoints, IntArray

FIRST_TOLERANCE_PX = 3.0
"""Displacements of a first search agree within this many pixels of the chips that are searched."""
_NOTHING = 0.1
"""Share of the points tried that random pixels show at most."""
MOST_CANDIDATES = 3
"""Number of groups of matches that a summary shows."""
MOST_CANDIDATE_POINTS = 20
"""Groups are not looked for where more matches than this, and most of all, agree."""


@dataclass(frozen=True)
class Search:
    """One search of points through one model.

    Attributes:
        points: the k points that were tried.
        rows: (k,) their rows among all visible points of the registration, ascending.
        matches: of the points tried.
        inliers: (k,) points that agree on one displacement of the image.
        chip_side_m: side on the ground of the chips that were searched.
        displacement: of the model of the search, beyond an affine one; None where it has none.
        breaks: first lines behind breaks of the image; None for none.
    """

    points: ControlPoints
    rows: IntArray
    matches: PointMatches
    inliers: BoolArray
    chip_side_m: float
    displacement: DisplacementGrid | None = None
    breaks: IntArray | None = None


def largest_error_m(uncertainty_m: Array) -> float:
    """Largest expected error of 95 % of points, from the standard deviations (n,) of their positions."""
    return MAX_ERROR_SIGMAS * float(np.percentile(uncertainty_m, 95))


def search_radius_px(error_m: float, gsd_m: float) -> int:
    """Search radius that holds an error, pixels of a ground sampling."""
    return max(4, math.ceil(error_m / gsd_m) + 2)


def adjust_search(
    scene: Scene,
    search: Search,
    options: AdjustmentOptions,
    *,
    usable: BoolArray | None = None,
    min_points: int | None = None,
    like: SceneAdjustment | None = None,
    ground_may_move: bool = False,
) -> SceneAdjustment:
    """The correction of a scene from the matches of a search; see `adjust_scene`.

    Args:
        scene: as delivered.
        search: of the points.
        options: of the adjustment.
        usable: (k,) matches that may be used; the inliers when None.
        min_points: smallest number of active measures; that of the options when None.
        like: an adjustment of these matches and others, whose prior and shared errors hold.
        ground_may_move: whether an area of the ground may be left out.
    """
    observations = control_observations(scene, search, search.inliers if usable is None else usable)
    return adjust_scene(
        scene.model,
        scene.image.shape,
        observations,
        options,
        min_points=min_points,
        like=like,
        ground_may_move=ground_may_move,
    )


def shears_of_active(scene: Scene, search: Search, active: BoolArray) -> ChipShears | None:
    """The shears of chips of active points (n,), with their rows among all that the scene may show.

    None for an ortho-image, whose relief is displaced by what its terrain lacked.
    """
    shears = search.matches.shears
    if shears is None or isinstance(scene.model, OrthoModel):
        return None
    shears = replace(shears, point=search.rows[shears.point])
    return shears.take(active[shears.point])


def control_observations(scene: Scene, search: Search, usable: BoolArray) -> ControlObservations:
    """What a scene shows of the points of a search, of which those of a mask (k,) may be used."""
    matches = search.matches
    derivative = scene.model.project_derivative(scene_centre(scene)[None, :])[0]
    ground_to_px = derivative[:, :2]
    shared_m2 = shared_frame(search.points, usable).shared_m2
    chip_side_px = search.chip_side_m * float(abs(np.linalg.det(ground_to_px)) ** 0.5)
    line_sample = matches.line_sample
    if search.displacement is not None:
        # Chips average over their pixels: what they were compared through, they did not.
        place = scene.model.project(search.points.lon_lat_h)
        followed = search.displacement.at(place) - search.displacement.averaged(place, chip_side_px)
        line_sample = line_sample - followed
    return ControlObservations(
        lon_lat_h=search.points.lon_lat_h,
        line_sample=line_sample,
        sigma_px=matches.sigma_px,
        covariance_m2=search.points.covariance_m2,
        usable=usable,
        stated=search.points.id < 0,
        common_covariance_px2=ground_to_px @ matches.common_covariance_m2 @ ground_to_px.T,
        deformation_px2=derivative @ shared_m2 @ derivative.T,
        block=search.points.block,
        frame_covariance_m2=np.array([frame.covariance_m2 for frame in search.points.frames]),
        chip_side_px=chip_side_px,
        breaks=search.breaks,
    )


def select_inliers(
    model: SensorModel, points: ControlPoints, matches: PointMatches
) -> tuple[BoolArray, float]:
    """Points (n,) whose matches agree on one affine displacement, and the tolerance, pixels.

    Args:
        model: that predicted the points.
        points: those that were tried.
        matches: of these points.
    """
    matched = matches.reason == ""
    if not matched.any():
        return matched, consensus_tolerance_px(0.0)
    predicted = model.project(points.lon_lat_h)
    sigma_px = float(np.median(_point_sigma_px(model, points, matches)[matched]))
    displacement_px = matches.line_sample - predicted
    inliers, scale = robust_affine_inliers(predicted, displacement_px, matched, sigma_px, points.block)
    return inliers, consensus_tolerance_px(scale * sigma_px)


def check_inliers(
    stage: SearchStage,
    tolerance_px: float,
    reason: np.ndarray,
    scene: Scene,
    min_points: int,
    *,
    of_another: Callable[[], str] = lambda: "",
) -> None:
    """Refuse a search of whose points too few agree.

    Args:
        stage: summary of the search.
        tolerance_px: within which its inliers agree.
        reason: (k,) why points were not found.
        scene: that was searched.
        min_points: smallest number of inliers.
        of_another: what the matches tell of another model, where they are refused; "" for nothing.

    Raises:
        NotEnoughPoints: fewer points were found than are needed.
        NoConsensus: fewer of the points found agree than are needed.
    """
    if stage.matched < min_points:
        raise NotEnoughPoints(
            stage.matched,
            min_points,
            f"{stage.tried} tried within {stage.search_radius_m:.1f} m, {format_reasons(reason)}; "
            + next_step(stage, scene.sigma_m),
        )
    if stage.inliers < min_points:
        agreeing = f"only {stage.inliers}" if stage.inliers > 1 else "no two"
        raise NoConsensus(
            f"{stage.matched} points found of {stage.tried} tried within {stage.search_radius_m:.1f} m, "
            f"but {agreeing} of them agree within {tolerance_px:.1f} px, {min_points} needed; "
            + (of_another() or next_step(stage, scene.sigma_m))
        )


def _point_sigma_px(model: SensorModel, points: ControlPoints, matches: PointMatches) -> Array:
    """Standard deviation (k,) of the measures against the points' own positions, pixels."""
    derivative = model.project_derivative(points.lon_lat_h)
    covariance = derivative @ points.covariance_m2 @ derivative.transpose(0, 2, 1)
    return np.asarray(np.sqrt(matches.sigma_px**2 + np.trace(covariance, axis1=1, axis2=2) / 2.0))


def predict(scene: Scene, points: ControlPoints, adjustment: SceneAdjustment) -> Prediction:
    """Where an adjusted scene shows points (n,), and how precisely.

    The uncertainty includes what the residuals show beyond the stated sigmas: a point still to be found
    may be as far off as the points found.
    """
    model = CorrectedModel(scene.model, adjustment.correction)
    line_sample = model.project(points.lon_lat_h)
    variance = np.diagonal(adjustment.covariance_at(line_sample), axis1=1, axis2=2)
    std_px = np.sqrt(variance.max(axis=1))
    residual_px = float(np.sqrt(np.mean(adjustment.residual_px[adjustment.active] ** 2)))
    gsd_m = image_gsds_m(model, points.lon_lat_h)
    uncertainty_m = np.nan_to_num(np.hypot(std_px, residual_px) * gsd_m, nan=0.0)
    return Prediction(model, np.asarray(uncertainty_m))


def summarise(
    name: str,
    matches: PointMatches,
    inliers: BoolArray,
    *,
    level_m: float,
    radius_m: float,
    needed_m: float,
    voters: Voters,
    lon_lat_h: Array,
) -> SearchStage:
    """The summary of a search of places on known ground (n, 3); see `SearchStage`."""
    displacement_m = matches.displacement_m[inliers]
    rms_m = float(np.sqrt((displacement_m**2).sum(axis=1).mean())) if len(displacement_m) else math.nan
    return SearchStage(
        name=name,
        chip_gsd_m=level_m,
        search_radius_m=radius_m,
        needed_radius_m=needed_m,
        tried=len(matches.reason),
        matched=int((matches.reason == "").sum()),
        at_border=int((matches.reason == "border_peak").sum()),
        inliers=int(inliers.sum()),
        displacement_rms_m=rms_m,
        not_found=tuple(NotFound(*counted) for counted in _count_reasons(matches.reason)),
        candidates=_candidates(
            matches,
            inliers,
            lon_lat_h,
            tolerance_m=FIRST_TOLERANCE_PX * level_m,
            radius_m=radius_m,
            voters=voters,
        ),
    )


def _candidates(
    matches: PointMatches,
    inliers: BoolArray,
    lon_lat_h: Array,
    *,
    tolerance_m: float,
    radius_m: float,
    voters: Voters,
) -> tuple[Candidate, ...]:
    """The largest groups of matches that agree; none where most matches, and many, agree."""
    found = matches.reason == ""
    if inliers.sum() > max(found.sum() / 2.0, MOST_CANDIDATE_POINTS):
        return ()
    displacement_m = np.full((len(found), 2), np.nan)
    displacement_m[found] = _in_one_frame(lon_lat_h[found], matches.displacement_m[found])
    candidates: list[Candidate] = []
    while len(candidates) < MOST_CANDIDATES:
        group = a_contrario_consensus(displacement_m, tolerance_m, radius_m, voters)
        count = int(group.inliers.sum())
        if count < 2:
            break
        east_m, north_m = displacement_m[group.inliers].mean(axis=0).tolist()
        candidates.append(Candidate(count, east_m, north_m, group.false_alarms))
        displacement_m[group.inliers] = np.nan
    return tuple(candidates)


def _in_one_frame(lon_lat_h: Array, displacement_m: Array) -> Array:
    """Displacements (n, 2), each east and north of its place (n, 3), in the frame of their middle.

    Meridians converge: a model that is off by a constant angle moves places of different longitudes by
    different metres east and north.
    """
    if not len(lon_lat_h):
        return displacement_m
    to_middle = ecef_from_east_north_up(continuous(lon_lat_h).mean(axis=0)).T[:2]
    moved = zip(lon_lat_h, displacement_m, strict=True)
    return np.array([to_middle @ ecef_from_east_north_up(place)[:, :2] @ d for place, d in moved])


def first_consensus(
    scene: Scene,
    predicted: Array,
    measured: Array,
    *,
    level_m: float,
    radius_m: float,
    side_m: float,
    cut_px: Array | float = 0.0,
) -> Consensus:
    """The displacements of a first search that agree, and whether beyond chance.

    Displacements are compared in the image: a model that is off by a constant angle moves all points by
    the same pixels, but neither by the same metres (a wide scene is oblique at one side) nor in the same
    direction from north (meridians converge).

    Args:
        scene: that was searched.
        predicted, measured: (n, 2) pixels of the scene; NaN where not found.
        level_m: ground sampling of what was searched.
        radius_m: search radius.
        side_m: side of the chips.
        cut_px: (2,) lines and samples at each border of the scene that were not searched.
    """
    gsd_m = scene_gsd_m(scene)
    last = np.array(scene.image.shape) - 1.0
    margin, radius = side_m / 2.0 / gsd_m + cut_px, radius_m / gsd_m
    low = np.maximum(margin - predicted, -radius)
    high = np.minimum(last - margin - predicted, radius)
    return a_contrario_consensus(
        measured - predicted,
        FIRST_TOLERANCE_PX * level_m / gsd_m,
        np.stack([low, high], axis=1),
        Voters(predicted, side_m / gsd_m),
    )


def check_consensus(
    stage: SearchStage,
    consensus: Consensus,
    reason: np.ndarray,
    scene: Scene,
    max_false_alarms: float,
    *,
    of_another: Callable[[], str] = lambda: "",
) -> None:
    """Refuse a first search whose matches agree no better than by chance.

    Args:
        stage: summary of the search.
        consensus: of its displacements.
        reason: (k,) why points were not found.
        scene: that was searched.
        max_false_alarms: largest number of false alarms that is accepted.
        of_another: what the matches tell of another model, where they are refused; "" for nothing.

    Raises:
        NoConsensus: with the numbers of the search and the next step.
    """
    if stage.inliers >= 2 and consensus.false_alarms <= max_false_alarms:
        return
    agreement = "no two of them agree"
    if stage.inliers >= 2:
        agreement = (
            f"{stage.inliers} of them within {FIRST_TOLERANCE_PX * stage.chip_gsd_m:g} m of each other, "
            f"which chance explains ({consensus.false_alarms:.2g} such groups expected, at most "
            f"{max_false_alarms:g} accepted)"
        )
    who, noun = f"the {stage.name} search does not agree on", "points"
    if stage.name == "reference":
        who, noun = "the reference does not agree with the scene on", "places"
    where = ""
    if np.isfinite(stage.middle_m):
        where = f" in the middle {stage.middle_m / 1000.0:.1f} km of the scene only, which is larger"
    raise NoConsensus(
        f"{who} one correction: {stage.tried} {noun} tried within {stage.search_radius_m:.0f} m{where}, "
        f"{stage.matched} found, {agreement}; {format_reasons(reason)}; "
        + (of_another() or next_step(stage, scene.sigma_m))
    )


def larger_sigma_m(stage: SearchStage | None, sigma_m: float) -> float:
    """An accuracy of the model that searches about twice as far as a stage did, two digits.

    Args:
        stage: summary of the search; None when there was none.
        sigma_m: stated accuracy of the scene, which set the radius of the first search.
    """
    reach_m = 0.0 if stage is None else stage.search_radius_m / MAX_ERROR_SIGMAS
    # The smallest radius is a few pixels, however small the stated accuracy is.
    return float(f"{2.0 * (reach_m if reach_m > 2.0 * sigma_m else sigma_m):.2g}")


def sees_nothing(stage: SearchStage) -> bool:
    """Whether a search found no more of its points than random pixels show."""
    return stage.matched <= _NOTHING * stage.tried


def next_step(stage: SearchStage, sigma_m: float) -> str:
    """What to think of and to try after a search that was refused, with the option written out.

    Args:
        stage: summary of the search.
        sigma_m: stated accuracy of the scene, which set the radius of the first search.
    """
    if not sees_nothing(stage):
        return _to_try(stage, sigma_m)
    return (
        "next to none of the points is seen: the image may be that of another scene than its model; "
        + _to_try(stage, sigma_m)
    )


def _to_try(stage: SearchStage, sigma_m: float) -> str:
    """What to try after a search that was refused; see `next_step`."""
    option = f"--sigma-m {larger_sigma_m(stage, sigma_m):g}"
    if stage.limited:
        smaller_m = float(f"{stage.search_radius_m / MAX_ERROR_SIGMAS:.2g}")
        return (
            f"the search reached {stage.search_radius_m:.0f} m of the {stage.needed_radius_m:.0f} m "
            "that the accuracy of the model asks for: give points with coarser chips, or, where the "
            f"error is known to be smaller, try --sigma-m {smaller_m:g}"
        )
    if stage.at_border > stage.tried / 2.0:
        return (
            f"{stage.at_border} best peaks lie at the border of the search: the model is probably "
            f"further off, try {option}"
        )
    if np.isfinite(stage.middle_m):
        return (
            "give points with coarser chips, so that all of the scene is searched, or points that show "
            f"its middle; when the model may be further off, try {option}"
        )
    return (
        "check that the points show the ground of the scene; when the model may be further off, "
        f"try {option}"
    )


def format_reasons(reason: np.ndarray) -> str:
    """Numbers of points that were not found, by reason: "22 low_score, 16 nodata"."""
    return ", ".join(f"{count} {name}" for name, count in _count_reasons(reason)) or "none rejected"


def _count_reasons(reason: np.ndarray) -> list[tuple[str, int]]:
    """Numbers of points that were not found, by reason, commonest first."""
    return Counter(str(r) for r in reason if r).most_common()
