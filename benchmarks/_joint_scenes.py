"""Scenes that are adjusted together, simulated without pixels: control points, tie points, truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from amers.services.adjustment.parameters import image_parameters
from amers.services.geodesy import lon_lat_h_from_east_north_up, move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.joint.measured import MeasuredScene, options_in_block
from amers.services.matching.control_points import PointMatches
from amers.services.registration.options import RegistrationOptions
from amers.services.registration.search import Search, adjust_search
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import ImageCorrection
from amers.services.simulation.view import ViewGeometry, ViewPlan, plan_geometry
from amers.services.simulation.world import World
from amers.services.types import (
    Array,
    BoolArray,
    ControlPoints,
    Frame,
    Observations,
    ViewMeasures,
    Views,
)


@dataclass(frozen=True)
class ImagePlan:
    """One image of a simulated block.

    Attributes:
        name: of the image.
        east_north_m: its centre from the origin.
        incidence_deg, azimuth_deg: direction from the ground to the satellite.
        shape, gsd_m: lines and samples, ground sampling.
        sigma_m: one standard deviation of the shift of the delivered model, as stated too.
        slope_px: largest drift and skew of the delivered model.
        wave_px: (line, sample) amplitude of a sensor that oscillates: one wave along the lines.
        bend_px: (line, sample) amplitude of what no correction follows: one wave along the diagonal.
        control_noise_px, tie_noise_px: of the measures, as stated too.
        found: share of the control points in the image that are found.
        wrong: share of these that are found in a wrong place, up to 15 px off.
        acquired_at: UTC.
    """

    name: str
    east_north_m: tuple[float, float]
    incidence_deg: float
    azimuth_deg: float
    shape: tuple[int, int]
    gsd_m: float
    sigma_m: float = 5.0
    slope_px: float = 1.0
    wave_px: tuple[float, float] = (0.0, 0.0)
    bend_px: tuple[float, float] = (0.0, 0.0)
    control_noise_px: float = 0.3
    tie_noise_px: float = 0.2
    found: float = 0.85
    wrong: float = 0.0
    acquired_at: datetime = datetime(2024, 6, 1, 10, tzinfo=UTC)


@dataclass(frozen=True)
class SceneTruth:
    """One image of a simulated block.

    Attributes:
        plan: of the image.
        geometry: its delivered model is `geometry.rpc`.
        error: from positions of the delivered model to where the image truly shows the ground.
    """

    plan: ImagePlan
    geometry: ViewGeometry
    error: ImageCorrection

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.plan.shape

    def position(self, lon_lat_h: Array) -> Array:
        """Where the image truly shows ground points (n, 3)."""
        return self.moved(self.error.apply(self.geometry.rpc.project(lon_lat_h)))

    def moved(self, position: Array) -> Array:
        """Positions (n, 2) of an image that oscillates and is bent as planned."""
        along_lines = np.sin(2.0 * np.pi * position[:, :1] / self.shape[0])
        diagonal = np.sin(2.0 * np.pi * position.sum(axis=1, keepdims=True) / sum(self.shape))
        wave_px, bend_px = np.array(self.plan.wave_px), np.array(self.plan.bend_px)
        return np.asarray(position + along_lines * wave_px + diagonal * bend_px)

    def shows(self, lon_lat_h: Array) -> BoolArray:
        """Which ground points lie inside."""
        position = self.position(lon_lat_h)
        return np.asarray(((position >= 0) & (position <= np.array(self.shape) - 1.0)).all(axis=1))

    def scene(self) -> Scene:
        """The image as delivered, without pixels."""
        blank = np.broadcast_to(np.float32(np.nan), self.shape)
        acquisition = replace(self.geometry.acquisition, image_id=self.plan.name)
        return Scene(ArrayImage(blank), self.geometry.rpc, acquisition, self.plan.sigma_m)


@dataclass(frozen=True)
class JointTruth:
    """A block of images and its control points.

    Attributes:
        images: of the block.
        points: as stated.
        true_lon_lat_h: (n, 3) where the points truly are.
        frame_error_m: (3,) east, north, up, that all points share.
    """

    images: tuple[SceneTruth, ...]
    points: ControlPoints
    true_lon_lat_h: Array
    frame_error_m: Array


def image_truth(plan: ImagePlan, world: World, origin: Array, rng: np.random.Generator) -> SceneTruth:
    """A planned image, with the error of its delivered model drawn."""
    place = lon_lat_h_from_east_north_up(np.array([[*plan.east_north_m, 0.0]]), origin)[0]
    view = ViewPlan(
        plan.name,
        (float(place[0]), float(place[1])),
        plan.shape,
        plan.gsd_m,
        plan.incidence_deg,
        plan.azimuth_deg,
        plan.acquired_at,
    )
    geometry = plan_geometry(world, view, np.random.default_rng(0))
    image = image_parameters(plan.name, geometry.rpc, plan.shape, shift_px=1.0, slope_px=1.0)
    slopes = rng.uniform(-plan.slope_px, plan.slope_px, (2, 2))
    parameters = np.column_stack([rng.normal(0.0, plan.sigma_m / plan.gsd_m, 2), slopes])
    return SceneTruth(plan, geometry, image.corrected(parameters.ravel()).correction)


def joint_truth(
    images: Sequence[SceneTruth],
    lon_lat_h: Array,
    rng: np.random.Generator,
    *,
    sigma_m: float = 0.5,
    sigma_up_m: float = 1.0,
    frame: Frame,
) -> JointTruth:
    """The block with control points at true places (n, 3), with their own errors and one in common."""
    n = len(lon_lat_h)
    sigmas = np.array([sigma_m, sigma_m, sigma_up_m])
    frame_error_m = rng.multivariate_normal(np.zeros(3), np.nan_to_num(frame.covariance_m2))
    error_m = rng.normal(0.0, 1.0, (n, 3)) * sigmas + frame_error_m
    none = np.zeros(0)
    views = Views(
        start=np.zeros(n + 1, dtype=np.int64),
        gsd_m=none,
        image=none.astype(np.int64),
        incidence_deg=none,
        azimuth_deg=none,
        health=none,
        images=(),
    )
    points = ControlPoints(
        id=np.arange(n, dtype=np.int64) + 1,
        lon_lat_h=move_metres(lon_lat_h, error_m),
        covariance_m2=np.tile(np.diag(sigmas**2), (n, 1, 1)),
        block=np.zeros(n, dtype=np.int64),
        frames=(frame,),
        saliency=np.ones(n),
        health=np.ones(n),
        views=views,
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=np.zeros(n, dtype=np.int64),
        chip_files=("chips",),
    )
    return JointTruth(tuple(images), points, lon_lat_h, frame_error_m)


def measured_scene(
    truth: JointTruth,
    number: int,
    rng: np.random.Generator,
    options: RegistrationOptions = RegistrationOptions(),
) -> MeasuredScene:
    """One image with its control points found, and adjusted alone where there are enough of them."""
    image = truth.images[number]
    scene = image.scene()
    visible = np.flatnonzero(image.shows(truth.true_lon_lat_h))
    points = truth.points.take(visible)
    n = len(visible)
    found = rng.random(n) < image.plan.found
    noise = rng.normal(0.0, image.plan.control_noise_px, (n, 2))
    position = image.position(truth.true_lon_lat_h[visible]) + noise
    off = rng.random(n) < image.plan.wrong
    position[off] += rng.uniform(-15.0, 15.0, (int(off.sum()), 2))
    line_sample = np.where(found[:, None], position, np.nan)
    matches = PointMatches(
        line_sample=line_sample,
        displacement_m=np.zeros((n, 2)),
        sigma_px=np.where(found, image.plan.control_noise_px, np.nan),
        score=np.where(found, 0.9, np.nan),
        views=found.astype(np.int64),
        reason=np.where(found, "", "low_score").astype("<U16"),
        by_gradient=np.zeros(n, dtype=np.bool_),
        common_covariance_m2=np.zeros((2, 2)),
        view_measures=ViewMeasures(
            np.arange(n), np.zeros(n, dtype=np.int64), np.ones(n), found, np.zeros(n, dtype="<U16")
        ),
    )
    search = Search(points, np.arange(n), matches, found, 0.0)
    enough = found.sum() >= options.adjustment.min_points
    alone = adjust_search(scene, search, options_in_block(options).adjustment) if enough else None
    return MeasuredScene(scene, points, search, alone)


def tie_points(
    images: Sequence[SceneTruth],
    lon_lat_h: Array,
    rng: np.random.Generator,
    *,
    seen: float = 0.7,
    wrong: float = 0.05,
) -> Observations:
    """Observations of true places (p, 3) that two images or more show; some are up to 30 px off."""
    rows = []
    for number, image in enumerate(images):
        shown = np.flatnonzero(image.shows(lon_lat_h) & (rng.random(len(lon_lat_h)) < seen))
        position = image.position(lon_lat_h[shown])
        position += rng.normal(0.0, image.plan.tie_noise_px, (len(shown), 2))
        off = rng.random(len(shown)) < wrong
        position[off] += rng.uniform(-30.0, 30.0, (int(off.sum()), 2))
        sigma = np.full(len(shown), image.plan.tie_noise_px)
        rows.append(np.column_stack([shown, np.full(len(shown), number), position, sigma]))
    table = np.concatenate(rows)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    point = table[:, 0].astype(np.int64)
    table = table[np.bincount(point)[point] >= 2]
    return Observations(
        np.unique(table[:, 0], return_inverse=True)[1].astype(np.int64),
        table[:, 1].astype(np.int64),
        table[:, 2:4],
        table[:, 4],
    )


def places(
    rng: np.random.Generator, origin: Array, extent_m: Array, count: int, relief_m: float
) -> Array:
    """True places (count, 3) over a rectangle (west, east, south, north) of relief."""
    west, east, south, north = extent_m
    ground = np.column_stack(
        [rng.uniform(west, east, count), rng.uniform(south, north, count), np.zeros(count)]
    )
    lon_lat_h = lon_lat_h_from_east_north_up(ground, origin)
    lon_lat_h[:, 2] = origin[2] + rng.uniform(-relief_m, relief_m, count)
    return lon_lat_h


def errors_px(truth: JointTruth, number: int, model: SensorModel, at: Array) -> tuple[Array, Array]:
    """Errors (k, 2) of a registered model at image positions (k, 2): in the frame of the points, true.

    The first are of ground moved as the control points are together, the second of true ground.
    """
    image = truth.images[number]
    height_m = np.full(len(at), float(np.median(truth.true_lon_lat_h[:, 2])))
    ground = model.locate(at, height_m)
    true_px = image.position(ground)
    moved = move_metres(ground, np.tile(truth.frame_error_m, (len(ground), 1)))
    return model.project(moved) - true_px, model.project(ground) - true_px
