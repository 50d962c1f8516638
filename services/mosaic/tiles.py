"""Tiles of a mosaic at full resolution: each pixel comes from the scene of its cell."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from amers.services.imagery.source import Window
from amers.services.mosaic.layout import Layout, MosaicScene, Rectifier, common_window, inside
from amers.services.mosaic.levelling import Levels
from amers.services.mosaic.options import BLOCK_PX
from amers.services.mosaic.seams import Labels
from amers.services.tasks import Arrays
from amers.services.types import BoolArray, FloatImage, IntArray

_EXTENDED = 3
"""Cells by which scenes are extended into cells of none: border cells are never certain."""
_ROUNDED = 1
"""Cells on both sides over which the corners of cells are rounded off."""
_ALONE = 1e-6
"""Share below the greatest at which a scene counts as much as the greatest."""


@dataclass(frozen=True)
class TileScenes:
    """The scenes that reach a tile.

    Attributes:
        numbers: of them among all, ascending.
        scenes, windows: of each.
        levels: of each, in this order.
    """

    numbers: tuple[int, ...]
    scenes: tuple[MosaicScene, ...]
    windows: tuple[Window, ...]
    levels: Levels


@dataclass(frozen=True)
class TileLabels:
    """The cells of a tile and around it.

    Attributes:
        labels: (lines, samples).
        first: line and sample of their first cell.
        cell_px: side of a cell, pixels.
        feather_px: width of the blended strip, pixels.
    """

    labels: Labels
    first: tuple[int, int]
    cell_px: int
    feather_px: float

    def weights(self, number: int, block: Window) -> FloatImage:
        """Share (lines, samples) of a scene in the surroundings of the pixels of a block."""
        reach = _reach(self.feather_px, self.cell_px)
        share = cv2.blur(
            (self.labels == number + 1).astype(np.float32),
            (2 * reach + 1, 2 * reach + 1),
            borderType=cv2.BORDER_REPLICATE,
        )
        rows = self._interpolation(block.line, block.lines, 0)
        columns = self._interpolation(block.sample, block.samples, 1)
        return np.asarray(rows @ share @ columns.T, dtype=np.float32)

    @property
    def strip(self) -> float:
        """Difference of the shares of two scenes at the border of the blended strip."""
        whole_px = (2 * _reach(self.feather_px, self.cell_px) + 1) * self.cell_px
        return max(self.feather_px / whole_px, _ALONE)

    def _interpolation(self, first: int, count: int, axis: int) -> FloatImage:
        """Bilinear weights (count, cells) of the cells at pixels of the map."""
        at = (np.arange(first, first + count) - (self.cell_px - 1) / 2.0) / self.cell_px
        at = np.clip(at - self.first[axis], 0.0, self.labels.shape[axis] - 1.0)
        low = np.minimum(at.astype(np.int64), self.labels.shape[axis] - 1)
        high = np.minimum(low + 1, self.labels.shape[axis] - 1)
        out = np.zeros((count, self.labels.shape[axis]), dtype=np.float32)
        np.add.at(out, (np.arange(count), low), (1.0 - (at - low)).astype(np.float32))
        np.add.at(out, (np.arange(count), high), (at - low).astype(np.float32))
        return out


def _reach(feather_px: float, cell_px: int) -> int:
    """Cells on both sides over which shares are averaged: the strip fits into their slope."""
    return max(_ROUNDED, math.ceil((feather_px / cell_px - 1.0) / 2.0))


def tile_labels(layout: Layout, labels: Labels, window: Window, feather_px: float) -> TileLabels:
    """The cells that a tile depends on."""
    side = layout.cell_px
    margin = _reach(feather_px, side) + _EXTENDED + 2
    line, sample = window.line // side - margin, window.sample // side - margin
    last_line = -(-(window.line + window.lines) // side) + margin
    last_sample = -(-(window.sample + window.samples) // side) + margin
    around = Window(line, sample, last_line - line, last_sample - sample)
    out = np.zeros((around.lines, around.samples), dtype=np.int16)
    common = common_window(around, Window(0, 0, *labels.shape))
    if common is not None:
        out[inside(common, around)] = labels[inside(common, Window(0, 0, *labels.shape))]
    for _ in range(_EXTENDED):
        # The lowest number around, so that the result does not depend on the order of the cells.
        free = np.where(out == 0, np.iinfo(np.int16).max, out).astype(np.int16)
        lowest = cv2.erode(free, np.ones((3, 3)), borderType=cv2.BORDER_REPLICATE)
        out = np.where((out == 0) & (lowest < np.iinfo(np.int16).max), lowest, out)
    return TileLabels(out, (line, sample), side, feather_px)


def tile_scenes(layout: Layout, levels: Levels, window: Window) -> TileScenes:
    """The scenes that reach a window of the map."""
    numbers = layout.reaching(window)
    return TileScenes(
        tuple(numbers),
        tuple(layout.scenes[k] for k in numbers),
        tuple(layout.windows[k] for k in numbers),
        Levels(levels.gain[numbers], levels.offset[numbers]),
    )


def tile_task(window: Window, labels: TileLabels, found: TileScenes, rectifier: Rectifier) -> Arrays:
    """Pixels (bands, lines, samples) of a tile, and the numbers (lines, samples) of their scenes."""
    bands = len(found.scenes[0].bands)
    pixels = np.full((bands, window.lines, window.samples), np.nan, dtype=np.float32)
    source = np.zeros((window.lines, window.samples), dtype=np.uint16)
    for line in range(window.line, window.line + window.lines, BLOCK_PX):
        for sample in range(window.sample, window.sample + window.samples, BLOCK_PX):
            block = common_window(window, Window(line, sample, BLOCK_PX, BLOCK_PX))
            assert block is not None
            rows, columns = inside(block, window)
            shown = _Block(block, np.empty((bands, block.lines, block.samples), dtype=np.float32))
            shown.fill(labels, found, rectifier)
            pixels[:, rows, columns], source[rows, columns] = shown.pixels, shown.source
    return {"pixels": pixels, "source": source}


class _Block:
    """Pixels of a block of a tile on their way from the scenes."""

    def __init__(self, window: Window, pixels: FloatImage) -> None:
        self.window = window
        self.pixels = pixels
        self.source = np.zeros(pixels.shape[1:], dtype=np.uint16)
        pixels[:] = np.nan

    def fill(self, labels: TileLabels, found: TileScenes, rectifier: Rectifier) -> None:
        """Blend the scenes that the cells have; then fill what these lack from the others."""
        near = [
            k for k, window in enumerate(found.windows) if common_window(window, self.window) is not None
        ]
        shares = {k: labels.weights(found.numbers[k], self.window) for k in near}
        shares = {k: share for k, share in shares.items() if share.any()}

        def image(k: int) -> FloatImage:
            return found.levels.apply(rectifier.pixels(found.scenes[k], self.window), k)

        self._blend(shares, [image(k) for k in shares], labels.strip, found.numbers)
        for k in near:
            empty = self.source == 0
            if not empty.any():
                break
            if k not in shares:
                self._take(image(k), empty, found.numbers[k])

    def _blend(
        self,
        shares: dict[int, FloatImage],
        images: Sequence[FloatImage],
        strip: float,
        numbers: Sequence[int],
    ) -> None:
        if not shares:
            return
        valid = [~np.isnan(image).any(axis=0) for image in images]
        share = np.stack(list(shares.values()))
        # What a scene with a share of nothing shows is better than nothing.
        share = np.where(valid, np.maximum(share, np.float32(_ALONE)), np.float32(-1.0))
        greatest = share.max(axis=0)
        weight = np.maximum(share - greatest + np.float32(strip), 0.0) * (share > 0.0)
        if strip <= _ALONE:
            weight = (np.arange(len(share))[:, None, None] == share.argmax(axis=0)) & (share > 0.0)
        weight = weight.astype(np.float32)
        total = weight.sum(axis=0)
        blended = np.zeros_like(self.pixels)
        for image, one in zip(images, weight, strict=True):
            blended += np.where(one > 0.0, image * one, np.float32(0.0))
        seen = total > 0.0
        self.pixels[:, seen] = (blended / np.where(seen, total, np.float32(1.0)))[:, seen]
        chosen: IntArray = np.array([numbers[k] + 1 for k in shares], dtype=np.int64)
        self.source[seen] = chosen[share.argmax(axis=0)][seen]

    def _take(self, image: FloatImage, where: BoolArray, number: int) -> None:
        """Fill pixels with a scene where it has data."""
        where = np.asarray(where & ~np.isnan(image).any(axis=0))
        self.pixels[:, where] = image[:, where]
        self.source[where] = number + 1
