"""Flat ground of many kilometres that is computed where it is seen, its scenes and its points."""

from dataclasses import dataclass, field, replace
from functools import cache

import cv2
import numpy as np

from amers.services.conventions import CHIP_SIZE
from amers.services.geodesy import east_north_up, lon_lat_h_from_east_north_up
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, chip_ground
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, no_correction
from amers.services.simulation.orbit import pushbroom_over
from amers.services.types import (
    Acquisition,
    Array,
    ChipArray,
    ControlPoints,
    FloatImage,
)
from tests.services.simulated import points_with, views_of_points

CENTRE = np.array([5.4, 43.6, 0.0])
STEP_M = 2.0
PERIODS_PX = (997, 1103, 1217, 1321)
"""Of four textures that repeat; their sum does so nowhere within 10 km."""
_NODE_PX = 16
_TILE_PX = 16 * _NODE_PX
_CHIP_NODE_PX = 25


@cache
def _textures(seed: int, mean_px: int) -> tuple[FloatImage, ...]:
    """One period of each texture, averaged over squares of `mean_px` pixels around each."""
    made = []
    for k, period in enumerate(PERIODS_PX):
        rng = np.random.default_rng([seed, k])
        frequency = np.hypot(np.fft.fftfreq(period)[:, None], np.fft.fftfreq(period)[None, :])
        spectrum = np.fft.fft2(rng.standard_normal((period, period)))
        spectrum *= np.exp(-((frequency * 1.2) ** 2)) / np.maximum(frequency, 1.0 / period)
        texture = np.fft.ifft2(spectrum).real
        texture = (texture / texture.std()).astype(np.float32)
        around = np.pad(texture, mean_px, mode="wrap")
        averaged = cv2.blur(around, (mean_px, mean_px))[mean_px:-mean_px, mean_px:-mean_px]
        made.append(np.pad(averaged, (0, 1), mode="wrap"))
    return tuple(made)


def brightness(east: Array, north: Array, seed: int = 0, mean_px: int = 1) -> FloatImage:
    """Grey values of the ground at positions in the frame of `CENTRE`, metres; means of squares."""
    total = np.zeros(east.shape, dtype=np.float32)
    column, row = east / STEP_M, north / STEP_M
    for period, texture in zip(PERIODS_PX, _textures(seed, mean_px), strict=True):
        # As `% period`, in a quarter of the time.
        x, y = ((axis - period * np.floor(axis / period)).astype(np.float32) for axis in (column, row))
        total += cv2.remap(texture, x, y, cv2.INTER_LINEAR)
    return np.asarray(1000.0 + 120.0 * total, dtype=np.float32)


def _between_nodes(enu: Array, shape: tuple[int, int], step_px: int) -> tuple[Array, Array]:
    """East and north of all pixels, bilinear between nodes (n, m, 2) every `step_px` pixels."""
    rows, columns = (
        np.maximum(0.0, 1.0 - np.abs(np.arange(size)[:, None] / step_px - np.arange(count)))
        for size, count in zip(shape, enu.shape[:2], strict=True)
    )
    return rows @ enu[..., 0] @ columns.T, rows @ enu[..., 1] @ columns.T


@cache
def true_model(size_m: float, gsd_m: float, side: int) -> SensorModel:
    """The model of the middle `side` x `side` pixels of a scene of `size_m`."""
    whole = round(size_m / gsd_m)
    model = pushbroom_over(CENTRE, (whole, whole), gsd_m, (8.0, 100.0), (-100.0, 500.0))
    crop = no_correction((side, side))
    crop.parameters[:, 0] = -(whole - side) / 2.0
    return CorrectedModel(model, crop)


