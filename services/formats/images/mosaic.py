"""Many ortho-images as one, read by windows with few files open at a time."""

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.bands import PixelCodes
from amers.services.formats.images.lattices import Placed, placed_on
from amers.services.formats.images.map_statements import map_statements, unused_heights
from amers.services.formats.images.raster import RasterImage, map_grid_of, open_raster, shift_of_grid
from amers.services.formats.pieces import is_band_of_sentinel_2
from amers.services.imagery.source import Window, sample_image
from amers.services.map_grid import MapGrid
from amers.services.statements import Statements, gathered
from amers.services.types import Array, FloatImage, IntArray

MOST_OPEN = 32
"""Files that are open at a time."""
_NODE_PX = 32
"""Pixels between the positions that are transformed from one map to another; bilinear between them.
Meridians of two zones converge by 1e-7 a metre: over 320 m the error is below 0.001 pixels of 10 m."""
_SENTINEL_2 = PixelCodes(nodata=0, saturated=65535)
"""Codes of images of Sentinel-2, which state none: `SPECIAL_VALUE` of their products."""


@dataclass
class ImageMosaic:
    """Bands of many ortho-images on one grid; an `ImageSource`.

    Where images overlap, the first one with data there counts.

    Attributes:
        shape: lines and samples.
        grid: common to all images.
        pieces: the images, in their order.
        statements: of their files.
        shift_sigma_m: largest accuracy of the transformations of their maps to WGS 84.
    """

    shape: tuple[int, int]
    grid: MapGrid
    pieces: tuple[Placed, ...]
    statements: Statements = ()
    shift_sigma_m: float = 0.0
    _open: OrderedDict[FilePlace, RasterImage] = field(
        default_factory=OrderedDict, repr=False, compare=False
    )

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window, (lines, samples) float32; NaN where no image has data."""
        out = np.full((window.lines, window.samples), np.nan, dtype=np.float32)
        begin = np.array([window.line, window.sample])
        end = begin + [window.lines, window.samples]
        lows, highs = self._reaches
        for number in np.flatnonzero(((lows < end) & (highs >= begin)).all(axis=1)):
            low, high = np.maximum(begin, lows[number]), np.minimum(end, highs[number] + 1)
            part = out[tuple(slice(a, b) for a, b in zip(low - begin, high - begin, strict=True))]
            missing = np.isnan(part)
            if missing.any():
                part[missing] = self._of_piece(self.pieces[number], low, high)[missing]
            if not np.isnan(out).any():
                break
        return out

    def close(self) -> None:
        """Close all files; those that are read again are opened again."""
        while self._open:
            self._open.popitem()[1].close()

    @cached_property
    def _reaches(self) -> tuple[IntArray, IntArray]:
        """First and last pixels (n, 2) of the images."""
        lows = np.array([piece.low for piece in self.pieces])
        return lows, np.array([piece.high for piece in self.pieces])

    def __getstate__(self) -> dict[str, object]:
        """Files are opened again in another process."""
        return vars(self) | {"_open": OrderedDict()}

    def _of_piece(self, piece: Placed, low: IntArray, high: IntArray) -> FloatImage:
        """Pixels of an image at the pixels of the common grid from `low` to before `high`."""
        lines, samples = (int(size) for size in high - low)
        image = self._image(piece.path)
        if piece.is_aligned:
            line, sample = (int(pixel) for pixel in low - piece.low)
            return image.read(Window(line, sample, lines, samples))
        positions = _positions(self.grid, piece.grid, low, (lines, samples))
        return sample_image(image, positions, self.grid.gsd_m / piece.grid.gsd_m)

    def _image(self, path: FilePlace) -> RasterImage:
        if path in self._open:
            self._open.move_to_end(path)
        else:
            self._open[path] = open_piece(path)
            while len(self._open) > MOST_OPEN:
                self._open.popitem(last=False)[1].close()
        return self._open[path]


def open_mosaic(files: list[FilePlace], outline: Array | None = None) -> ImageMosaic:
    """Many ortho-images on the lattice of the finest of them.

    Args:
        files: of the images; the first counts where they overlap.
        outline: (n, 2) lon, lat; images that lie apart from its box are left out, unless all do.

    Raises:
        FormatError: a file cannot be used, or lies on no map.
    """
    grids: dict[FilePlace, MapGrid] = {}
    statements: dict[FilePlace, Statements] = {}
    shift_sigma_m = 0.0
    for file in files:
        image = open_piece(file)
        try:
            grid = map_grid_of(image)
            if grid is None:
                raise FormatError(
                    f"{file}: expected an ortho-image on a map, found no coordinate reference system"
                )
            shift = shift_of_grid(image, grid)
            grids[file] = grid
            shift_sigma_m = max(shift_sigma_m, shift.sigma_m)
            statements[file] = (
                *image.statements,
                *map_statements(image, grid, shift),
                *unused_heights(image, grid),
            )
        finally:
            image.close()
    near = {file: grid for file, grid in grids.items() if outline is None or _is_near(grid, outline)}
    used = near or grids
    # The first of the finest: their samplings differ by less than a thousandth where zones meet.
    finest_m = min(grid.gsd_m for grid in used.values())
    lattice = next(grid for grid in used.values() if grid.gsd_m < 1.01 * finest_m)
    grid, pieces = placed_on(lattice, used)
    said = gathered(one for file in used for one in statements[file])
    return ImageMosaic(grid.shape, grid, pieces, said, shift_sigma_m)


def open_piece(path: FilePlace) -> RasterImage:
    """The first band of an ortho-image; pixels of 0 have no data in a band of Sentinel-2.

    Raises:
        FormatError: as `open_raster`.
    """
    image = open_raster(path)
    return image.with_codes(_SENTINEL_2) if is_band_of_sentinel_2(path) else image


def _is_near(grid: MapGrid, outline: Array) -> bool:
    """Whether the boxes of an image and of an outline meet, in longitude and latitude."""
    lines, samples = grid.shape
    at = [[-0.5, -0.5], [-0.5, samples], [lines, samples], [lines, -0.5], [lines / 2.0, samples / 2.0]]
    lon_lat = grid.lon_lat(np.array(at))
    lon_lat[:, 0] = outline[0, 0] + (lon_lat[:, 0] - outline[0, 0] + 180.0) % 360.0 - 180.0
    low, high = np.nanmin(lon_lat, axis=0), np.nanmax(lon_lat, axis=0)
    return bool((low <= outline.max(axis=0)).all() and (high >= outline.min(axis=0)).all())


def _positions(grid: MapGrid, own: MapGrid, low: IntArray, shape: tuple[int, int]) -> Array:
    """Positions (lines, samples, 2) in an image of the pixels of a window of the common grid."""
    axes = [np.arange(0, size + _NODE_PX, _NODE_PX, dtype=np.float64) for size in shape]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    at = own.line_sample(grid.lon_lat(nodes.reshape(-1, 2) + low)).reshape(nodes.shape)
    line, sample = (
        np.maximum(0.0, 1.0 - np.abs(np.arange(size)[:, None] - axis) / _NODE_PX)
        for size, axis in zip(shape, axes, strict=True)
    )
    return np.stack([line @ at[..., k] @ sample.T for k in range(2)], axis=-1)
