"""A simulated piece of ground, exactly known: heights, buildings and land cover."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt
from scipy import fft

from amers.services.geodesy import metres_per_degree, wrapped_degrees
from amers.services.simulation.grid import bilinear_values
from amers.services.simulation.land import NO_ROOF, WATER, LandNoise, cover_land
from amers.services.types import Array, FloatImage

Parcels = npt.NDArray[np.uint16]

_TEXTURE_TILE = 2048
_TERRAIN_NODES = 512
_WARP_NODES = 256
_REGION_NODES = 128
_STRIP_ROWS = 1024
_WATER_ALBEDO = 0.05
_LOWEST_M = 150.0
"""Height of the lowest ground above the ellipsoid."""


@dataclass(frozen=True)
class World:
    """Ground on a grid of longitudes and latitudes, which repeats in both directions.

    Row 0 is the northernmost. The terrain is bilinear between the nodes of the grid, by definition. A
    cell extends half a step around its node and is either open ground or part of a building with
    vertical walls and a flat roof.

    Attributes:
        seed: seed, together with the date, of everything that changes with the date.
        origin_lon_lat: (2,) first node, in the north-west, degrees.
        step_deg: (2,) distance of the nodes, eastwards and southwards, degrees.
        posting_m: distance of the nodes, metres.
        terrain_m: (rows, columns) metres above the ellipsoid.
        roof_m: (rows, columns) metres above the ellipsoid, minus infinity on open ground.
        albedo: (rows, columns) reflectance seen from above, 0 to 1.
        parcel: (rows, columns) number of the field of a cell, 0 where nothing changes with the date.
    """

    seed: int
    origin_lon_lat: Array
    step_deg: Array
    posting_m: float
    terrain_m: FloatImage
    roof_m: FloatImage
    albedo: FloatImage
    parcel: Parcels

    @property
    def centre_lon_lat(self) -> Array:
        """Longitude and latitude (2,) of the middle of the grid, degrees."""
        rows, columns = self.terrain_m.shape
        return self.lon_lat(np.array([[(columns - 1) / 2.0, (rows - 1) / 2.0]]))[0]

    @cached_property
    def height_range_m(self) -> tuple[float, float]:
        """Lowest ground and highest ground or roof, metres above the ellipsoid."""
        low, high = float(self.terrain_m.min()), float(self.terrain_m.max())
        return low, max(high, float(self.roof_m.max()))

    @cached_property
    def roof_clearance_m(self) -> float:
        """Largest height of a roof above the terrain, metres; zero without buildings."""
        strips = (slice(r, r + _STRIP_ROWS) for r in range(0, len(self.roof_m), _STRIP_ROWS))
        return max(0.0, *(float((self.roof_m[s] - self.terrain_m[s]).max()) for s in strips))

    @cached_property
    def steepest_slope(self) -> float:
        """Largest slope of the terrain, metres per metre."""
        steepest = 0.0
        for r in range(0, len(self.terrain_m), _STRIP_ROWS):
            strip = self.terrain_m[r : r + _STRIP_ROWS + 1]
            steepest = max(steepest, float(np.abs(np.diff(strip, axis=1)).max()))
            if len(strip) > 1:
                steepest = max(steepest, float(np.abs(np.diff(strip, axis=0)).max()))
        return math.sqrt(2.0) * steepest / self.posting_m

    def lon_lat(self, column_row: Array) -> Array:
        """Longitude and latitude (n, 2) of grid positions (n, 2)."""
        return np.asarray(self.origin_lon_lat + column_row * self.step_deg * [1.0, -1.0])

    def column_row(self, lon_lat: Array) -> Array:
        """Grid positions (n, 2) of longitudes and latitudes (n, 2); outside the grid it repeats."""
        offset = lon_lat - self.origin_lon_lat
        offset[:, 0] = wrapped_degrees(offset[:, 0])
        return np.asarray(offset / self.step_deg * [1.0, -1.0])

    def height_m(self, lon_lat: Array) -> Array:
        """Height (n,) of the terrain at positions (n, 2), metres above the ellipsoid."""
        return bilinear_values(self.terrain_m, self.column_row(lon_lat))

    def surface_m(self, lon_lat: Array) -> Array:
        """Height (n,) of the terrain or of the roof above it, metres above the ellipsoid."""
        rows, columns = self.roof_m.shape
        cell = np.floor(self.column_row(lon_lat) + 0.5).astype(np.int64)
        roof = self.roof_m[cell[:, 1] % rows, cell[:, 0] % columns]
        return np.asarray(np.where(roof > NO_ROOF, roof, self.height_m(lon_lat)))


def make_world(
    rng: np.random.Generator,
    size_m: float = 1000.0,
    posting_m: float = 0.5,
    relief_m: float = 60.0,
    *,
    centre_lon_lat: tuple[float, float] = (5.4, 43.6),
    smallest_hill_m: float = 350.0,
    patterned_share: float = 0.0,
    region_m: float | None = None,
) -> World:
    """A random world: hills, fields between roads, woods, villages with buildings, trees.

    Args:
        rng: source of randomness.
        size_m: approximate side of the square, beyond which it repeats.
        posting_m: distance of the nodes.
        relief_m: difference between the lowest and the highest ground.
        centre_lon_lat: centre of the square, degrees.
        smallest_hill_m: wavelength below which the terrain is smooth; larger values make slopes gentler.
        patterned_share: share of the blocks that are orchards and housing estates, whose details repeat.
        region_m: size of forests and towns; None for the same mixture everywhere.
    """
    tiles = max(1, round(size_m / posting_m / _TEXTURE_TILE))
    tile = fft.next_fast_len(round(size_m / posting_m / tiles))
    n = tiles * tile
    seed = int(rng.integers(2**31))
    terrain = _stretch(natural_noise(rng, min(n, _TERRAIN_NODES), 2.6, smallest_hill_m / size_m), n)
    terrain -= terrain.min()
    terrain *= relief_m / terrain.max()
    terrain += np.float32(_LOWEST_M)
    warp_m = 40.0 * min(1.0, size_m / 2000.0 + 0.3)
    warp = np.stack(
        [warp_m / posting_m * natural_noise(rng, _WARP_NODES, 3.0, 300.0 / size_m) for _ in range(2)]
    )
    texture = natural_noise(rng, tile, 1.0, 0.0)
    blotches = natural_noise(rng, _WARP_NODES, 1.5, 0.0)
    regions = np.zeros((1, 1), dtype=np.float32)
    if region_m is not None:
        regions = natural_noise(rng, _REGION_NODES, 1.5, 0.35 * region_m / size_m)
    noise = LandNoise(warp, texture, blotches, regions)
    cover = cover_land(terrain, noise, posting_m, seed, patterned_share)
    east_m, north_m = metres_per_degree(centre_lon_lat[1], _LOWEST_M + relief_m / 2.0)
    step = np.array([posting_m / east_m, posting_m / north_m])
    origin = np.array(centre_lon_lat) + (n - 1) / 2.0 * step * [-1.0, 1.0]
    return World(
        seed=seed,
        origin_lon_lat=origin,
        step_deg=step,
        posting_m=posting_m,
        terrain_m=terrain,
        roof_m=cover.roof_m,
        albedo=cover.albedo,
        parcel=cover.parcel,
    )


def flood(world: World, share: float) -> None:
    """Put the lowest share of a world under water: level, dark, without anything that stands on it.

    The arrays of the world change in place.
    """
    level = np.float32(np.quantile(world.terrain_m[::8, ::8], share))
    for first in range(0, len(world.terrain_m), _STRIP_ROWS):
        strip = slice(first, first + _STRIP_ROWS)
        wet = world.terrain_m[strip] < level
        world.terrain_m[strip][wet] = level
        world.roof_m[strip][wet] = NO_ROOF
        world.albedo[strip][wet] = _WATER_ALBEDO
        world.parcel[strip][wet] = WATER


def with_smoother_terrain(world: World, spacing_m: float) -> World:
    """The world with a terrain that is bicubic between means over squares of `spacing_m`.

    It is what another terrain of the same ground differs by: ridges and valleys between the nodes.
    """
    rows, columns = world.terrain_m.shape
    per_node = max(2.0, spacing_m / world.posting_m)
    nodes = max(8, round(columns / per_node)), max(8, round(rows / per_node))
    coarse = cv2.resize(world.terrain_m, nodes, interpolation=cv2.INTER_AREA)
    terrain = cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC)
    return replace(world, terrain_m=np.asarray(terrain, dtype=np.float32))


def natural_noise(rng: np.random.Generator, n: int, exponent: float, shortest: float) -> FloatImage:
    """Periodic noise (n, n) of unit standard deviation with amplitudes that fall with the frequency.

    Args:
        rng: source of randomness.
        n: side.
        exponent: exponent of the fall; 1 for natural images.
        shortest: wavelength below which the noise fades out, as a fraction of the side.
    """
    white = rng.standard_normal((n, n), dtype=np.float32)
    spectrum = fft.rfft2(white)
    frequency = np.hypot(fft.fftfreq(n)[:, None], fft.rfftfreq(n)[None, :]) * n
    frequency[0, 0] = 1.0
    gain = frequency**-exponent * np.exp(-((frequency * shortest) ** 2) / 2.0)
    gain[0, 0] = 0.0
    noise = fft.irfft2(spectrum * gain.astype(np.float32), s=(n, n))
    return np.asarray(noise / noise.std(), dtype=np.float32)


def _stretch(noise: FloatImage, n: int) -> FloatImage:
    """Periodic noise resampled to (n, n) by cubic interpolation."""
    nodes = len(noise)
    if n == nodes:
        return noise
    margin = 4
    padded = np.pad(noise, margin, mode="wrap")
    scale = nodes / n
    affine = np.array([[scale, 0.0, margin], [0.0, scale, margin]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(padded, affine, (n, n), flags=flags))


def part_of_world(world: World, lon_lat: Array, margin_m: float) -> World:
    """The ground around positions (n, 2) as a small world, which has nothing else."""
    column_row = world.column_row(np.array(lon_lat, dtype=np.float64))
    margin = margin_m / world.posting_m
    first = np.floor(column_row.min(axis=0) - margin).astype(np.int64)
    last = np.ceil(column_row.max(axis=0) + margin).astype(np.int64)
    column, row = (np.arange(low, high) for low, high in zip(first, last, strict=True))
    rows, columns = world.terrain_m.shape
    cells = np.ix_(row % rows, column % columns)
    return World(
        world.seed,
        world.lon_lat(first[None, :].astype(np.float64))[0],
        world.step_deg,
        world.posting_m,
        world.terrain_m[cells],
        world.roof_m[cells],
        world.albedo[cells],
        world.parcel[cells],
    )
