"""What the ground sends up on a given day: crops that change, slopes that face the sun, shadows."""

import math
from datetime import date

import cv2
import numpy as np
import numpy.typing as npt
from numba import njit

from services.imagery import BLUR_PER_RATIO
from services.simulation.land import NO_ROOF
from services.simulation.world import World
from services.types import BoolArray, FloatImage

SKY_LIGHT = 0.30
"""Share of the light on level ground that comes from the whole sky and reaches shadows."""

CHANGING_SHARE = 0.35
"""Share of the fields that are at another stage of the year on another day."""

_STRIP_ROWS = 1024


def radiance_of_day(
    world: World, day: date, sun_elevation_deg: float, sun_azimuth_deg: float
) -> FloatImage:
    """Light sent up by every cell of a world, 1 for a white level ground in the sun.

    Fields differ from day to day: most a little, `CHANGING_SHARE` of them a lot. Slopes, flat roofs and
    the shadows of buildings follow the sun; the shadows of trees belong to the albedo and do not.

    Args:
        world: the ground.
        day: two images of the same day see the same fields.
        sun_elevation_deg, sun_azimuth_deg: where the sun stands.
    """
    rng = np.random.default_rng([world.seed, day.toordinal()])
    stage = rng.uniform(0.93, 1.07, 65536)
    changing = rng.uniform(size=65536) < CHANGING_SHARE
    stage[changing] = rng.uniform(0.55, 1.6, int(changing.sum()))
    stage[0] = 1.0
    out = np.empty_like(world.albedo)
    elevation, azimuth = math.radians(sun_elevation_deg), math.radians(sun_azimuth_deg)
    sun = np.array(
        [
            math.cos(elevation) * math.sin(azimuth),
            math.cos(elevation) * math.cos(azimuth),
            math.sin(elevation),
        ]
    )
    reach = int(roof_clearance_m(world) / math.tan(elevation) / world.posting_m) + 2
    shaded = near_buildings(world.roof_m, reach)
    _light(
        world.terrain_m,
        world.roof_m,
        world.albedo,
        world.parcel,
        stage.astype(np.float32),
        shaded,
        sun,
        world.posting_m,
        reach,
        out,
    )
    return out


def roof_clearance_m(world: World) -> float:
    """How far a roof stands above the terrain at most; zero without buildings."""
    strips = (slice(r, r + _STRIP_ROWS) for r in range(0, len(world.roof_m), _STRIP_ROWS))
    return max(0.0, *(float((world.roof_m[s] - world.terrain_m[s]).max()) for s in strips))


def near_buildings(roof_m: FloatImage, reach: int, block: int = 16) -> BoolArray:
    """Which squares of `block` cells have a building within `reach` cells; the grid repeats.

    Returns:
        (ceil(rows / block), ceil(columns / block)).
    """
    rows, columns = roof_m.shape
    height, width = -(-rows // block), -(-columns // block)
    built = np.zeros((height, width), dtype=np.uint8)
    for r in range(height):
        line = (roof_m[r * block : (r + 1) * block] > NO_ROOF).any(axis=0)
        built[r] = np.maximum.reduceat(line, np.arange(0, columns, block))
    steps = min(-(-reach // block) + 1, height, width)
    padded = np.pad(built, steps, mode="wrap")
    grown = cv2.dilate(padded, np.ones((2 * steps + 1, 2 * steps + 1), np.uint8))
    return np.asarray(grown[steps:-steps, steps:-steps] > 0)


def smooth_radiance(radiance: FloatImage, roof_m: FloatImage, ratio: float) -> FloatImage:
    """Light averaged over pixels `ratio` times larger than a cell, roofs and ground each by themselves.

    Roofs and ground are kept apart because a view from the side moves one against the other.
    """
    if ratio <= 1.0:
        return radiance
    sigma = BLUR_PER_RATIO * math.sqrt(ratio * ratio - 1.0)
    margin = math.ceil(4.0 * sigma)
    out = np.empty_like(radiance)
    rows, columns = radiance.shape
    for first in range(0, rows, _STRIP_ROWS):
        count = min(_STRIP_ROWS, rows - first)
        take = np.arange(first - margin, first + count + margin) % rows
        wrap = np.arange(-margin, columns + margin) % columns
        strip = radiance[take][:, wrap]
        roof = (roof_m[take][:, wrap] > NO_ROOF).astype(np.float32)
        smooth = np.empty_like(strip)
        for share in (roof, 1.0 - roof):
            weight = cv2.GaussianBlur(share, (0, 0), sigma)
            light = cv2.GaussianBlur(strip * share, (0, 0), sigma)
            inside = share > 0.0
            smooth[inside] = light[inside] / weight[inside]
        out[first : first + count] = smooth[margin : margin + count, margin : margin + columns]
    return out


@njit(cache=True)
def _light(
    terrain: FloatImage,
    roof: FloatImage,
    albedo: FloatImage,
    parcel: npt.NDArray[np.uint16],
    stage: FloatImage,
    shaded: BoolArray,
    sun: npt.NDArray[np.float64],
    posting: float,
    reach: int,
    out: FloatImage,
) -> None:
    rows, columns = terrain.shape
    horizontal = math.hypot(sun[0], sun[1])
    step_x, step_y = sun[0] / horizontal, -sun[1] / horizontal
    rise = sun[2] / horizontal * posting
    for r in range(rows):
        above = r - 1 if r > 0 else rows - 1
        below = r + 1 if r + 1 < rows else 0
        for c in range(columns):
            left = c - 1 if c > 0 else columns - 1
            right = c + 1 if c + 1 < columns else 0
            height = roof[r, c]
            facing = sun[2]
            if height == NO_ROOF:
                height = terrain[r, c]
                east = (terrain[r, right] - terrain[r, left]) / (2.0 * posting)
                north = (terrain[above, c] - terrain[below, c]) / (2.0 * posting)
                facing = (sun[2] - east * sun[0] - north * sun[1]) / math.sqrt(
                    1.0 + east * east + north * north
                )
            direct = max(facing, 0.0) / sun[2]
            if shaded[r // 16, c // 16]:
                for k in range(1, reach):
                    x = math.floor(c + k * step_x + 0.5) % columns
                    y = math.floor(r + k * step_y + 0.5) % rows
                    if roof[y, x] > height + k * rise:
                        direct = 0.0
                        break
            light = SKY_LIGHT + (1.0 - SKY_LIGHT) * direct
            out[r, c] = albedo[r, c] * stage[parcel[r, c]] * light
