"""Tiles of a raw image for a viewer: grey values at decreasing resolutions, in one file."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
import numpy.typing as npt

from amers.services.imagery.source import ImageSource, Window
from amers.services.types import FloatImage, Progress, no_progress

TILE_PX = 512
_QUALITY = 85
_STRETCH = (0.5, 99.5)
"""Percentiles of the grey values that become black and white."""
_SAMPLES = 8
"""Windows along each axis that the stretch is taken from, of `_SAMPLE_PX` pixels a side."""
_SAMPLE_PX = 128

Grey = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class TileLevel:
    """The tiles of one resolution, row by row.

    Attributes:
        lines, samples: of the image at this resolution.
        tiles: offset and size of each tile in the file, bytes.
    """

    lines: int
    samples: int
    tiles: list[tuple[int, int]]


@dataclass(frozen=True)
class TileIndex:
    """Where the tiles of an image are: JPEG of `tile_px` pixels a side, less at far borders.

    Attributes:
        lines, samples: of the image.
        tile_px: side of a tile.
        levels: from full resolution on, each with half the resolution of the one before; the last has
            one tile.
    """

    lines: int
    samples: int
    tile_px: int
    levels: list[TileLevel]


def format_tile_index(index: TileIndex) -> str:
    """The index as JSON."""
    return json.dumps(asdict(index), separators=(",", ":"))


def write_tiles(image: ImageSource, path: Path, progress: Progress = no_progress) -> TileIndex:
    """Write the tiles of an image, read by strips, and return where they are.

    Args:
        image: of any size; pixels without data become black, saturated ones white.
        path: of the file.
        progress: receives the fraction done and a message.
    """
    lines, samples = image.shape
    black, white = grey_range(image)
    with path.open("wb") as file:
        pyramid = _Pyramid(file, lines, samples)
        for line in range(0, lines, TILE_PX):
            window = Window(line, 0, min(TILE_PX, lines - line), samples)
            pyramid.add(0, grey_values(image.read(window), black, white))
            progress((line + window.lines) / lines, "drawing the tiles")
    return TileIndex(lines, samples, TILE_PX, pyramid.levels)


class _Pyramid:
    """Tiles of all resolutions on their way into a file."""

    def __init__(self, file: BinaryIO, lines: int, samples: int) -> None:
        self.file = file
        self.levels = [TileLevel(lines, samples, [])]
        while max(lines, samples) > TILE_PX:
            lines, samples = (lines + 1) // 2, (samples + 1) // 2
            self.levels.append(TileLevel(lines, samples, []))
        self._waiting: list[list[Grey]] = [[] for _ in self.levels]
        self._added = [0 for _ in self.levels]

    def add(self, level: int, strip: Grey) -> None:
        """Write the next lines of a level, at most a tile high, and those of the levels above it."""
        waiting = self._waiting[level]
        waiting.append(strip)
        self._added[level] += len(strip)
        is_last = self._added[level] == self.levels[level].lines
        if sum(map(len, waiting)) < TILE_PX and not is_last:
            return
        whole = np.concatenate(waiting)
        waiting.clear()
        self._write(level, whole)
        if level + 1 < len(self.levels):
            self.add(level + 1, _halved(whole))

    def _write(self, level: int, strip: Grey) -> None:
        for sample in range(0, strip.shape[1], TILE_PX):
            tile = np.ascontiguousarray(strip[:, sample : sample + TILE_PX])
            done, encoded = cv2.imencode(".jpg", tile, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            assert done, "a grey image can be a JPEG"
            content = encoded.tobytes()
            self.levels[level].tiles.append((self.file.tell(), len(content)))
            self.file.write(content)


def grey_range(image: ImageSource) -> tuple[float, float]:
    """The values that become black and white, from windows all over the image."""
    lines, samples = image.shape
    side = _SAMPLE_PX
    places = [
        Window(int(line), int(sample), side, side)
        for line in np.linspace(0, max(lines - side, 0), _SAMPLES)
        for sample in np.linspace(0, max(samples - side, 0), _SAMPLES)
    ]
    values = np.concatenate([image.read(window).ravel() for window in places])
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 1.0
    black, white = np.percentile(values, _STRETCH)
    return float(black), float(max(white, black + 1.0))


def grey_values(pixels: FloatImage, black: float, white: float) -> Grey:
    scaled = np.nan_to_num((pixels - black) * (255.0 / (white - black)), nan=0.0, posinf=255.0)
    return np.clip(scaled, 0.0, 255.0).astype(np.uint8)


def _halved(strip: Grey) -> Grey:
    """Means of 2 x 2 pixels; an odd last line or column is repeated."""
    even = np.pad(strip, [(0, size % 2) for size in strip.shape], mode="edge")
    size = even.shape[1] // 2, even.shape[0] // 2
    return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
