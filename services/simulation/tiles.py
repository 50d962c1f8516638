"""Images of a world, rendered in tiles on request, for scenes too large to render whole."""

import math
from collections import OrderedDict
from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from amers.services.imagery.source import Window
from amers.services.simulation.conditions import (
    CLEAR,
    Clouds,
    Conditions,
    clouds_over,
    inverted,
    seen_through,
    under_clouds,
)
from amers.services.simulation.detectors import PERFECT, Detectors
from amers.services.simulation.distortion import Distortion
from amers.services.simulation.land import NO_ROOF
from amers.services.simulation.light import Day, averaged, day_of, radiance, smoothing_margin
from amers.services.simulation.rays import RayNodes, intersect_surface
from amers.services.simulation.render import (
    NODE_SPACING,
    digitise,
    light_along_rays,
    ray_nodes,
    ray_setup,
)
from amers.services.simulation.view import ViewGeometry
from amers.services.simulation.world import World
from amers.services.types import Array, FloatImage

TILE_PX = NODE_SPACING
_CELLS = 128
_CACHED_TILES = 16_384

Pixels = npt.NDArray[np.uint16]
Tiles = OrderedDict[tuple[int, int], Pixels]
"""Pixels of tiles by row and column, the least recently read first."""


class LightOnDemand:
    """Light of a day averaged over pixels, computed for the requested cells only.

    Attributes:
        values: (rows, columns) light, NaN where it is not computed yet.
    """

    def __init__(self, world: World, day: Day, ratio: float) -> None:
        """Prepare the light of a day.

        Args:
            world: the ground.
            day: its state.
            ratio: size of the pixels in cells.
        """
        self.values: FloatImage = np.full(world.albedo.shape, np.nan, dtype=np.float32)
        self._world, self._day, self._ratio = world, day, ratio

    def compute(self, first: npt.NDArray[np.int64], last: npt.NDArray[np.int64]) -> None:
        """Compute the missing light from row and column (2,) `first` to `last`; the grid repeats."""
        rows, columns = self.values.shape
        for row in _starts(int(first[0]), int(last[0]), rows):
            for column in _starts(int(first[1]), int(last[1]), columns):
                if np.isnan(self.values[row, column]):
                    self._compute_tile(row, column)

    def _compute_tile(self, row: int, column: int) -> None:
        out = self.values[row : row + _CELLS, column : column + _CELLS]
        margin = smoothing_margin(self._ratio)
        height, width = out.shape[0] + 2 * margin, out.shape[1] + 2 * margin
        light = radiance(self._world, self._day, (row - margin, column - margin), (height, width))
        take = np.arange(row - margin, row - margin + height) % len(self.values)
        wrap = np.arange(column - margin, column - margin + width) % self.values.shape[1]
        built = self._world.roof_m[take[:, None], wrap] > NO_ROOF
        smooth = averaged(light, built, self._ratio)
        out[:] = smooth[margin : height - margin, margin : width - margin]


def _starts(first: int, last: int, size: int) -> Iterator[int]:
    """Yield the first cells of the tiles with cells `first` to `last` of an axis that repeats."""
    if last - first >= size:
        first, last = 0, size - 1
    at = first
    while at <= last:
        start = at % size // _CELLS * _CELLS
        yield start
        at += min(start + _CELLS, size) - at % size


