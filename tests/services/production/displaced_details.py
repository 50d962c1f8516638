"""Ortho-images of details each of which is displaced by its own vector."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition, Array
from tests.services.textures import as_pixels, moved, texture

TILE_PX = 128
"""Side of the surroundings of a detail, more than that of a chip with its search."""
GSD_M = 2.0
CORNER_XY = np.array([499_400.0, 5_600_000.0])
"""On the central meridian: map north is north."""


@dataclass(frozen=True)
class Details:
    """Square surroundings of details, side by side in rows and columns.

    Attributes:
        tiles: (n, n, side, side) their grey values, periodic.
    """

    tiles: Array

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples of an image of them all."""
        return TILE_PX * self.tiles.shape[0], TILE_PX * self.tiles.shape[1]

    @property
    def model(self) -> OrthoModel:
        """Of an image that lies where it should."""
        step_xy = np.array([[0.0, GSD_M], [-GSD_M, 0.0]])
        return OrthoModel(MapGrid("EPSG:32633", CORNER_XY, step_xy, self.shape))

    @property
    def lon_lat_h(self) -> Array:
        """(m, 3) the middle of each, row by row."""
        middle = (np.arange(len(self.tiles)) + 0.5) * TILE_PX
        at = np.stack(np.meshgrid(middle, middle, indexing="ij"), axis=-1).reshape(-1, 2)
        return self.model.locate(at, np.full(len(at), 100.0))

    def image(self, east_north_m: Array, noise: float = 0.0) -> ArrayImage:
        """An image in which each lies off by its own vector (m, 2)."""
        rows_columns = east_north_m.reshape(*self.tiles.shape[:2], 2)[..., ::-1] / [-GSD_M, GSD_M]
        shown = np.block(
            [
                [moved(tile, *off) for tile, off in zip(*one, strict=True)]
                for one in zip(self.tiles, rows_columns, strict=True)
            ]
        )
        rng = np.random.default_rng(7)
        return ArrayImage(as_pixels(shown + noise * rng.standard_normal(shown.shape)))

    def scene(self, name: str, east_north_m: Array, sigma_m: float, noise: float = 0.0) -> Scene:
        """The same as a scene."""
        taken = Acquisition(name, incidence_deg=0.0, azimuth_deg=0.0)
        return Scene(self.image(east_north_m, noise), self.model, taken, sigma_m)


@cache
def drawn_details(side: int) -> Details:
    """So many rows and columns of them."""
    rng = np.random.default_rng(2)
    return Details(np.array([[texture(rng, TILE_PX, 1.5) for _ in range(side)] for _ in range(side)]))


def map_moved(model: OrthoModel, east_north_m: Array) -> OrthoModel:
    """A model whose map lies so far east and north that its details do."""
    grid = model.grid
    off = MapGrid(grid.crs, grid.origin_xy + east_north_m, grid.step_xy, grid.shape)
    return OrthoModel(off)


def east_north_m(before: Array, after: Array) -> Array:
    """How far east and north (n, 2) points have moved, metres."""
    step = 1.0
    here = before[:, :2]
    by_east = move_metres(before, np.tile([step, 0.0, 0.0], (len(before), 1)))[:, :2] - here
    by_north = move_metres(before, np.tile([0.0, step, 0.0], (len(before), 1)))[:, :2] - here
    axes = np.stack([by_east, by_north], axis=2)
    return np.asarray(np.linalg.solve(axes, (after[:, :2] - here)[:, :, None])[:, :, 0] * step)
