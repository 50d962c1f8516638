"""Simulated images with known geometry, and models with errors as a provider delivers them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np
import numpy.typing as npt

from amers.services.errors import ComputationError
from amers.services.geodesy import sun_direction
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import (
    CorrectedModel,
    ImageCorrection,
    no_correction,
)
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.rpc import RpcModel
from amers.services.sensors.rpc_fit import fit_rpc
from amers.services.simulation.light import radiance_of_day, smooth_radiance
from amers.services.simulation.orbit import pushbroom_over
from amers.services.simulation.render import Radiometry, ray_setup, render, surface_seen
from amers.services.simulation.world import World
from amers.services.types import Acquisition, Array

PLAIN_RADIOMETRY = Radiometry()

RPC_ERROR_PX = 0.01
"""Largest difference of an RPC from the model to which it is fitted."""

_HEIGHT_MARGIN_M = 50.0


@dataclass(frozen=True)
class ViewPlan:
    """The specification of a simulated image.

    Attributes:
        image_id: name of the image.
        lon_lat: (2,) position of the image centre, degrees.
        shape: lines and samples.
        gsd_m: ground sampling distance at the centre.
        incidence_deg, azimuth_deg: direction from the ground to the satellite.
        acquired_at: UTC; determines the sun and the state of the fields.
        jitter_px: amplitude of the oscillation of the line of sight.
        radiometry: pixel values of light.
    """

    image_id: str
    lon_lat: tuple[float, float]
    shape: tuple[int, int] = (1000, 1000)
    gsd_m: float = 0.5
    incidence_deg: float = 0.0
    azimuth_deg: float = 0.0
    acquired_at: datetime = datetime(2024, 6, 12, 10, 40, tzinfo=UTC)
    jitter_px: float = 0.0
    radiometry: Radiometry = PLAIN_RADIOMETRY


@dataclass(frozen=True)
class ViewGeometry:
    """The geometry of a simulated image, without its pixels.

    Attributes:
        plan: the specification.
        true_model: the true sensor model.
        rpc: RPC fitted within `RPC_ERROR_PX` to the true model without its jitter, which no RPC shows.
        delivered: RPC with an error, as a provider would deliver it.
        error: from positions of `rpc` to positions of `delivered`.
        acquisition: time, viewing direction and sun.
    """

    plan: ViewPlan
    true_model: PushbroomModel
    rpc: RpcModel
    delivered: RpcModel
    error: ImageCorrection
    acquisition: Acquisition


@dataclass(frozen=True)
class SimulatedView:
    """A simulated image with its true and its delivered geometry.

    Attributes:
        pixels: (lines, samples) uint16, 12 bits; 0 is nodata and does not occur.
        geometry: true and delivered models.
    """

    pixels: npt.NDArray[np.uint16]
    geometry: ViewGeometry

    @property
    def image(self) -> ArrayImage:
        """The pixels as an `ImageSource`."""
        return ArrayImage(self.pixels.astype(np.float32))

    def as_scene(self, sigma_m: float) -> Scene:
        """The image with its delivered model, of the stated accuracy `sigma_m`."""
        return Scene(self.image, self.geometry.delivered, self.geometry.acquisition, sigma_m)


def plan_geometry(
    world: World,
    plan: ViewPlan,
    rng: np.random.Generator,
    ground_error_m: tuple[float, float] = (0.0, 0.0),
    error_px: Array | None = None,
) -> ViewGeometry:
    """The geometry of a planned image, with an error in its delivered model.

    Args:
        world: the ground.
        plan: the specification.
        rng: phases of the jitter.
        ground_error_m: error east and north at the image centre: the delivered model projects a point
            to the position that the true model has for the point this far from it.
        error_px: (2, 3) additional error as `ImageCorrection.parameters`: shift, drift, affine.

    Raises:
        ComputationError: no RPC fits the true model without its jitter, or the error.
    """
    lon_lat = np.array(plan.lon_lat)
    ground = np.append(lon_lat, world.height_m(lon_lat[None, :]))
    low, high = world.height_range_m
    heights_m = (low - _HEIGHT_MARGIN_M, high + _HEIGHT_MARGIN_M)
    direction_deg = plan.incidence_deg, plan.azimuth_deg
    steady = pushbroom_over(ground, plan.shape, plan.gsd_m, direction_deg, heights_m)
    true_model = steady
    if plan.jitter_px > 0.0:
        true_model = pushbroom_over(
            ground,
            plan.shape,
            plan.gsd_m,
            direction_deg,
            heights_m,
            jitter_px=plan.jitter_px,
            rng=rng,
        )
    rpc = _fitted(steady, plan.shape, heights_m)
    parameters = np.zeros((2, 3)) if error_px is None else np.array(error_px, dtype=np.float64)
    derivative = true_model.project_derivative(ground[None, :])[0]
    parameters[:, 0] += derivative[:, :2] @ np.array(ground_error_m)
    error = replace(no_correction(plan.shape), parameters=parameters)
    delivered = rpc
    if parameters.any():
        delivered = _fitted(CorrectedModel(rpc, error), plan.shape, heights_m)
    sun = sun_direction(lon_lat, plan.acquired_at)
    acquisition = Acquisition(
        plan.image_id,
        "simulated pushbroom",
        plan.acquired_at,
        plan.incidence_deg,
        plan.azimuth_deg,
        *sun,
    )
    return ViewGeometry(plan, true_model, rpc, delivered, error, acquisition)


def render_view(
    world: World, geometry: ViewGeometry, rng: np.random.Generator
) -> Iterator[tuple[int, npt.NDArray[np.uint16]]]:
    """Yield a simulated image strip by strip, for images that do not fit in memory.

    Yields:
        First line and pixels (lines, samples) of each strip.

    Raises:
        InputError: slopes are so steep that the terrain would occlude itself.
    """
    plan, acquisition = geometry.plan, geometry.acquisition
    sun = acquisition.sun_elevation_deg, acquisition.sun_azimuth_deg
    radiance = radiance_of_day(world, plan.acquired_at.date(), *sun)
    light = smooth_radiance(radiance, world.roof_m, plan.gsd_m / world.posting_m)
    setup = ray_setup(world, plan.incidence_deg, *sun)
    yield from render(
        world, geometry.true_model, plan.shape, light, setup, radiometry=plan.radiometry, rng=rng
    )


def simulate_view(
    world: World,
    plan: ViewPlan,
    rng: np.random.Generator,
    ground_error_m: tuple[float, float] = (0.0, 0.0),
    error_px: Array | None = None,
) -> SimulatedView:
    """The simulated image of a plan, with an error in its delivered model; see `plan_geometry`."""
    geometry = plan_geometry(world, plan, rng, ground_error_m, error_px)
    pixels = np.empty(plan.shape, dtype=np.uint16)
    for line, strip in render_view(world, geometry, rng):
        pixels[line : line + len(strip)] = strip
    return SimulatedView(pixels, geometry)


def simulate_block(
    world: World,
    rng: np.random.Generator,
    *,
    n_views: int = 3,
    shape: tuple[int, int] = (1000, 1000),
    gsd_m: float = 0.5,
    error_m: float = 3.0,
    largest_incidence_deg: float = 25.0,
) -> list[SimulatedView]:
    """Simulated images of the middle of a world, from all directions and on different days.

    Args:
        world: the ground.
        rng: source of directions, days, errors and noise.
        n_views: number of images.
        shape: lines and samples of each image.
        gsd_m: ground sampling distance.
        error_m: length of the error of each delivered model on the ground, in a random direction.
        largest_incidence_deg: largest incidence; the smallest is a quarter of it.
    """
    lon, lat = (float(v) for v in world.centre_lon_lat)
    turn = rng.uniform(0.0, 360.0)
    views = []
    for k in range(n_views):
        direction = rng.uniform(0.0, 2.0 * np.pi)
        plan = ViewPlan(
            image_id=f"view_{k + 1:02d}",
            lon_lat=(lon, lat),
            shape=shape,
            gsd_m=gsd_m,
            incidence_deg=float(largest_incidence_deg * rng.uniform(0.25, 1.0)),
            azimuth_deg=float((turn + 360.0 * (k + rng.uniform(-0.2, 0.2)) / n_views) % 360.0),
            acquired_at=datetime(2024, 4, 2, 10, 40, tzinfo=UTC)
            + timedelta(days=int(rng.integers(0, 180)), minutes=int(rng.integers(-20, 20))),
        )
        ground_error_m = (error_m * np.sin(direction), error_m * np.cos(direction))
        views.append(simulate_view(world, plan, rng, ground_error_m))
    return views


def true_ground(view: SimulatedView, world: World, line_sample: Array) -> Array:
    """Ground points (n, 3) truly visible at image positions (n, 2)."""
    return surface_seen(world, view.geometry.true_model, line_sample)


def true_line_sample(view: SimulatedView, lon_lat_h: Array) -> Array:
    """True image positions (n, 2) of ground points (n, 3), visible or not."""
    return view.geometry.true_model.project(lon_lat_h)


def _fitted(model: SensorModel, shape: tuple[int, int], height_range_m: tuple[float, float]) -> RpcModel:
    """The RPC that fits a model within `RPC_ERROR_PX`."""
    fit = fit_rpc(model, shape, height_range_m)
    if not fit.max_error_px < RPC_ERROR_PX:
        raise ComputationError(
            f"no RPC fits the simulated sensor: error up to {fit.max_error_px:.3g} px, less than "
            f"{RPC_ERROR_PX:g} px expected"
        )
    return fit.model
