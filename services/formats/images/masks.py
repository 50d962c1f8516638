"""Masks: where the pixels of an image shall not be used, told by another file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from services.errors import FormatError
from services.formats.images.raster import RasterImage, open_raster
from services.imagery.source import Window
from services.types import FloatImage

_SAME_SHAPE = 0.01
"""Relative difference of the reductions along lines and samples up to which a mask shows the image."""


@dataclass(frozen=True)
class MaskedImage:
    """An image without the pixels that a mask takes away; an `ImageSource`.

    Attributes:
        image: the image.
        mask: not zero where pixels shall not be used; covers the same ground, with other pixels perhaps.
    """

    image: RasterImage
    mask: RasterImage

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.image.shape

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; NaN beyond the image, where nodata, and under the mask."""
        pixels = self.image.read(window)
        line = _mask_pixels(window.line, window.lines, self.shape[0], self.mask.shape[0])
        sample = _mask_pixels(window.sample, window.samples, self.shape[1], self.mask.shape[1])
        first = int(line[0]), int(sample[0])
        covered = self.mask.read(
            Window(*first, int(line[-1]) - first[0] + 1, int(sample[-1]) - first[1] + 1)
        )
        # What a mask calls nodata it says nothing of.
        hidden = np.nan_to_num(covered) != 0.0
        pixels[hidden[np.ix_(line - first[0], sample - first[1])]] = np.nan
        return pixels


def masked(image: RasterImage, mask: Path) -> MaskedImage:
    """An image without the pixels that a mask file takes away.

    Args:
        image: opened.
        mask: GeoTIFF, JPEG 2000 or NITF of the same ground as the image, with the same or with coarser
            pixels; not zero where pixels shall not be used.

    Raises:
        FormatError: when the mask cannot be used, or does not have the shape of the image.
    """
    opened = open_raster(mask)
    by_line, by_sample = (n / m for n, m in zip(image.shape, opened.shape, strict=True))
    if abs(by_line / by_sample - 1.0) > _SAME_SHAPE:
        opened.close()
        raise FormatError(
            f"{mask}: expected a mask of the same ground as {image.path.name}: its {opened.shape[0]} x "
            f"{opened.shape[1]} pixels have another shape than {image.shape[0]} x {image.shape[1]}"
        )
    return MaskedImage(image, opened)


def _mask_pixels(first: int, count: int, size: int, mask_size: int) -> np.ndarray:
    """The pixel of a mask that covers each of some pixels of the image, along one axis."""
    position = (np.arange(first, first + count) + 0.5) * mask_size / size
    return np.clip(np.floor(position).astype(np.int64), 0, mask_size - 1)