@cache
def wide_image(size_m: float, gsd_m: float, side: int, seed: int) -> ArrayImage:
    """What a sensor sees of the ground of a seed, with noise of its own; see `true_model`."""
    model, rng = true_model(size_m, gsd_m, side), np.random.default_rng(10_000)
    pixels = rng.normal(0.0, 20.0, (side, side)).astype(np.float32)
    axis = np.arange(0, _TILE_PX + 1, _NODE_PX)
    for first in np.ndindex(-(-side // _TILE_PX), -(-side // _TILE_PX)):
        nodes = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1) + _TILE_PX * np.array(first)
        ground = model.locate(nodes.reshape(-1, 2).astype(np.float64), np.zeros(nodes.size // 2))
        enu = east_north_up(ground, CENTRE)[:, :2].reshape(nodes.shape)
        line, sample = _TILE_PX * np.array(first)
        tile = pixels[line : line + _TILE_PX, sample : sample + _TILE_PX]
        tile += brightness(*_between_nodes(enu, tile.shape, _NODE_PX), seed)
    return ArrayImage(pixels)


def wide_scene(
    size_m: float, gsd_m: float, side: int, error_m: tuple[float, float], *, seed: int = 0
) -> Scene:
    """A scene whose model is off by an error east and north; 5 km are three of its sigmas."""
    truth = true_model(size_m, gsd_m, side)
    error = no_correction((side, side))
    error.parameters[:, 0] = truth.project_derivative(CENTRE[None, :])[0, :, :2] @ np.array(error_m)
    return Scene(
        wide_image(size_m, gsd_m, side, seed),
        CorrectedModel(truth, error),
        Acquisition("wide", incidence_deg=8.0, azimuth_deg=100.0),
        5000.0 / 3.0,
    )


@dataclass(frozen=True)
class WideChips:
    """Chips that are cut from the ground when they are first read.

    Attributes:
        lon_lat_h: (n, 3) the points.
        gsds_m: of the chips of each point.
        cut: the chips that were read, by the row of the point.
    """

    lon_lat_h: Array
    gsds_m: tuple[float, ...]
    cut: dict[int, ChipArray] = field(default_factory=dict)

    def read(self, file: str, row: int, count: int) -> ChipArray:
        """The chips of the point whose first row is `row`."""
        if row not in self.cut:
            point = self.lon_lat_h[row // len(self.gsds_m)]
            self.cut[row] = np.stack([self._chip(point, gsd_m) for gsd_m in self.gsds_m])
        return self.cut[row]

    def _chip(self, point: Array, gsd_m: float) -> ChipArray:
        nodes = CHIP_SIZE // _CHIP_NODE_PX + 1
        ground = chip_ground(point, gsd_m * _CHIP_NODE_PX, nodes)
        enu = east_north_up(ground, CENTRE)[:, :2].reshape(nodes, nodes, 2)
        east, north = _between_nodes(enu, (CHIP_SIZE, CHIP_SIZE), _CHIP_NODE_PX)
        # An odd number of pixels is averaged, so that the mean stays on the pixel.
        mean_px = int(gsd_m / STEP_M) | 1
        pixels = brightness(east, north, mean_px=mean_px)
        return np.clip(pixels, 1.0, 65535.0).astype(np.uint16)


def wide_points(
    half_m: float, spacing_m: float, gsds_m: tuple[float, ...]
) -> tuple[ControlPoints, WideChips]:
    """Points on a jittered grid around the centre, and their chips."""
    axis = np.arange(-half_m, half_m, spacing_m)
    enu = np.stack([*np.meshgrid(axis, axis), np.zeros((len(axis), len(axis)))], -1).reshape(-1, 3)
    enu[:, :2] += np.random.default_rng(5).uniform(0.0, 0.8 * spacing_m, (len(enu), 2))
    lon_lat_h = lon_lat_h_from_east_north_up(enu, CENTRE)
    lon_lat_h[:, 2] = 0.0
    base = replace(Acquisition("base"), incidence_deg=8.0, azimuth_deg=100.0)
    views = views_of_points(len(lon_lat_h), gsds_m, 8.0, 100.0, images=(base,))
    points = points_with(lon_lat_h, views, 0.3)
    return points, WideChips(lon_lat_h, gsds_m)