class TiledView:
    """An image of a world as an `ImageSource` whose tiles are rendered when they are first read.

    The pixels do not depend on the windows read: each tile draws its noise from its own seed and is
    rendered separately.
    """

    def __init__(
        self,
        world: World,
        geometry: ViewGeometry,
        seed: int,
        conditions: Conditions = CLEAR,
        detectors: Detectors = PERFECT,
        *,
        distortion: Distortion | None = None,
        tiles: Tiles | None = None,
    ) -> None:
        """Prepare an image.

        Args:
            world: the ground.
            geometry: geometry of the image.
            seed: seed of clouds and noise.
            conditions: conditions of the acquisition.
            detectors: what the sensor model does not know of them.
            distortion: what the sensor model does not know of the image.
            tiles: of the same image, rendered before; those that are rendered are added.

        Raises:
            InputError: slopes are so steep that the terrain would occlude itself.
        """
        plan, acquisition = geometry.plan, geometry.acquisition
        sun = acquisition.sun_elevation_deg, acquisition.sun_azimuth_deg
        day = day_of(world, plan.acquired_at.date(), *sun, conditions.season)
        self._world = world
        self._geometry = geometry
        self._conditions = conditions
        self._detectors = detectors
        self._distortion = distortion or Distortion(geometry.plan.shape)
        self._as_modelled = detectors.are_perfect and self._distortion.is_none
        self._seed = seed
        self._setup = ray_setup(world, plan.incidence_deg, *sun)
        self._light = LightOnDemand(world, day, plan.gsd_m / world.posting_m)
        self._clouds: Clouds | None = clouds_over(
            plan.shape, conditions.cloud_cover, np.random.default_rng([seed, 0])
        )
        self._radiometry = seen_through(conditions, plan.radiometry)
        self._tiles: Tiles = OrderedDict() if tiles is None else tiles

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self._geometry.plan.shape

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window, float32; NaN outside the image."""
        out = np.full((window.lines, window.samples), np.nan, dtype=np.float32)
        start = np.array([window.line, window.sample])
        first = np.maximum(start, 0)
        last = np.minimum(start + out.shape, self.shape)
        if not (last > first).all():
            return out
        low, high = first // TILE_PX, (last - 1) // TILE_PX
        for row in range(low[0], high[0] + 1):
            for column, pixels in self._row_of_tiles(row, int(low[1]), int(high[1])):
                corner = np.array([row, column]) * TILE_PX
                a, b = np.maximum(first, corner), np.minimum(last, corner + pixels.shape)
                (r0, c0), (r1, c1) = a - start, b - start
                (i0, j0), (i1, j1) = a - corner, b - corner
                out[r0:r1, c0:c1] = pixels[i0:i1, j0:j1]
        return out

    def _row_of_tiles(self, row: int, first: int, last: int) -> Iterator[tuple[int, Pixels]]:
        """Yield columns and pixels of neighbouring tiles, rendering those that are missing."""
        missing = [c for c in range(first, last + 1) if (row, c) not in self._tiles]
        if missing and self._as_modelled:
            rays = self._rays(row, range(missing[0], missing[-1] + 2))
        for column in range(first, last + 1):
            pixels = self._tiles.pop((row, column), None)
            if pixels is None:
                if self._as_modelled:
                    at = column - missing[0]
                    of_tile = np.s_[:, :, at : at + 2]
                    tile_rays = rays._replace(low=rays.low[of_tile], high=rays.high[of_tile])
                    light = self._light_along(tile_rays, self._tile_shape(row, column))
                else:
                    light = self._light_as_seen(row, column)
                pixels = self._render(row, column, light)
            self._tiles[row, column] = pixels
            yield column, pixels
        while len(self._tiles) > _CACHED_TILES:
            self._tiles.popitem(last=False)

    def _rays(self, row: int, nodes: range) -> RayNodes:
        """Lines of sight of a row of tiles at some nodes."""
        lines = range(row * TILE_PX, min((row + 1) * TILE_PX, self.shape[0]))
        return ray_nodes(self._world, self._geometry.true_model, self._setup, lines, nodes)

    def _tile_shape(self, row: int, column: int) -> tuple[int, int]:
        lines, samples = self.shape
        return min(TILE_PX, lines - row * TILE_PX), min(TILE_PX, samples - column * TILE_PX)

    def _light_as_seen(self, row: int, column: int) -> FloatImage:
        """Light of a tile as it is seen: out of place, distorted, and blurred."""
        lines, samples = self._tile_shape(row, column)
        margin = math.ceil(3.0 * max(self._detectors.blur_px))
        first = np.array([row, column]) * TILE_PX - margin
        shape = lines + 2 * margin, samples + 2 * margin
        corner = first + self._detectors.step_of(column, self.shape[1])
        pixels = np.indices(shape).reshape(2, -1).T + corner
        jumps = self._distortion.jump(pixels)
        light = np.empty(shape, dtype=np.float32)
        for jump in self._distortion.jumps():
            here = (jumps == jump).all(axis=1).reshape(shape)
            if here.any():
                light[here] = self._light_after(jump + corner, shape)[here]
        if margin == 0:
            return light
        along_lines, along_samples = self._detectors.blur_px
        blurred = cv2.GaussianBlur(light, (0, 0), sigmaX=along_samples, sigmaY=along_lines)
        return np.ascontiguousarray(blurred[margin : margin + lines, margin : margin + samples])

    def _light_after(self, corner: Array, shape: tuple[int, int]) -> FloatImage:
        """Light of a part of the image after a jump to its corner, smoothly distorted."""
        rays = ray_nodes(
            self._world,
            self._geometry.true_model,
            self._setup,
            range(shape[0]),
            range(2 + (shape[1] - 1) // TILE_PX),
            seen=lambda line_sample: self._distortion.after_jump(line_sample + corner),
        )
        return self._light_along(rays, shape)

    def _render(self, row: int, column: int, light: FloatImage) -> Pixels:
        """Pixels of one tile."""
        lines, samples = light.shape
        line = np.arange(lines, dtype=np.float64) + row * TILE_PX
        sample = np.arange(samples, dtype=np.float64) + column * TILE_PX
        if self._conditions.inverted:
            light = inverted(light)
        if self._clouds is not None:
            light = under_clouds(light, self._clouds, line, sample)
        rng = np.random.default_rng([self._seed, 1, row, column])
        return digitise(light, self._radiometry, rng)

    def _light_along(self, rays: RayNodes, shape: tuple[int, int]) -> FloatImage:
        """Light of the pixels of a tile, after computing the light of the cells that they show."""
        ends = [rays.low[1, [0, -1]].reshape(-1, 2), rays.high[1, [0, -1]].reshape(-1, 2)]
        height, _ = intersect_surface(
            self._world.terrain_m, self._world.roof_m, ends[0], ends[1], (rays.low_m, rays.high_m)
        )
        share = (height - rays.low_m) / (rays.high_m - rays.low_m)
        column_row = ends[0] + share[:, None] * (ends[1] - ends[0])
        first = np.floor(column_row.min(axis=0)).astype(np.int64)[::-1]
        last = np.ceil(column_row.max(axis=0)).astype(np.int64)[::-1]
        margin = 8
        while True:
            self._light.compute(first - margin, last + margin)
            light = light_along_rays(self._world, self._light.values, self._setup, rays, shape)
            if np.isfinite(light).all() or margin > max(self._light.values.shape):
                return light
            margin *= 4
