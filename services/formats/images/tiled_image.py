"""An image that is delivered in several files, read by windows as one image."""

from dataclasses import dataclass, replace

import numpy as np
import rasterio

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.bands import BandMix, PixelCodes
from amers.services.formats.images.raster import RasterImage, open_raster
from amers.services.formats.images.validity import Validity
from amers.services.imagery.source import Window
from amers.services.statements import Statements, gathered
from amers.services.types import FloatImage


@dataclass(frozen=True)
class TiledImage:
    """Tiles of one image: an `ImageSource` for one thread at a time.

    Attributes:
        path: of the document that lists the tiles.
        shape: lines and samples of the whole image.
        tiles: the files; they do not overlap.
        first: line and sample of the first pixel of each.
        statements: of the files, and what became of them.
    """

    path: FilePlace
    shape: tuple[int, int]
    tiles: tuple[RasterImage, ...]
    first: tuple[tuple[int, int], ...]
    statements: Statements = ()

    @property
    def dataset(self) -> rasterio.DatasetReader:
        """Of the first tile, with metadata that all tiles share."""
        return self.tiles[0].dataset

    @property
    def mix(self) -> BandMix:
        """The bands, and their weights."""
        return self.tiles[0].mix

    @property
    def validity(self) -> Validity:
        """Which pixels of the tiles have no data, as the first one states it."""
        return self.tiles[0].validity

    @property
    def codes(self) -> PixelCodes:
        """Statements of the product about its pixels."""
        return self.tiles[0].codes

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window, (lines, samples) float32; NaN between and beyond the tiles.

        Raises:
            FormatError: a file cannot be read there.
        """
        out = np.full((window.lines, window.samples), np.nan, dtype=np.float32)
        for tile, (line, sample) in zip(self.tiles, self.first, strict=True):
            top, left = max(window.line, line), max(window.sample, sample)
            bottom = min(window.line + window.lines, line + tile.shape[0])
            right = min(window.sample + window.samples, sample + tile.shape[1])
            if bottom > top and right > left:
                part = Window(top - line, left - sample, bottom - top, right - left)
                out[
                    top - window.line : bottom - window.line,
                    left - window.sample : right - window.sample,
                ] = tile.read(part)
        return out

    def close(self) -> None:
        """Close all files; they cannot be read afterwards."""
        for tile in self.tiles:
            tile.close()

    def saturated_values(self, band: int) -> tuple[int, ...]:
        """The values of a band that mean "saturated"."""
        return self.tiles[0].saturated_values(band)

    def with_mix(self, mix: BandMix) -> "TiledImage":
        """The same files with other bands."""
        return replace(self, tiles=tuple(tile.with_mix(mix) for tile in self.tiles))

    def with_codes(self, codes: PixelCodes) -> "TiledImage":
        """The image with other statements of its product about its pixels."""
        return replace(self, tiles=tuple(replace(tile, codes=codes) for tile in self.tiles))


SceneImage = RasterImage | TiledImage
"""An opened image: one file, or the tiles of a product."""


def open_tiles(
    path: FilePlace,
    shape: tuple[int, int],
    tiles: list[tuple[FilePlace, tuple[int, int], tuple[int, int]]],
    bands: int | BandMix | None = 1,
) -> TiledImage:
    """Open the files of one image.

    Args:
        path: of the document that lists them.
        shape: of the whole image.
        tiles: file, place of its first pixel and shape of each.
        bands: as for `open_raster`.

    Raises:
        FormatError: a file cannot be used, or has another shape or other bands than the others.
    """
    images: list[RasterImage] = []
    try:
        for file, _, expected in tiles:
            images.append(open_raster(file, bands))
            if images[-1].shape != expected:
                raise FormatError(
                    f"{file}: {images[-1].shape[0]} x {images[-1].shape[1]} pixels found, {path.name} "
                    f"states {expected[0]} x {expected[1]} for this tile; give the delivered tiles"
                )
            new, known = images[-1], images[0]
            if (new.mix, new.dataset.dtypes) != (known.mix, known.dataset.dtypes):
                raise FormatError(
                    f"{file}: other bands or another type of pixels found than in {known.path.name}, "
                    "tiles of one image expected"
                )
    except FormatError:
        for image in images:
            image.close()
        raise
    statements = gathered(one for image in images for one in image.statements)
    places = tuple(first for _, first, _ in tiles)
    return TiledImage(path, shape, tuple(images), places, statements)
