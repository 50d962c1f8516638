"""Scenes under difficult conditions, registered and compared with the truth."""

import time
from dataclasses import dataclass, replace

import numpy as np

from amers.services.errors import AmersError
from amers.services.imagery.scene import Scene
from amers.services.quality.accuracy import accuracy, normalised_error
from amers.services.quality.frames import frame_in_image
from amers.services.quality.normal_law import normal_ce90
from amers.services.registration.on_points import Registration, register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.simulation.tiles import Tiles
from amers.services.types import Array, ChipSource, ControlPoints
from benchmarks._scenes import Prepared, Truth, prepare
from benchmarks._trials import Trial
from benchmarks._worlds import Block, Place

SOURCES = ("outcome", "distortions", "point_errors", "scenes", "trials", "worlds")
"""Modules of the benchmarks that outcomes follow from."""
WRONG = 3.0
"""A result is wrong when its CE90 exceeds the predicted CE90 this many times."""
WRONG_PART = 0.1
"""A result is wrong in part when this share of the image is wrong by that."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one scene.

    Attributes:
        verdict: "good", "usable" or "failed"; "refused" when there is no result.
        reason: the unmet criteria and the findings, or why there is no result.
        visible, matched, active: numbers of points.
        order: of the correction.
        ce90_before_m: of the delivered model, against the truth on the Earth, over the whole image.
        ce90_m, ground_ce90_m: against the truth in the frame of the active points, and on the Earth.
        predicted_m, predicted_worst_m: CE90 as stated, over the image and at its worst place.
        normalised: mean square of true errors over stated deviations, over the image.
        displacement_m: stability test, largest of the medians of the corners and the centre.
        cpu_s: of the registration, with the rendering of the pixels that it reads and no run kept.
        ground_predicted_m: CE90 on the Earth as stated, with the frame of the blocks; median.
        ground_normalised: as `normalised`, on the Earth.
        wrong_share: of the image that is off by more than `WRONG` times the CE90 predicted there.
        judged_share: of the image: neither moved ground, nor shown twice. All else is left aside.
        held_percent: share of the image that points support: all figures of errors are of that part.
        line_gap_px: median distance along lines from an active point to the next.
        spacing_px: of the points that were searched, if they were evenly spread.
        followable: whether a distortion is smooth enough for that spacing: its shortest period is at
            least twice as long.
    """

    verdict: str
    reason: str
    visible: int
    matched: int
    active: int
    order: str
    ce90_before_m: float
    ce90_m: float
    ground_ce90_m: float
    predicted_m: float
    predicted_worst_m: float
    normalised: float
    displacement_m: float
    cpu_s: float
    ground_predicted_m: float = float("nan")
    ground_normalised: float = float("nan")
    wrong_share: float = float("nan")
    judged_share: float = 1.0
    line_gap_px: float = float("nan")
    spacing_px: float = float("nan")
    followable: bool = False
    held_percent: float = 100.0

    @property
    def delivered(self) -> bool:
        """Whether the verdict allows the use of the model."""
        return self.verdict in ("good", "usable")

    @property
    def wrong(self) -> bool:
        """Whether the true error is more than `WRONG` times the predicted one."""
        return not self.ce90_m <= WRONG * self.predicted_m

    @property
    def wrong_on_earth(self) -> bool:
        """Whether the true error on the Earth is more than `WRONG` times the predicted one."""
        return not self.ground_ce90_m <= WRONG * self.ground_predicted_m

    @property
    def wrong_in_part(self) -> bool:
        """Whether more than `WRONG_PART` of the image is wrong where its accuracy is predicted."""
        return not self.wrong_share <= WRONG_PART


Result = tuple[Trial, Outcome]


def attempt(
    place: Place,
    trial: Trial,
    block: Block,
    seed: int,
    options: RegistrationOptions,
    *,
    tiles: Tiles | None = None,
) -> Outcome:
    """The outcome of registering the scene of a trial; tiles as for `prepare`."""
    prepared = prepare(place, trial, block, seed, tiles)
    return registered(prepared, replace(block, points=prepared.points), options)[0]


