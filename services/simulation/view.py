"""Simulated images whose geometry is known, and the spoiled models that would be delivered with them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np
import numpy.typing as npt

from services.errors import ComputationError
from services.imagery.scene import Scene
from services.imagery.source import ArrayImage
from services.sensors.base import SensorModel
from services.sensors.correction import (
    CorrectedModel,
    ImageCorrection,
    no_correction,
)
from services.sensors.pushbroom import PushbroomModel
from services.sensors.rpc import RpcModel
from services.sensors.rpc_fit import fit_rpc
from services.simulation.light import radiance_of_day
from services.simulation.orbit import pushbroom_over, sun_direction
from services.simulation.render import Radiometry, render, surface_seen
from services.simulation.world import World
from services.types import Acquisition, Array

PLAIN_RADIOMETRY = Radiometry()

RPC_ERROR_PX = 0.01
"""What an RPC may lose of the model it was fitted to."""

_HEIGHT_MARGIN_M = 50.0


@dataclass(frozen=True)
class ViewPlan:
    """What is asked of a simulated satellite.

    Attributes:
        image_id: name of the image.
        lon_lat: (2,) place at the centre of the image, degrees.
        shape: lines and samples.
        gsd_m: ground sampling at the centre.
        incidence_deg, azimuth_deg: direction from the ground to the satellite.
        acquired_at: UTC; settles the sun and the state of the fields.
        orbit_height_m: above the equator.
        jitter_px: oscillation of the line of sight.
        radiometry: from light to numbers.
    """

    image_id: str
    lon_lat: tuple[float, float]
    shape: tuple[int, int] = (1000, 1000)
    gsd_m: float = 0.5
    incidence_deg: float = 0.0
    azimuth_deg: float = 0.0
    acquired_at: datetime = datetime(2024, 6, 12, 10, 40, tzinfo=UTC)
    orbit_height_m: float = 700e3
    jitter_px: float = 0.0
    radiometry: Radiometry = PLAIN_RADIOMETRY


@dataclass(frozen=True)
class ViewGeometry:
    """How an image is taken, before it has pixels.

    Attributes:
        plan: what was asked.
        true_model: the sensor as it really flew.
        rpc: fitted to the true model, within `RPC_ERROR_PX`.
        delivered: the RPC with the error on top, as a provider would deliver it.
        error: from positions of `rpc` to positions of `delivered`.
        acquisition: how it was taken.
    """

    plan: ViewPlan
    true_model: PushbroomModel
    rpc: RpcModel
    delivered: RpcModel
    error: ImageCorrection
    acquisition: Acquisition


@dataclass(frozen=True)
class SimulatedView:
    """An image of a world and everything that is true about it.

    Attributes:
        pixels: (lines, samples) uint16, 12 bits; 0 is nodata and does not occur.
        geometry: true and delivered.
    """

    pixels: npt.NDArray[np.uint16]
    geometry: ViewGeometry

    @property
    def image(self) -> ArrayImage:
        """The pixels as an image."""
        return ArrayImage(self.pixels.astype(np.float32))

    def as_scene(self, sigma_m: float) -> Scene:
        """The image with the model that would be delivered, said to be good to `sigma_m`."""
        return Scene(self.image, self.geometry.delivered, self.geometry.acquisition, sigma_m)


def plan_geometry(
    world: World,
    plan: ViewPlan,
    rng: np.random.Generator,
    ground_error_m: tuple[float, float] = (0.0, 0.0),
    error_px: Array | None = None,
) -> ViewGeometry:
    """Fly a view and spoil its model.

    Args:
        world: the ground.
        plan: what is asked.
        rng: phases of the jitter.
        ground_error_m: east and north; a place is found in the image by the delivered model where the
            true model has what lies that far from it, at the centre of the image.
        error_px: (2, 3) more error, `ImageCorrection.parameters`: shift, drift, affine.

    Raises:
        ComputationError: when an RPC cannot follow the true model or the error.
    """
    lon_lat = np.array(plan.lon_lat)
    ground = np.append(lon_lat, world.height_m(lon_lat[None, :]))
    low, high = world.height_range_m
    heights_m = (low - _HEIGHT_MARGIN_M, high + _HEIGHT_MARGIN_M)
    true_model = pushbroom_over(
        ground,
        plan.shape,
        plan.gsd_m,
        plan.incidence_deg,
        plan.azimuth_deg,
        heights_m,
        plan.orbit_height_m,
        plan.jitter_px,
        rng,
    )
    rpc = _fitted(true_model, plan.shape, heights_m)
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
    """The image of a view, strip by strip, for images that do not fit in memory.

    Yields:
        First line and pixels (lines, samples) of each strip.
    """
    plan, acquisition = geometry.plan, geometry.acquisition
    sun = acquisition.sun_elevation_deg, acquisition.sun_azimuth_deg
    radiance = radiance_of_day(world, plan.acquired_at.date(), *sun)
    yield from render(
        world,
        geometry.true_model,
        plan.shape,
        radiance,
        plan.gsd_m,
        plan.incidence_deg,
        *sun,
        plan.radiometry,
        rng,
    )


def simulate_view(
    world: World,
    plan: ViewPlan,
    rng: np.random.Generator,
    ground_error_m: tuple[float, float] = (0.0, 0.0),
    error_px: Array | None = None,
) -> SimulatedView:
    """Fly a view, spoil its model and take the image; see `plan_geometry`."""
    geometry = plan_geometry(world, plan, rng, ground_error_m, error_px)
    pixels = np.empty(plan.shape, dtype=np.uint16)
    for line, strip in render_view(world, geometry, rng):
        pixels[line : line + len(strip)] = strip
    return SimulatedView(pixels, geometry)


def simulate_block(
    world: World,
    rng: np.random.Generator,
    n_views: int = 3,
    shape: tuple[int, int] = (1000, 1000),
    gsd_m: float = 0.5,
    error_m: float = 3.0,
    largest_incidence_deg: float = 25.0,
) -> list[SimulatedView]:
    """Several views of the middle of a world, from all sides and on different days.

    Args:
        world: the ground.
        rng: directions, days, errors and noise.
        n_views: how many.
        shape: lines and samples of each.
        gsd_m: ground sampling.
        error_m: length of the error of each delivered model on the ground, in a random direction.
        largest_incidence_deg: the views lie between a quarter of it and all of it.
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
    """Ground points (n, 3) that image positions (n, 2) really show."""
    return surface_seen(world, view.geometry.true_model, line_sample)


def true_line_sample(view: SimulatedView, lon_lat_h: Array) -> Array:
    """Image positions (n, 2) where ground points (n, 3) really are, hidden or not."""
    return view.geometry.true_model.project(lon_lat_h)


def _fitted(model: SensorModel, shape: tuple[int, int], height_range_m: tuple[float, float]) -> RpcModel:
    """An RPC that follows a model within `RPC_ERROR_PX`."""
    fit = fit_rpc(model, shape, height_range_m)
    if not fit.max_error_px < RPC_ERROR_PX:
        raise ComputationError(
            f"no RPC follows the simulated sensor: error up to {fit.max_error_px:.3g} px, "
            f"{RPC_ERROR_PX:g} px allowed"
        )
    return fit.model
