"""Scenes under difficult conditions, registered and compared with the truth."""

import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np

from benchmarks._distortions import distortion_of
from benchmarks._point_errors import BlockErrors, spoil
from benchmarks._trials import Trial
from benchmarks._worlds import Block, Place, world_of
from services.errors import AmersError
from services.geodesy import metres_per_degree
from services.imagery.scene import Scene
from services.imagery.source import ImageSource
from services.matching.predict import in_image
from services.quality.accuracy import accuracy, normal_ce90, normalised_error
from services.quality.frames import frame_in_image
from services.registration.on_points import Registration, register_scene
from services.registration.options import RegistrationOptions
from services.sensors.rpc import RpcModel
from services.simulation.conditions import Conditions
from services.simulation.defects import Damage, DamagedImage
from services.simulation.detectors import Detectors
from services.simulation.distortion import Distortion
from services.simulation.render import surface_seen
from services.simulation.tiles import TiledView, Tiles
from services.simulation.view import ViewGeometry, ViewPlan, plan_geometry
from services.simulation.world import World, with_smoother_terrain
from services.types import Array, ChipSource, ControlPoints

WRONG = 3.0
"""A result is wrong when its CE90 exceeds the predicted CE90 this many times."""
WRONG_PART = 0.1
"""A result is wrong in part when this share of the image is wrong by that."""


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
        cpu_s: of the registration, with the rendering of the pixels that it reads and no run kept.
        ground_predicted_m: CE90 on the Earth as stated, with the frame of the blocks; median.
        ground_normalised: as `normalised`, on the Earth.
        wrong_share: of the image that is off by more than `WRONG` times the CE90 predicted there.
        judged_share: of the image: neither moved ground, nor shown twice. All else is left aside.
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


@dataclass(frozen=True)
class Truth:
    """What the pixels of a scene show, and how well points can tell.

    Attributes:
        line_sample: (n, 2) pixels all over the image that show what belongs there.
        in_frame, on_earth: (n, 3) their ground, as the points say and as it is.
        judged_share: of the image that such pixels stand for.
        shown_points: number of points that the image shows.
        shortest_px: period that points must resolve to follow the distortion, see `Drawn`.
    """

    line_sample: Array
    in_frame: Array
    on_earth: Array
    judged_share: float
    shown_points: int
    shortest_px: float = 0.0


@dataclass(frozen=True)
class Prepared:
    """A scene and points with errors, and the truth.

    Attributes:
        scene, points: what a registration gets.
        world: what the scene shows.
        geometry, detectors, distortion: the truth about its image.
        errors: of the blocks of the points.
        shortest_px: period that points must resolve to follow the distortion, see `Drawn`.
    """

    scene: Scene
    points: ControlPoints
    world: World
    geometry: ViewGeometry
    detectors: Detectors
    errors: BlockErrors
    distortion: Distortion
    shortest_px: float = 0.0

    def shown(self, line_sample: Array) -> Array:
        """The ground (n, 3) that pixels (n, 2) show."""
        seen = self.detectors.seen(line_sample, self.scene.image.shape[1])
        return surface_seen(self.world, self.geometry.true_model, self.distortion.undistorted(seen))

    def truth(self) -> Truth:
        """The truth at pixels all over the image."""
        shape = self.scene.image.shape
        axes = [np.linspace(0.0, size - 1.0, n) for size, n in zip(shape, self._judged, strict=True)]
        pixels = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        unique = self.distortion.is_unique(pixels)
        pixels = pixels[unique]
        on_earth = self.shown(pixels)
        place = self.geometry.true_model.project(self.points.lon_lat_h)
        return Truth(
            line_sample=pixels,
            in_frame=self.errors.in_frame(on_earth),
            on_earth=on_earth,
            judged_share=float(unique.mean()),
            shown_points=int(in_image(place, shape, 0.0).sum()),
            shortest_px=self.shortest_px,
        )

    @property
    def _judged(self) -> tuple[int, int]:
        """Numbers of pixels along lines and samples that are judged: jitter needs many lines."""
        return (12, 12) if self.distortion.is_none else (48, 12)


