"""Scenes under difficult conditions, registered and compared with the truth."""

import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np

from benchmarks._trials import Trial
from benchmarks._worlds import FINE_GSD_M, Block, Place, world_of
from services.errors import AmersError
from services.geodesy import move_metres
from services.imagery.scene import Scene
from services.quality.accuracy import CIRCULAR_CE90, accuracy, normalised_error
from services.registration.on_points import Registration, register_scene
from services.registration.options import RegistrationOptions
from services.simulation.conditions import Conditions
from services.simulation.render import surface_seen
from services.simulation.tiles import TiledView
from services.simulation.view import ViewGeometry, ViewPlan, plan_geometry
from services.simulation.world import World
from services.types import Array, ControlPoints, Frame

FRAME_SIGMA_M = 0.5
LE90_OF_CE90 = 5.0 / 3.0
"""Ratio of the points: 5 m to 3 m in SRP."""
WRONG = 3.0
"""A result is wrong when its CE90 exceeds the predicted CE90 this many times."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one scene.

    Attributes:
        verdict: "good", "usable" or "failed"; "refused" when there is no result.
        reason: the unmet criteria, or why there is no result.
        visible, matched, active: numbers of points.
        order: of the correction.
        ce90_before_m, ce90_m: against the truth in the frame of the block, over the whole image.
        ground_ce90_m: against the truth on the Earth.
        predicted_m, predicted_worst_m: CE90 as stated, median and worst over the image.
        normalised: mean square of true errors over stated deviations, over the image.
        displacement_m: stability test, largest of the medians of the corners and the centre.
        cpu_s: of the registration, with the rendering of the pixels that it reads.
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

    @property
    def delivered(self) -> bool:
        """Whether the verdict allows the use of the model."""
        return self.verdict in ("good", "usable")

    @property
    def wrong(self) -> bool:
        """Whether the true error is more than `WRONG` times the predicted one."""
        return not self.ce90_m <= WRONG * self.predicted_m


@dataclass(frozen=True)
class Prepared:
    """A scene and points with errors, and the truth."""

    scene: Scene
    points: ControlPoints
    geometry: ViewGeometry
    frame_shift_m: Array


def prepare(place: Place, trial: Trial, block: Block, seed: int) -> Prepared:
    """The scene of a trial, with errors in its model and in the points."""
    world = world_of(place)
    rng = np.random.default_rng([seed, trial.number, 1])
    lon, lat = world.centre_lon_lat.tolist()
    plan = ViewPlan(
        f"scene_{trial.number}",
        (lon, lat),
        (place.lines, place.lines),
        trial.gsd_m,
        trial.incidence_deg,
        trial.azimuth_deg,
        datetime(2024, 1, 1, 10, 40, tzinfo=UTC) + timedelta(days=trial.day),
    )
    towards = rng.uniform(0.0, 2.0 * np.pi)
    error_m = trial.location_error_m * np.sin(towards), trial.location_error_m * np.cos(towards)
    error_px = np.zeros((2, 3))
    error_px[:, 1:] = trial.drift_px * rng.uniform(-1.0, 1.0, (2, 2))
    geometry = plan_geometry(world, plan, rng, error_m, error_px)
    conditions = Conditions(trial.haze, trial.cloud_cover, trial.inverted, trial.season, trial.noise)
    image = TiledView(world, geometry, int(rng.integers(2**31)), conditions)
    scene = Scene(image, geometry.delivered, geometry.acquisition, trial.sigma_m)
    shift_m = np.append(rng.normal(0.0, FRAME_SIGMA_M, 2), 0.0)
    return Prepared(scene, _spoiled(block.points, trial, shift_m, rng), geometry, shift_m)


def _spoiled(
    points: ControlPoints, trial: Trial, shift_m: Array, rng: np.random.Generator
) -> ControlPoints:
    """Points with the errors of a trial: a common shift, noise, moved points, vanished chips."""
    n = len(points)
    sigma_m = trial.point_ce90_m * np.array(
        [1.0 / CIRCULAR_CE90, 1.0 / CIRCULAR_CE90, LE90_OF_CE90 / 1.6449]
    )
    offset_m = shift_m + trial.understated * sigma_m * rng.standard_normal((n, 3))
    order = rng.permutation(n)
    moved, vanished = np.split(order, [round(trial.moved * n)])
    vanished = vanished[: round(trial.vanished * n)]
    far_m = rng.uniform(2.0, 20.0, len(moved)) * max(FINE_GSD_M, trial.gsd_m)
    towards = rng.uniform(0.0, 2.0 * np.pi, len(moved))
    offset_m[moved, :2] += far_m[:, None] * np.column_stack([np.sin(towards), np.cos(towards)])
    chip_row = points.chip_row.copy()
    chip_row[vanished] = np.roll(chip_row[vanished], 1)
    return replace(
        points,
        lon_lat_h=move_metres(points.lon_lat_h, offset_m),
        covariance_m2=points.covariance_m2 + np.diag(sigma_m**2),
        frames=(Frame.from_sigmas(FRAME_SIGMA_M, 0.0),),
        chip_row=chip_row,
    )


def attempt(
    place: Place, trial: Trial, block: Block, seed: int, options: RegistrationOptions
) -> Outcome:
    """The outcome of registering the scene of a trial."""
    prepared = prepare(place, trial, block, seed)
    world = world_of(place)
    start_s = time.process_time()
    try:
        registration = register_scene(
            prepared.scene,
            prepared.points,
            replace(block, points=prepared.points),
            options,
        )
    except AmersError as error:
        nan = float("nan")
        cpu_s = time.process_time() - start_s
        return Outcome("refused", str(error), 0, 0, 0, "", nan, nan, nan, nan, nan, nan, nan, cpu_s)
    return _judged(world, prepared, registration, time.process_time() - start_s)


def _judged(world: World, prepared: Prepared, registration: Registration, cpu_s: float) -> Outcome:
    """The errors of a registration against the true sensor, on a grid over the whole image."""
    shape = prepared.scene.image.shape
    axes = [np.linspace(0.0, size - 1.0, 12) for size in shape]
    line_sample = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    shown = surface_seen(world, prepared.geometry.true_model, line_sample)
    in_frame = move_metres(shown, np.broadcast_to(prepared.frame_shift_m, shown.shape))

    def error_px(ground: Array) -> Array:
        return np.asarray(registration.model.project(ground) - line_sample)

    inverse = np.linalg.inv(registration.model.project_derivative(shown)[:, :, :2])

    def ce90_m(error: Array) -> float:
        return accuracy((inverse @ error[:, :, None])[:, :, 0]).ce90_m.value

    error = error_px(in_frame)
    before = prepared.scene.model.project(shown) - line_sample
    quality = registration.qualification
    honest = normalised_error(error, registration.adjustment.covariance_at(line_sample))
    moved_m = [place.median_m for place in quality.stability.displacements]
    return Outcome(
        verdict=quality.verdict,
        reason="; ".join(c.name for c in quality.criteria if not c.met),
        visible=quality.point_counts.visible,
        matched=quality.point_counts.matched,
        active=quality.point_counts.active,
        order=registration.adjustment.order,
        ce90_before_m=ce90_m(before),
        ce90_m=ce90_m(error),
        ground_ce90_m=ce90_m(error_px(shown)),
        predicted_m=quality.predicted.median_m,
        predicted_worst_m=quality.predicted.worst_m,
        normalised=honest.mean_square,
        displacement_m=max(moved_m, default=float("nan")),
        cpu_s=cpu_s,
    )
