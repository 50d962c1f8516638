"""Light reflected by the ground on a given day: changing crops, slopes towards the sun, shadows."""

import math
from datetime import date
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from amers.services.imagery.source import BLUR_PER_RATIO
from amers.services.simulation.land import NO_ROOF, WATER
from amers.services.simulation.world import World, natural_noise
from amers.services.types import BoolArray, FloatImage

SKY_LIGHT = 0.30
"""Share of the light on level ground that comes from the whole sky, also into shadows."""

CHANGING_SHARE = 0.35
"""Share of the fields that look different on another day."""

SEASONAL_GRAIN = 0.35
"""Standard deviation of the logarithm of the albedo change from one season to another."""

BLOCK = 16
"""Cells along the side of the squares in which buildings are searched."""
_STRIP_ROWS = 1024
_GRAIN_CELLS = 512


class Day(NamedTuple):
    """The state of a world on a day.

    Attributes:
        stage: (65536,) factor of the albedo of each field.
        grain: (t, t) factor of the albedo of all open land, repeated: growth since another season.
        sun: (3,) unit vector to the sun, east, north, up.
        reach: length of the shadow of the highest roof, cells.
        shaded: whether a shadow may reach each square of 16 x 16 cells.
    """

    stage: FloatImage
    grain: FloatImage
    sun: npt.NDArray[np.float64]
    reach: int
    shaded: BoolArray


def day_of(
    world: World, day: date, sun_elevation_deg: float, sun_azimuth_deg: float, season: float = 0.0
) -> Day:
    """The state of a world on a day.

    Fields differ from day to day: most of them slightly, `CHANGING_SHARE` of them strongly.

    Args:
        world: the ground.
        day: date; the fields are the same in all images of a date.
        sun_elevation_deg, sun_azimuth_deg: direction of the sun.
        season: 0 to 1, distance from another season: at 1 all fields differ strongly, and another
            texture covers the vegetation.
    """
    rng = np.random.default_rng([world.seed, day.toordinal()])
    stage = rng.uniform(0.93, 1.07, 65536)
    changing = rng.uniform(size=65536) < CHANGING_SHARE + season * (1.0 - CHANGING_SHARE)
    stage[changing] = rng.uniform(0.55, 1.6, int(changing.sum()))
    stage[0] = 1.0
    grain = np.ones((1, 1), dtype=np.float32)
    if season > 0.0:
        grain = np.exp(np.float32(SEASONAL_GRAIN * season) * natural_noise(rng, _GRAIN_CELLS, 1.0, 0.0))
    elevation, azimuth = math.radians(sun_elevation_deg), math.radians(sun_azimuth_deg)
    sun = np.array(
        [
            math.cos(elevation) * math.sin(azimuth),
            math.cos(elevation) * math.cos(azimuth),
            math.sin(elevation),
        ]
    )
    reach = int(world.roof_clearance_m / math.tan(elevation) / world.posting_m) + 2
    return Day(stage.astype(np.float32), grain, sun, reach, near_buildings(world.roof_m, reach))


def radiance_of_day(
    world: World, day: date, sun_elevation_deg: float, sun_azimuth_deg: float
) -> FloatImage:
    """Light reflected by each cell of a world; 1 for white level ground in the sun.

    Slopes, flat roofs and the shadows of buildings depend on the sun; the shadows of trees are part of
    the albedo and do not. See `day_of`.
    """
    shape = world.albedo.shape
    return radiance(world, day_of(world, day, sun_elevation_deg, sun_azimuth_deg), (0, 0), shape)


def radiance(world: World, day: Day, first: tuple[int, int], shape: tuple[int, ...]) -> FloatImage:
    """Light reflected on a day by the cells of a window, which may cross the border of the grid.

    Args:
        world: the ground.
        day: its state.
        first: row and column of the first cell.
        shape: rows and columns.
    """
    out = np.empty(shape, dtype=np.float32)
    ground = _Ground(world.terrain_m, world.roof_m, world.albedo, world.parcel)
    _reflect(ground, world.posting_m, day, first, out)
    return out