def prepare(place: Place, trial: Trial, block: Block, seed: int, tiles: Tiles | None = None) -> Prepared:
    """The scene of a trial, with errors in its model, in its pixels and in the points.

    Args:
        place: its world.
        trial: what is drawn.
        block: the points without errors.
        seed: of the campaign.
        tiles: of the scene, rendered before; those that are rendered are added.
    """
    world = world_of(place)
    if trial.terrain_m > 0.0:
        world = with_smoother_terrain(world, trial.terrain_m)
    rng = np.random.default_rng([seed, trial.number, 1])
    more = np.random.default_rng([seed, trial.number, 2])
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
    steps = more.uniform(-1.0, 1.0, (trial.parts, 2)) * trial.seam_px
    detectors = Detectors(steps - steps.mean(axis=0), (trial.smear_px, trial.blur_px))
    shape = place.lines, place.lines
    distorting = np.random.default_rng([seed, trial.number, 6])
    distortion = distortion_of(trial.distortion, shape, trial.gsd_m, distorting)
    image: ImageSource = TiledView(
        world,
        geometry,
        int(rng.integers(2**31)),
        conditions,
        detectors,
        distortion=distortion,
        tiles=tiles,
    )
    if trial.bits != 12 or trial.damaged > 0.0:
        damage = Damage(trial.bits, trial.damaged, trial.missing, trial.patch_px, trial.brightest)
        image = DamagedImage(image, damage, trial.number)
    delivered = geometry.delivered
    if trial.distortion.tilt_deg > 0.0:
        delivered = _of_another_view(world, plan, trial, error_m, distorting)
    scene = Scene(image, delivered, geometry.acquisition, trial.sigma_m)
    side_m = trial.gsd_m * place.lines
    points, errors = spoil(block.points, trial, world.centre_lon_lat, side_m, rng=rng, more=more)
    shortest_px = trial.distortion.shortest_px
    return Prepared(scene, points, world, geometry, detectors, errors, distortion, shortest_px)


def _of_another_view(
    world: World, plan: ViewPlan, trial: Trial, error_m: tuple[float, float], rng: np.random.Generator
) -> RpcModel:
    """The model of a view from another direction, of the same place or of one beside it."""
    incidence, azimuth = np.radians([trial.incidence_deg, trial.azimuth_deg])
    towards = rng.uniform(0.0, 2.0 * np.pi, 2)
    direction = np.tan(incidence) * np.array([np.sin(azimuth), np.cos(azimuth)])
    tilt = np.tan(np.radians(trial.distortion.tilt_deg))
    direction += tilt * np.array([np.sin(towards[0]), np.cos(towards[0])])
    away_m = trial.distortion.away * plan.gsd_m * plan.shape[0]
    per_degree = metres_per_degree(plan.lon_lat[1], 0.0)
    east, north = away_m * np.sin(towards[1]), away_m * np.cos(towards[1])
    other = replace(
        plan,
        lon_lat=(plan.lon_lat[0] + east / per_degree[0], plan.lon_lat[1] + north / per_degree[1]),
        incidence_deg=float(np.degrees(np.arctan(np.hypot(*direction)))),
        azimuth_deg=float(np.degrees(np.arctan2(*direction)) % 360.0),
    )
    return plan_geometry(world, other, rng, error_m).delivered


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
    outcome = _judged(scene, registration, truth, time.process_time() - start_s)
    return _with_spacing(outcome, truth, scene, options), registration


def _with_spacing(outcome: Outcome, truth: Truth, scene: Scene, options: RegistrationOptions) -> Outcome:
    """The outcome with the spacing of the searched points: by the truth, also where it is refused."""
    searched = min(truth.shown_points, options.max_points or truth.shown_points)
    spacing_px = float(np.sqrt(np.prod(scene.image.shape) / max(searched, 1)))
    return replace(outcome, spacing_px=spacing_px, followable=truth.shortest_px >= 2.0 * spacing_px)


def _judged(scene: Scene, registration: Registration, truth: Truth, cpu_s: float) -> Outcome:
    """The errors of a registration against the truth."""
    line_sample, shown, in_frame = truth.line_sample, truth.on_earth, truth.in_frame

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
    quality = registration.qualification
    moved_m = [place.median_m for place in quality.stability.displacements]
    return Outcome(
        verdict=quality.verdict,
        reason="; ".join(c.name for c in quality.criteria if not c.met),
        visible=quality.point_counts.visible,
        matched=quality.point_counts.matched,
        active=quality.point_counts.active,
        order=registration.adjustment.order,
        ce90_before_m=ce90_m(scene.model.project(shown) - line_sample),
        ce90_m=ce90_m(error),
        ground_ce90_m=ce90_m(on_earth),
        predicted_m=quality.predicted.median_m,
        predicted_worst_m=quality.predicted.worst_m,
        normalised=normalised_error(error, covariance).mean_square,
        displacement_m=max(moved_m, default=float("nan")),
        cpu_s=cpu_s,
        ground_predicted_m=quality.predicted.on_the_earth_median_m,
        ground_normalised=normalised_error(on_earth, both).mean_square,
        wrong_share=float(1.0 - right.mean()),
        judged_share=truth.judged_share,
        line_gap_px=float(np.median(np.diff(lines))),
    )
