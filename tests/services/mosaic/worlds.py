"""Images on a map cut out of one known picture, for mosaics whose truth is known."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import MapGrid
from amers.services.mosaic.layout import Layout, MosaicMap, MosaicScene, flat_terrain, lay_out
from amers.services.mosaic.mosaic import Mosaic, make_mosaic, mosaic_tiles
from amers.services.mosaic.options import MosaicOptions
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition, FloatImage, IntArray

GSD_M = 0.5
SHAPE = (600, 1100)
GRID = MapGrid(
    "EPSG:32631", np.array([500_000.25, 4_900_000.25]), np.array([[0.0, GSD_M], [-GSD_M, 0.0]]), SHAPE
)
PLACES = ((0, 0, 600, 500), (0, 350, 600, 450), (20, 640, 560, 460))
"""First line and sample and size of three scenes in a row."""


@cache
def picture() -> FloatImage:
    """Ground (bands, lines, samples) with detail of several sizes, grey values of 100 to 900."""
    rng = np.random.default_rng(3)
    bands = []
    for _ in range(2):
        parts = [
            cv2.GaussianBlur(rng.normal(size=SHAPE), (0, 0), size) * size for size in (1.2, 4.0, 15.0)
        ]
        bands.append(sum(parts))
    out = np.stack(bands).astype(np.float32)
    out = (out - out.mean()) / out.std() * np.float32(120.0) + np.float32(500.0)
    return np.clip(out, 100.0, 900.0)


def cut_out(
    number: int, *, off_px: tuple[float, float] = (0.0, 0.0), gain: float = 1.0, offset: float = 0.0
) -> tuple[FloatImage, MapGrid]:
    """Pixels of one of the `PLACES`, and the grid that its model states, which may be off."""
    line, sample, lines, samples = PLACES[number]
    pixels = picture()[:, line : line + lines, sample : sample + samples] * gain + offset
    stated = np.array([line, sample], dtype=np.float64) + off_px
    return pixels.astype(np.float32), replace(
        GRID, origin_xy=GRID.xy(stated[None, :])[0], shape=(lines, samples)
    )


def scene(number: int, pixels: FloatImage, grid: MapGrid) -> MosaicScene:
    """A scene of pixels (bands, lines, samples) on a map."""
    bands = tuple(ArrayImage(band) for band in pixels)
    return MosaicScene(Scene(bands[0], OrthoModel(grid), Acquisition(f"scene_{number}"), 1.0), bands)


def layout_of(scenes: Sequence[MosaicScene]) -> Layout:
    """The scenes on the map of the picture."""
    return lay_out(scenes, flat_terrain(0.0), MosaicMap(GRID.crs, GSD_M))


def mosaic_of(scenes: Sequence[MosaicScene], **options: object) -> Mosaic:
    """Their mosaic."""
    return make_mosaic(layout_of(scenes), flat_terrain(0.0), MosaicOptions(**options))  # type: ignore[arg-type]


def assembled(mosaic: Mosaic) -> tuple[FloatImage, IntArray]:
    """Pixels and numbers of the scenes of a mosaic."""
    bands = len(mosaic.layout.scenes[0].bands)
    pixels = np.full((bands, *mosaic.grid.shape), np.nan, dtype=np.float32)
    source = np.zeros(mosaic.grid.shape, dtype=np.int64)
    for tile in mosaic_tiles(mosaic):
        w = tile.window
        place = np.s_[w.line : w.line + w.lines, w.sample : w.sample + w.samples]
        pixels[:, *place], source[place] = tile.pixels, tile.source
    return pixels, source


def truth_on(grid: MapGrid) -> FloatImage:
    """The picture in the pixels of a grid; NaN beyond it."""
    out = np.full((2, *grid.shape), np.nan, dtype=np.float32)
    line, sample = np.round(GRID.line_sample_of_xy(grid.origin_xy[None, :])[0]).astype(int)
    rows = np.arange(grid.shape[0]) + line
    columns = np.arange(grid.shape[1]) + sample
    inside = ((rows >= 0) & (rows < SHAPE[0])), ((columns >= 0) & (columns < SHAPE[1]))
    out[:, np.flatnonzero(inside[0])[:, None], np.flatnonzero(inside[1])] = picture()[
        :, rows[inside[0]][:, None], columns[inside[1]]
    ]
    return out