def near_buildings(roof_m: FloatImage, reach: int) -> BoolArray:
    """Whether each square of `BLOCK` x `BLOCK` cells has a building within `reach` cells.

    Returns:
        (ceil(rows / BLOCK), ceil(columns / BLOCK)).
    """
    rows, columns = roof_m.shape
    height, width = -(-rows // BLOCK), -(-columns // BLOCK)
    built = np.zeros((height, width), dtype=np.uint8)
    for r in range(height):
        line = (roof_m[r * BLOCK : (r + 1) * BLOCK] > NO_ROOF).any(axis=0)
        built[r] = np.maximum.reduceat(line, np.arange(0, columns, BLOCK))
    steps = min(-(-reach // BLOCK) + 1, height, width)
    padded = np.pad(built, steps, mode="wrap")
    grown = cv2.dilate(padded, np.ones((2 * steps + 1, 2 * steps + 1), np.uint8))
    return np.asarray(grown[steps:-steps, steps:-steps] > 0)


def smooth_radiance(radiance: FloatImage, roof_m: FloatImage, ratio: float) -> FloatImage:
    """Light averaged over pixels `ratio` times larger than a cell, separately for roofs and ground.

    The separation is necessary because roofs move relative to the ground in an oblique view.
    """
    if ratio <= 1.0:
        return radiance
    margin = smoothing_margin(ratio)
    out = np.empty_like(radiance)
    rows, columns = radiance.shape
    for first in range(0, rows, _STRIP_ROWS):
        count = min(_STRIP_ROWS, rows - first)
        take = np.arange(first - margin, first + count + margin) % rows
        wrap = np.arange(-margin, columns + margin) % columns
        smooth = averaged(radiance[take][:, wrap], roof_m[take][:, wrap] > NO_ROOF, ratio)
        out[first : first + count] = smooth[margin : margin + count, margin : margin + columns]
    return out


def smoothing_margin(ratio: float) -> int:
    """Number of cells on each side that contribute to light averaged over larger pixels."""
    if ratio <= 1.0:
        return 0
    return math.ceil(4.0 * BLUR_PER_RATIO * math.sqrt(ratio * ratio - 1.0)) + 1


def averaged(light: FloatImage, built: BoolArray, ratio: float) -> FloatImage:
    """Light averaged over pixels `ratio` times larger, separately for built cells and others."""
    if ratio <= 1.0:
        return light
    sigma = BLUR_PER_RATIO * math.sqrt(ratio * ratio - 1.0)
    out = np.empty_like(light)
    for inside in (built, ~built):
        share = inside.astype(np.float32)
        weight = cv2.GaussianBlur(share, (0, 0), sigma)
        smooth = cv2.GaussianBlur(light * share, (0, 0), sigma)
        out[inside] = smooth[inside] / weight[inside]
    return out


class _Ground(NamedTuple):
    """The arrays of a world for the kernel."""

    terrain: FloatImage
    roof: FloatImage
    albedo: FloatImage
    parcel: npt.NDArray[np.uint16]


@njit(cache=True)
def _reflect(ground: _Ground, posting: float, day: Day, first: tuple[int, int], out: FloatImage) -> None:
    """Fill `out` with the light that the cells from `first` reflect."""
    terrain, roof, albedo, parcel = ground
    stage, grain, sun, reach, shaded = day
    first_row, first_column = first
    rows, columns = terrain.shape
    tile = len(grain)
    horizontal = math.hypot(sun[0], sun[1])
    step_x, step_y = sun[0] / horizontal, -sun[1] / horizontal
    rise = sun[2] / horizontal * posting
    for i in range(out.shape[0]):
        r = (first_row + i) % rows
        above = r - 1 if r > 0 else rows - 1
        below = r + 1 if r + 1 < rows else 0
        for j in range(out.shape[1]):
            c = (first_column + j) % columns
            left = c - 1 if c > 0 else columns - 1
            right = c + 1 if c + 1 < columns else 0
            height = roof[r, c]
            facing = sun[2]
            grown = np.float32(1.0)
            if height == NO_ROOF:
                if parcel[r, c] != WATER:
                    grown = grain[r % tile, c % tile]
                height = terrain[r, c]
                east = (terrain[r, right] - terrain[r, left]) / (2.0 * posting)
                north = (terrain[above, c] - terrain[below, c]) / (2.0 * posting)
                facing = (sun[2] - east * sun[0] - north * sun[1]) / math.sqrt(
                    1.0 + east * east + north * north
                )
            direct = max(facing, 0.0) / sun[2]
            if shaded[r // BLOCK, c // BLOCK]:
                for k in range(1, reach):
                    x = math.floor(c + k * step_x + 0.5) % columns
                    y = math.floor(r + k * step_y + 0.5) % rows
                    if roof[y, x] > height + k * rise:
                        direct = 0.0
                        break
            light = SKY_LIGHT + (1.0 - SKY_LIGHT) * direct
            out[i, j] = albedo[r, c] * stage[parcel[r, c]] * light * grown
