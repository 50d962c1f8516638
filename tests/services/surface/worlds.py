"""A small simulated town on a slope with views of it, and its surface beside the truth."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.map_grid import MapGrid, utm_of, xy_of_lon_lat
from amers.services.simulation.land import NO_ROOF
from amers.services.simulation.view import ViewPlan, simulate_view
from amers.services.simulation.world import World, make_world
from amers.services.surface.options import SurfaceOptions
from amers.services.surface.surface import Surface, make_surface, surface_tiles
from amers.services.tasks import Work
from amers.services.types import Array, BoolArray, FloatImage

GSD_M = 0.5
SHAPE = (300, 300)
_GROUND_M = 150.0
_SLOPE = 0.1
_ROOFS_M = (6.0, 15.0)
_LOOKS = {"left": (14.0, 270.0), "right": (14.0, 90.0), "down": (1.0, 0.0)}


@cache
def town() -> World:
    """Ground that rises to the south by a tenth, with two flat roofs."""
    world = make_world(np.random.default_rng(5), size_m=300.0, posting_m=0.5, relief_m=1.0)
    rows = np.indices(world.terrain_m.shape)[0]
    terrain = (_GROUND_M + _SLOPE * world.posting_m * np.abs(rows - len(rows) / 2)).astype(np.float32)
    roof = np.full_like(terrain, NO_ROOF)
    middle = len(rows) // 2
    for number, height_m in enumerate(_ROOFS_M):
        left = middle - 70 + 80 * number
        roof[middle - 30 : middle + 30, left : left + 60] = _GROUND_M + height_m
    return replace(world, terrain_m=terrain, roof_m=roof)


@cache
def scene(look: str) -> Scene:
    """One view of the town with its true model."""
    world = town()
    lon, lat = world.centre_lon_lat
    incidence, azimuth = _LOOKS[look]
    plan = ViewPlan(look, (lon, lat), SHAPE, GSD_M, incidence, azimuth)
    return simulate_view(world, plan, np.random.default_rng(len(look))).as_scene(1.0)


def grid() -> MapGrid:
    """A grid over the middle of the town."""
    lon_lat = town().centre_lon_lat[None, :]
    crs = utm_of(*lon_lat[0])
    origin = xy_of_lon_lat(crs, lon_lat)[0] + np.array([-55.0, 55.0])
    return MapGrid(crs, origin, np.array([[0.0, GSD_M], [-GSD_M, 0.0]]), (220, 220))


@dataclass(frozen=True)
class Compared:
    """A surface beside the truth.

    Attributes:
        surface: with its pairs.
        height_m, sigma_m, views, reason: of all cells.
        error_m: of the heights.
        near_wall: cells within two of a step of the truth, whose height may be of either side.
    """

    surface: Surface
    height_m: FloatImage
    sigma_m: FloatImage
    views: Array
    reason: Array
    error_m: Array
    near_wall: BoolArray


def compared(looks: tuple[str, ...], options: SurfaceOptions, work: Work | None = None) -> Compared:
    """The surface of some views beside the truth."""
    return compared_scenes([scene(look) for look in looks], options, work)


def compared_scenes(scenes: list[Scene], options: SurfaceOptions, work: Work | None = None) -> Compared:
    """The surface of some scenes beside the truth."""
    surface = make_surface(scenes, options, grid=grid(), work=work)
    lines, samples = surface.grid.shape
    out = {name: np.zeros((lines, samples)) for name in ("height_m", "sigma_m", "views", "reason")}
    for tile in surface_tiles(surface):
        w = tile.window
        for name, values in out.items():
            values[w.line : w.line + w.lines, w.sample : w.sample + w.samples] = getattr(tile, name)
    truth = true_heights(surface.grid)
    steps = np.zeros((lines, samples), dtype=np.bool_)
    for down in range(-2, 3):
        for right in range(-2, 3):
            steps |= np.abs(np.roll(truth, (down, right), axis=(0, 1)) - truth) > 1.0
    return Compared(surface, **out, error_m=out["height_m"] - truth, near_wall=steps)


def true_heights(grid: MapGrid) -> Array:
    """The heights of the town in the cells of a grid."""
    lines, samples = np.indices(grid.shape)
    at = np.column_stack([lines.ravel(), samples.ravel()]).astype(np.float64)
    return town().surface_m(grid.lon_lat(at)).reshape(grid.shape)
