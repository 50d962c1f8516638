"""Images of a simulated world, line by line as a scanner takes them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from services.errors import InputError
from services.sensors.base import SensorModel
from services.simulation.light import SKY_LIGHT, near_buildings, smooth_radiance
from services.simulation.rays import WALL_ALBEDO, meet_surface, render_lines
from services.simulation.world import World
from services.types import Array, BoolArray, FloatImage

DARKEST, BRIGHTEST = 1, 4095
"""Range of the pixels: 12 bits, zero kept for nodata."""

NODE_SPACING = 64
"""Samples between the lines of sight that go through the model; those between are interpolated."""

_HEIGHT_MARGIN_M = 2.0
STEEPEST = 0.9
"""Largest product of slope and tangent of the incidence: beyond one, terrain hides itself."""

_LINES_AT_ONCE = 256


@dataclass(frozen=True)
class Radiometry:
    """From light to numbers: `haze + gain light`, and noise that grows with the signal.

    Attributes:
        gain: of a white ground in the sun.
        haze: of a black one.
        noise_floor: standard deviation where it is dark.
        noise_per_signal: variance added by each unit of signal.
    """

    gain: float = 5200.0
    haze: float = 180.0
    noise_floor: float = 4.0
    noise_per_signal: float = 0.05


@dataclass(frozen=True)
class Sight:
    """What the kernels need to know about a world as one image sees it.

    Attributes:
        near: squares of 16 cells where buildings may be met.
        clearance_m: highest roof above the terrain, and what the terrain may rise below a line.
        low_m, high_m: heights between which lines of sight run.
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
    radiance: FloatImage,
    gsd_m: float,
    incidence_deg: float,
    sun_elevation_deg: float,
    sun_azimuth_deg: float,
    radiometry: Radiometry,
    rng: np.random.Generator,
) -> Iterator[tuple[int, npt.NDArray[np.uint16]]]:
    """The image a sensor takes of a world, from the first line to the last.

    Each pixel follows its line of sight to what it meets first; memory holds a few hundred lines.

    Args:
        world: the ground.
        model: true geometry of the image.
        shape: lines and samples.
        radiance: light of the day, `radiance_of_day`.
        gsd_m: ground sampling, to which the light is averaged.
        incidence_deg: of the image's centre.
        sun_elevation_deg, sun_azimuth_deg: for walls.
        radiometry: from light to numbers.
        rng: of the noise.

    Yields:
        First line and pixels (lines, samples) uint16 of one strip after the other.

    Raises:
        InputError: when slopes are so steep that the terrain would hide itself.
    """
    light = smooth_radiance(radiance, world.roof_m, gsd_m / world.posting_m)
    sight = sight_of(world, incidence_deg, sun_elevation_deg, sun_azimuth_deg)
    for first in range(0, shape[0], _LINES_AT_ONCE):
        count = min(_LINES_AT_ONCE, shape[0] - first)
        low, high = nodes(world, model, sight, first, count, 0, shape[1] // NODE_SPACING + 2)
        strip = light_met(world, light, sight, low, high, (count, shape[1]))
        yield first, digitise(strip, radiometry, rng)


def light_met(
    world: World, light: FloatImage, sight: Sight, low: Array, high: Array, shape: tuple[int, int]
) -> FloatImage:
    """Light (lines, samples) met by lines of sight, interpolated between `nodes`."""
    out = np.empty(shape, dtype=np.float32)
    render_lines(
        world.terrain_m,
        world.roof_m,
        light,
        sight.near,
        low,
        high,
        sight.low_m,
        sight.high_m,
        NODE_SPACING,
        sight.clearance_m,
        sight.walls,
        out,
    )
    return out


def surface_seen(world: World, model: SensorModel, line_sample: Array) -> Array:
    """Ground points (n, 3) that image positions (n, 2) show: what their lines of sight meet first."""
    low_m, high_m = world.height_range_m
    low_m, high_m = low_m - _HEIGHT_MARGIN_M, high_m + _HEIGHT_MARGIN_M
    low, high = (
        world.column_row(model.locate(line_sample, np.full(len(line_sample), h))[:, :2])
        for h in (low_m, high_m)
    )
    height, _ = meet_surface(world.terrain_m, world.roof_m, low, high, low_m, high_m)
    return model.locate(line_sample, height)


def sight_of(
    world: World, incidence_deg: float, sun_elevation_deg: float, sun_azimuth_deg: float
) -> Sight:
    """How far buildings may hide the ground, between which heights rays run, how walls are lit.

    Raises:
        InputError: when slopes are so steep that the terrain would hide itself.
    """
    tangent = math.tan(math.radians(incidence_deg + 2.0))
    steepness = tangent * world.steepest_slope
    if steepness > STEEPEST:
        raise InputError(
            f"a view under {incidence_deg:g} degrees of slopes up to {world.steepest_slope:.2f} m/m "
            "would need terrain that hides itself, which is not simulated"
        )
    clearance_m = world.roof_clearance_m / (1.0 - steepness) + 0.1
    low, high = world.height_range_m
    return Sight(
        near=near_buildings(world.roof_m, math.ceil(clearance_m * tangent / world.posting_m) + 2),
        clearance_m=clearance_m,
        low_m=low - _HEIGHT_MARGIN_M,
        high_m=high + _HEIGHT_MARGIN_M,
        walls=_wall_light(sun_elevation_deg, sun_azimuth_deg),
    )


def nodes(
    world: World, model: SensorModel, sight: Sight, first: int, count: int, node: int, n_nodes: int
) -> tuple[Array, Array]:
    """Grid positions of some lines, and of a quarter pixel around, at both heights of a sight.

    Args:
        world: its grid.
        model: true geometry of the image.
        sight: its heights.
        first, count: lines.
        node, n_nodes: every `NODE_SPACING`-th sample, counted from sample -0.5.

    Returns:
        Low and high, (3, count, n_nodes, 2) columns and rows each.
    """
    line = first + np.arange(-1.0, count + 1.0)
    sample = -0.5 + NODE_SPACING * np.arange(node, node + n_nodes)
    image = np.stack(np.meshgrid(line, sample, indexing="ij"), axis=-1).reshape(-1, 2)

    def at(height_m: float) -> Array:
        ground = model.locate(image, np.full(len(image), height_m))
        grid = world.column_row(ground[:, :2]).reshape(len(line), len(sample), 2)
        before, here, after = grid[:-2], grid[1:-1], grid[2:]
        return np.stack([here + 0.25 * (before - here), here, here + 0.25 * (after - here)])

    return at(sight.low_m), at(sight.high_m)


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
    """Pixels of light, with noise."""
    signal = radiometry.haze + radiometry.gain * np.maximum(light, 0.0)
    spread = np.sqrt(radiometry.noise_floor**2 + radiometry.noise_per_signal * signal)
    signal += spread * rng.standard_normal(light.shape, dtype=np.float32)
    return np.clip(np.rint(signal), DARKEST, BRIGHTEST).astype(np.uint16)
