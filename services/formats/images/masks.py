"""Masks: files that exclude pixels of an image."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.images.raster import OpenImage, RasterImage, open_raster
from amers.services.imagery.source import Window
from amers.services.types import FloatImage

_SAME_SHAPE = 0.01
"""Largest relative difference between the pixel size ratios of mask and image along both axes."""


@dataclass(frozen=True)
class MaskedImage:
    """An image without the pixels that a mask excludes; an `ImageSource`.

    Attributes:
        image: the image.
        mask: nonzero where pixels are excluded; covers the same ground, with the same or other pixels.
    """

    image: OpenImage
    mask: RasterImage

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.image.shape

    def close(self) -> None:
        """Close both files."""
        self.image.close()
        self.mask.close()

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; NaN beyond the image, where nodata, and under the mask."""
        pixels = self.image.read(window)
        line = _mask_pixels(window.line, window.lines, self.shape[0], self.mask.shape[0])
        sample = _mask_pixels(window.sample, window.samples, self.shape[1], self.mask.shape[1])
        first = int(line[0]), int(sample[0])
        covered = self.mask.read(
            Window(*first, int(line[-1]) - first[0] + 1, int(sample[-1]) - first[1] + 1)
        )
        # Nodata in a mask excludes nothing.
        excluded = np.nan_to_num(covered) != 0.0
        pixels[excluded[np.ix_(line - first[0], sample - first[1])]] = np.nan
        return pixels


def apply_mask(image: OpenImage, mask: Path) -> MaskedImage:
    """The image without the pixels that a mask file excludes.

    Args:
        image: opened image.
        mask: GeoTIFF, JPEG 2000 or NITF of the same ground as the image, with the same or coarser
            pixels; nonzero where pixels are excluded.

    Raises:
        FormatError: the mask cannot be read, or its shape differs from that of the image.
    """
    opened = open_raster(mask)
    by_line, by_sample = (n / m for n, m in zip(image.shape, opened.shape, strict=True))
    if abs(by_line / by_sample - 1.0) > _SAME_SHAPE:
        opened.close()
        raise FormatError(
            f"{mask}: {opened.shape[0]} x {opened.shape[1]} pixels found, a mask of the same ground as "
            f"{image.path.name} with the proportions of {image.shape[0]} x {image.shape[1]} expected"
        )
    return MaskedImage(image, opened)


def _mask_pixels(first: int, count: int, size: int, mask_size: int) -> np.ndarray:
    """The mask pixel that covers each of `count` image pixels, along one axis."""
    position = (np.arange(first, first + count) + 0.5) * mask_size / size
    return np.clip(np.floor(position).astype(np.int64), 0, mask_size - 1)
