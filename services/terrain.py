"""Terrain as a grid of heights above the ellipsoid, read by windows."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from amers.services.errors import CoverageError
from amers.services.geodesy import metres_per_degree_at
from amers.services.imagery.source import ArrayImage, ImageSource, Window
from amers.services.map_grid import MapGrid
from amers.services.statements import Statements
from amers.services.types import Array, FloatImage, IntArray

Geoid = Callable[[Array], Array]
"""Height (n,) of a geoid above the ellipsoid at longitudes and latitudes (n, 2), metres."""

HEIGHT_SIGMA_POSTINGS = 0.1
"""Assumed standard deviation of heights between the nodes of a terrain, in distances of its nodes."""
_TILE = 2048
"""Side of the windows in which a grid is read, cells."""
_MAX_CELLS_IN_MEMORY = 64_000_000
"""Largest part of a terrain that is kept in memory: 256 MB."""


@dataclass(frozen=True)
class Terrain:
    """Heights of the ground on a map grid, read by windows; bilinear between the nodes.

    Attributes:
        grid: positions of the nodes.
        heights: metres above the geoid, or above the ellipsoid without one; NaN in voids.
        geoid: vertical datum of the heights; None for the ellipsoid.
        vertical: origin of the vertical datum, one sentence.
        sigmas: one standard deviation of the heights in metres, at the nodes, or one for all; None
            assumes 0.1 of the distance of the nodes.
        statements: of its files.
    """

    grid: MapGrid
    heights: ImageSource
    geoid: Geoid | None = None
    vertical: str = "metres above the ellipsoid"
    statements: Statements = ()
    sigmas: ImageSource | float | None = None

    @property
    def posting_m(self) -> float:
        """Distance of the nodes in metres: side of a square with the area of the central cell."""
        return self.grid.gsd_m

    def height_m(self, lon_lat: Array) -> Array:
        """Height (n,) at longitudes and latitudes (n, 2), metres above the ellipsoid.

        NaN outside the grid and next to voids. A cell extends half a step around its node; beyond the
        outermost nodes the height is constant.
        """
        position = self.grid.line_sample(np.asarray(lon_lat, dtype=np.float64)[:, :2])
        height_m = self._values_at(self.heights, position)
        valid = np.flatnonzero(np.isfinite(height_m))
        if self.geoid is not None and len(valid):
            height_m[valid] += self.geoid(lon_lat[valid, :2])
        return height_m

    def sigma_m(self, lon_lat: Array) -> Array:
        """One standard deviation (n,) of the heights at longitudes and latitudes (n, 2), metres.

        One for all places, or that of each, bilinear between the nodes; NaN then where `height_m` is.
        """
        if self.sigmas is None or isinstance(self.sigmas, float):
            one_m = HEIGHT_SIGMA_POSTINGS * self.posting_m if self.sigmas is None else self.sigmas
            return np.full(len(lon_lat), one_m)
        position = self.grid.line_sample(np.asarray(lon_lat, dtype=np.float64)[:, :2])
        return self._values_at(self.sigmas, position)

    def slope(self, lon_lat: Array) -> Array:
        """Slope (n, 2) of the ground, metres up per metre east and north; NaN where `height_m` is.

        Computed from differences over one posting, the resolution of the grid.
        """
        half_m = self.posting_m / 2.0
        metres = metres_per_degree_at(np.column_stack([lon_lat[:, :2], np.zeros(len(lon_lat))]))
        out = np.empty((len(lon_lat), 2))
        for axis in range(2):
            step = np.zeros((len(lon_lat), 2))
            step[:, axis] = half_m / metres[:, axis]
            rise_m = self.height_m(lon_lat[:, :2] + step) - self.height_m(lon_lat[:, :2] - step)
            out[:, axis] = rise_m / (2.0 * half_m)
        return out

    def around(self, lon_lat: Array) -> "Terrain":
        """The part of the terrain that contains some positions (n, 2), in memory unless it is too large.

        Raises:
            CoverageError: no position lies on the grid.
        """
        seamless = self.seamless(lon_lat)
        if seamless is not self:
            return seamless.around(lon_lat)
        position = self.grid.line_sample(lon_lat)
        position = position[np.isfinite(position).all(axis=1)]
        last = np.array(self.grid.shape) - 1
        if len(position):
            low = np.maximum(np.floor(position.min(axis=0)).astype(np.int64) - 1, 0)
            high = np.minimum(np.ceil(position.max(axis=0)).astype(np.int64) + 1, last)
        if not len(position) or (high < low).any():
            raise CoverageError(
                "the terrain does not cover the requested ground: none of it lies on the grid; "
                "give a terrain of this region"
            )
        lines, samples = (int(size) for size in high - low + 1)
        window = Window(int(low[0]), int(low[1]), lines, samples)
        origin_xy = self.grid.xy(low[None, :].astype(np.float64))[0]
        grid = replace(self.grid, origin_xy=origin_xy, shape=(lines, samples))
        return self._with(grid, lambda image: _part(image, window))

    def seamless(self, lon_lat: Array) -> "Terrain":
        """The same terrain; one around the Earth begins where its seam is not among positions (n, 2)."""
        along = self.grid.step_xy[0, 1]
        if not self.grid.is_geographic or along == 0.0 or self.grid.step_xy[1, 1] != 0.0:
            return self
        period = round(360.0 / abs(along))
        if self.grid.shape[1] < period:
            return self
        samples = self.grid.line_sample(lon_lat)[:, 1]
        on_circle = np.sort(samples[np.isfinite(samples)] % period)
        if not len(on_circle) or np.ptp(on_circle) <= period / 2.0:
            return self
        # The new seam is in the middle of the widest gap, on the other side of the Earth.
        gaps = np.diff(on_circle)
        widest = int(gaps.argmax())
        return self._rolled(int(on_circle[widest] + gaps[widest] / 2.0), period)

    def _rolled(self, first: int, period: int) -> "Terrain":
        """The same terrain around the Earth, which begins at another column."""
        origin_xy = self.grid.xy(np.array([[0.0, float(first)]]))[0]
        shape = (self.grid.shape[0], period)
        grid = replace(self.grid, origin_xy=origin_xy, shape=shape)
        return self._with(grid, lambda image: _RolledImage(image, first, shape))

    def _with(self, grid: MapGrid, changed: Callable[[ImageSource], ImageSource]) -> "Terrain":
        """The same terrain on another grid, with its heights and their sigmas at the nodes changed."""
        sigmas = self.sigmas
        if sigmas is not None and not isinstance(sigmas, float):
            sigmas = changed(sigmas)
        return replace(self, grid=grid, heights=changed(self.heights), sigmas=sigmas)

    def range_m(self) -> tuple[float, float]:
        """Lowest and highest ground, metres above the ellipsoid; bounds of them where there is a geoid.

        Raises:
            CoverageError: the grid has voids only.
        """
        low, high = math.inf, -math.inf
        for pixels in self._parts():
            lowest, highest = _finite_range(pixels)
            low, high = min(low, lowest), max(high, highest)
        if low > high:
            raise CoverageError(
                "the terrain has only voids here, heights expected; fill the voids or give another "
                "terrain"
            )
        if self.geoid is None:
            return low, high
        axes = [np.linspace(0.0, size - 1.0, 33) for size in self.grid.shape]
        samples = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        undulation = self.geoid(self.grid.lon_lat(samples))
        # Between these samples the geoid varies by less than an eighth of its range over all of them.
        lowest, highest = float(np.nanmin(undulation)), float(np.nanmax(undulation))
        margin = (highest - lowest) / 8.0 + 0.1
        return low + lowest - margin, high + highest + margin

    def nodes(self) -> FloatImage:
        """Heights (lines, samples) of all nodes, in the vertical datum; not to be changed."""
        if isinstance(self.heights, ArrayImage):
            return self.heights.pixels
        return self.heights.read(Window(0, 0, *self.grid.shape))

    def _parts(self) -> Iterator[FloatImage]:
        """Yield all heights, in one part when they are in memory."""
        if isinstance(self.heights, ArrayImage):
            yield self.nodes()
            return
        for window in _tiles((0, 0), self.grid.shape):
            yield self.heights.read(window)

    def _values_at(self, image: ImageSource, position: Array) -> Array:
        """Values (n,) of an image on the grid at positions (n, 2) in it; NaN outside."""
        if isinstance(image, ArrayImage):
            return bilinear_heights(image.pixels, position)
        values = np.full(len(position), np.nan)
        for window, rows in self._pieces(position):
            first = np.array([window.line, window.sample], dtype=np.float64)
            values[rows] = bilinear_heights(image.read(window), position[rows] - first)
        return values

    def _pieces(self, position: Array) -> Iterator[tuple[Window, IntArray]]:
        """Yield windows of the grid, each with the rows of the positions that it contains."""
        rows = np.flatnonzero(self.grid.contains(position))
        if not len(rows):
            return
        node = np.floor(position[rows]).astype(np.int64)
        tile = node // _TILE
        key = tile[:, 0] * (self.grid.shape[1] // _TILE + 2) + tile[:, 1]
        order = np.argsort(key, kind="stable")
        for part in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            low = np.maximum(node[part].min(axis=0), 0)
            high = np.minimum(node[part].max(axis=0) + 1, np.array(self.grid.shape) - 1)
            lines, samples = (int(size) for size in high - low + 1)
            yield Window(int(low[0]), int(low[1]), lines, samples), rows[part]


def _part(image: ImageSource, window: Window) -> ImageSource:
    """A window of an image inside it, in memory unless it is too large."""
    if isinstance(image, ArrayImage):
        lines = slice(window.line, window.line + window.lines)
        return ArrayImage(image.pixels[lines, window.sample : window.sample + window.samples])
    if window.lines * window.samples <= _MAX_CELLS_IN_MEMORY:
        return ArrayImage(image.read(window))
    return _CroppedImage(image, window)


@dataclass(frozen=True)
class _CroppedImage:
    """A window of an image, as an `ImageSource`."""

    whole: ImageSource
    window: Window

    @property
    def shape(self) -> tuple[int, int]:
        return self.window.lines, self.window.samples

    def read(self, window: Window) -> FloatImage:
        line, sample = window.line + self.window.line, window.sample + self.window.sample
        return self.whole.read(Window(line, sample, window.lines, window.samples))


@dataclass(frozen=True)
class _RolledImage:
    """An image around the Earth, as an `ImageSource` that begins at another column."""

    whole: ImageSource
    first: int
    shape: tuple[int, int]

    def read(self, window: Window) -> FloatImage:
        out = np.full((window.lines, window.samples), np.nan, dtype=np.float32)
        period = self.shape[1]
        at = max(window.sample, 0)
        end = min(window.sample + window.samples, period)
        while at < end:
            column = (at + self.first) % period
            samples = min(end - at, period - column)
            part = self.whole.read(Window(window.line, column, window.lines, samples))
            out[:, at - window.sample : at - window.sample + samples] = part
            at += samples
        return out


@njit(cache=True)
def _finite_range(heights: FloatImage) -> tuple[float, float]:
    """Lowest and highest finite height; infinity and minus infinity where there is none."""
    low, high = np.inf, -np.inf
    for i in range(heights.shape[0]):
        for j in range(heights.shape[1]):
            if np.isfinite(heights[i, j]):
                low, high = min(low, heights[i, j]), max(high, heights[i, j])
    return low, high


@njit(inline="always")
def bilinear_height(heights: FloatImage, line: float, sample: float) -> float:
    """Bilinear height of a grid at one position; see `bilinear_heights`."""
    lines, samples = heights.shape
    if not (-0.5 <= line <= lines - 0.5 and -0.5 <= sample <= samples - 0.5):
        return np.nan
    line = min(max(line, 0.0), lines - 1.0)
    sample = min(max(sample, 0.0), samples - 1.0)
    r0, c0 = int(line), int(sample)
    fr, fc = line - r0, sample - c0
    r1 = r0 + 1 if fr > 0.0 else r0
    c1 = c0 + 1 if fc > 0.0 else c0
    top = heights[r0, c0] + fc * (np.float64(heights[r0, c1]) - heights[r0, c0])
    bottom = heights[r1, c0] + fc * (np.float64(heights[r1, c1]) - heights[r1, c0])
    return top + fr * (bottom - top)


@njit(cache=True)
def bilinear_heights(heights: FloatImage, line_sample: Array) -> Array:
    """Bilinear heights (n,) of a grid at positions (n, 2).

    NaN more than half a step outside the grid, and where a node with a nonzero weight is NaN.
    """
    out = np.empty(len(line_sample))
    for i in range(len(line_sample)):
        out[i] = bilinear_height(heights, line_sample[i, 0], line_sample[i, 1])
    return out


def _tiles(first: tuple[int, int], shape: tuple[int, int]) -> Iterator[Window]:
    for line in range(first[0], shape[0], _TILE):
        for sample in range(first[1], shape[1], _TILE):
            yield Window(line, sample, min(_TILE, shape[0] - line), min(_TILE, shape[1] - sample))