def registered(
    prepared: Prepared, chips: ChipSource, options: RegistrationOptions
) -> tuple[Outcome, Registration | None]:
    """The outcome of registering a scene, and the registration; None when it is refused."""
    return outcome_of(prepared.scene, prepared.points, chips, options, prepared.truth())


def outcome_of(
    scene: Scene, points: ControlPoints, chips: ChipSource, options: RegistrationOptions, truth: Truth
) -> tuple[Outcome, Registration | None]:
    """The outcome of registering a scene on points, and the registration; None when it is refused."""
    start_s = time.process_time()
    try:
        registration = register_scene(scene, points, chips, options)
    except AmersError as error:
        cpu_s = time.process_time() - start_s
        refused = Outcome("refused", str(error), 0, 0, 0, "", *[float("nan")] * 7, cpu_s)
        return _with_spacing(refused, truth, scene, options), None
    cpu_s = time.process_time() - start_s
    measures = registration.measures
    used = points.block[np.isin(points.id, measures.point_id[measures.active])]
    outcome = _judged(scene, registration, truth, truth.in_frame(used), cpu_s)
    return _with_spacing(outcome, truth, scene, options), registration


def _with_spacing(outcome: Outcome, truth: Truth, scene: Scene, options: RegistrationOptions) -> Outcome:
    """The outcome with the spacing of the searched points: by the truth, also where it is refused."""
    searched = min(truth.shown_points, options.max_points or truth.shown_points)
    spacing_px = float(np.sqrt(np.prod(scene.image.shape) / max(searched, 1)))
    return replace(outcome, spacing_px=spacing_px, followable=truth.shortest_px >= 2.0 * spacing_px)


def _judged(
    scene: Scene, registration: Registration, truth: Truth, in_frame: Array, cpu_s: float
) -> Outcome:
    """The errors of a registration against the truth; the ground (n, 3) also as its points say."""
    quality = registration.qualification
    held = quality.coverage.holds(truth.line_sample)
    line_sample, shown, in_frame = truth.line_sample[held], truth.on_earth[held], in_frame[held]

    def error_px(ground: Array) -> Array:
        return np.asarray(registration.model.project(ground) - line_sample)

    derivative = registration.model.project_derivative(shown)
    inverse = np.linalg.inv(derivative[:, :, :2])

    def on_ground_m(error: Array) -> Array:
        return np.asarray((inverse @ error[:, :, None])[:, :, 0])

    def ce90_m(error: Array) -> float:
        return accuracy(on_ground_m(error)).ce90_m.value

    error, on_earth = error_px(in_frame), error_px(shown)
    covariance = registration.adjustment.covariance_at(line_sample)
    both = covariance + frame_in_image(registration.frame, derivative, registration.adjustment.apart_px)
    local_m = normal_ce90(inverse @ covariance @ inverse.transpose(0, 2, 1))
    right = np.hypot(*on_ground_m(error).T) <= WRONG * local_m
    measures = registration.measures
    lines = np.sort(measures.line_sample[measures.active, 0])
    told = [one.name for one in quality.findings]
    moved_m = [place.median_m for place in quality.stability.displacements]
    return Outcome(
        verdict=quality.verdict,
        reason="; ".join([c.name for c in quality.criteria if not c.met] + told),
        visible=quality.point_counts.visible,
        matched=quality.point_counts.matched,
        active=quality.point_counts.active,
        order=registration.adjustment.order,
        ce90_before_m=ce90_m(scene.model.project(shown) - line_sample),
        ce90_m=ce90_m(error),
        ground_ce90_m=ce90_m(on_earth),
        predicted_m=quality.predicted.overall_m,
        predicted_worst_m=quality.predicted.worst_m,
        normalised=normalised_error(error, covariance).mean_square,
        displacement_m=max(moved_m, default=float("nan")),
        cpu_s=cpu_s,
        ground_predicted_m=quality.predicted.on_the_earth_overall_m,
        ground_normalised=normalised_error(on_earth, both).mean_square,
        wrong_share=float(1.0 - right.mean()),
        judged_share=truth.judged_share,
        line_gap_px=float(np.median(np.diff(lines))),
        held_percent=quality.coverage.percent,
    )
