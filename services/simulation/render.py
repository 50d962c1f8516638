"""Rendering of images of a simulated world, line by line."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from amers.services.errors import InputError
from amers.services.sensors.base import SensorModel
from amers.services.simulation.light import SKY_LIGHT, near_buildings
from amers.services.simulation.rays import (
    WALL_ALBEDO,
    LitSurface,
    RayNodes,
    intersect_surface,
    render_lines,
)
from amers.services.simulation.world import World
from amers.services.types import Array, BoolArray, FloatImage

DARKEST, BRIGHTEST = 1, 4095
"""Range of the pixels: 12 bits, with zero reserved for nodata."""

NODE_SPACING = 64
"""Samples between lines of sight computed by the sensor model; the others are interpolated."""

_HEIGHT_MARGIN_M = 2.0
STEEPEST = 0.9
"""Largest product of slope and tangent of the incidence; above 1, terrain would occlude itself."""

_LINES_AT_ONCE = 256


@dataclass(frozen=True)
class Radiometry:
    """The pixel value of light, `haze + gain light`, with noise that grows with the signal.

    Attributes:
        gain: additional value of white ground in the sun.
        haze: value of black ground.
        noise_floor: standard deviation in the dark.
        noise_per_signal: variance added by each unit of signal.
    """

    gain: float = 5200.0
    haze: float = 180.0
    noise_floor: float = 4.0
    noise_per_signal: float = 0.05


@dataclass(frozen=True)
class RaySetup:
    """The properties of a world that the lines of sight of one image need.

    Attributes:
        near: whether buildings may be met, for each square of 16 x 16 cells.
        clearance_m: greatest height above the terrain at which a building may be met: the highest roof,
            plus the rise of the terrain below a line of sight.
        low_m, high_m: heights of both ends of the lines of sight.
        walls: (4,) light of walls that face west, east, north, south.
    """

    near: BoolArray
    clearance_m: float
    low_m: float
    high_m: float
    walls: Array


def render(
    world: World,
    model: SensorModel,
    shape: tuple[int, int],
    light: FloatImage,
    setup: RaySetup,
    *,
    radiometry: Radiometry,
    rng: np.random.Generator,
) -> Iterator[tuple[int, npt.NDArray[np.uint16]]]:
    """Yield the image of a world strip by strip, from the first line to the last.

    Each pixel has the light of the first intersection of its line of sight. Only one strip is in memory.

    Args:
        world: the ground.
        model: true geometry of the image.
        shape: lines and samples.
        light: light of the cells of the world, averaged over pixels by `smooth_radiance`.
        setup: properties of the lines of sight.
        radiometry: pixel values of light.
        rng: source of the noise.

    Yields:
        First line and pixels (lines, samples) uint16 of each strip.
    """
    nodes = range(shape[1] // NODE_SPACING + 2)
    for first in range(0, shape[0], _LINES_AT_ONCE):
        lines = range(first, min(first + _LINES_AT_ONCE, shape[0]))
        rays = ray_nodes(world, model, setup, lines, nodes)
        strip = light_along_rays(world, light, setup, rays, (len(lines), shape[1]))
        yield first, digitise(strip, radiometry, rng)


def light_along_rays(
    world: World, light: FloatImage, setup: RaySetup, rays: RayNodes, shape: tuple[int, int]
) -> FloatImage:
    """Light (lines, samples) at the first intersections of lines of sight between given nodes."""
    out = np.empty(shape, dtype=np.float32)
    surface = LitSurface(world.terrain_m, world.roof_m, light, setup.near, setup.walls)
    render_lines(surface, rays, NODE_SPACING, setup.clearance_m, out)
    return out


def surface_seen(world: World, model: SensorModel, line_sample: Array) -> Array:
    """Ground points (n, 3) visible at image positions (n, 2): the first on their lines of sight."""
    low_m, high_m = world.height_range_m
    low_m, high_m = low_m - _HEIGHT_MARGIN_M, high_m + _HEIGHT_MARGIN_M
    low, high = (
        world.column_row(model.locate(line_sample, np.full(len(line_sample), h))[:, :2])
        for h in (low_m, high_m)
    )
    height, _ = intersect_surface(world.terrain_m, world.roof_m, low, high, (low_m, high_m))
    return model.locate(line_sample, height)


def ray_setup(
    world: World, incidence_deg: float, sun_elevation_deg: float, sun_azimuth_deg: float
) -> RaySetup:
    """The setup of the lines of sight of an image with a given incidence and sun.

    Raises:
        InputError: slopes are so steep that the terrain would occlude itself.
    """
    tangent = math.tan(math.radians(incidence_deg + 2.0))
    steepness = tangent * world.steepest_slope
    if steepness > STEEPEST:
        raise InputError(
            f"incidence of {incidence_deg:g} degrees with slopes up to {world.steepest_slope:.2f} m/m: "
            "the terrain would occlude itself, which is not simulated; reduce incidence or relief"
        )
    clearance_m = world.roof_clearance_m / (1.0 - steepness) + 0.1
    low, high = world.height_range_m
    return RaySetup(
        near=near_buildings(world.roof_m, math.ceil(clearance_m * tangent / world.posting_m) + 2),
        clearance_m=clearance_m,
        low_m=low - _HEIGHT_MARGIN_M,
        high_m=high + _HEIGHT_MARGIN_M,
        walls=_wall_light(sun_elevation_deg, sun_azimuth_deg),
    )


def ray_nodes(
    world: World,
    model: SensorModel,
    setup: RaySetup,
    lines: range,
    nodes: range,
    *,
    seen: Callable[[Array], Array] = lambda line_sample: line_sample,
) -> RayNodes:
    """Lines of sight of some lines, and of a quarter line before and after them, at some nodes.

    Args:
        world: the grid.
        model: true geometry of the image.
        setup: both heights.
        lines: consecutive lines.
        nodes: consecutive nodes, one for every `NODE_SPACING`-th sample from sample -0.5 on.
        seen: positions (n, 2) of the model that pixels (n, 2) show, smooth.
    """
    line = lines.start + np.arange(-1.0, len(lines) + 1.0)
    sample = -0.5 + NODE_SPACING * np.arange(nodes.start, nodes.stop)
    image = seen(np.stack(np.meshgrid(line, sample, indexing="ij"), axis=-1).reshape(-1, 2))

    def at(height_m: float) -> Array:
        ground = model.locate(image, np.full(len(image), height_m))
        grid = world.column_row(ground[:, :2]).reshape(len(line), len(sample), 2)
        before, here, after = grid[:-2], grid[1:-1], grid[2:]
        return np.stack([here + 0.25 * (before - here), here, here + 0.25 * (after - here)])

    return RayNodes(at(setup.low_m), at(setup.high_m), setup.low_m, setup.high_m)


def _wall_light(sun_elevation_deg: float, sun_azimuth_deg: float) -> Array:
    """Light (4,) of walls that face west, east, north and south."""
    azimuth = math.radians(sun_azimuth_deg)
    east, north = math.sin(azimuth), math.cos(azimuth)
    facing = np.maximum([-east, east, north, -north], 0.0)
    direct = np.minimum(facing / math.tan(math.radians(sun_elevation_deg)), 1.5)
    return np.asarray(WALL_ALBEDO * (SKY_LIGHT + (1.0 - SKY_LIGHT) * direct))


def digitise(
    light: FloatImage, radiometry: Radiometry, rng: np.random.Generator
) -> npt.NDArray[np.uint16]:
    """Pixel values of light, with noise."""
    signal = radiometry.haze + radiometry.gain * np.maximum(light, 0.0)
    spread = np.sqrt(radiometry.noise_floor**2 + radiometry.noise_per_signal * signal)
    signal += spread * rng.standard_normal(light.shape, dtype=np.float32)
    return np.clip(np.rint(signal), DARKEST, BRIGHTEST).astype(np.uint16)
