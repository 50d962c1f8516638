"""Bands that open their file only while they are read, for mosaics of hundreds of images."""

import pickle
import threading
from collections import OrderedDict
from dataclasses import dataclass

from amers.services.formats.images.bands import one_band
from amers.services.formats.images.tiled_image import SceneImage
from amers.services.imagery.source import Window
from amers.services.types import FloatImage

OPEN_AT_ONCE = 8
"""Images that a thread keeps open: neighbours of a tile are read again and again."""
_open = threading.local()


@dataclass(frozen=True)
class ReopenedBand:
    """One band of an image, an `ImageSource` for any thread and process.

    Attributes:
        image: how it is opened.
        band: number of the band.
        shape: lines and samples.
    """

    image: bytes
    band: int
    shape: tuple[int, int]

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; see `ImageSource`.

        Raises:
            FormatError: the file cannot be opened again, or not be read there.
        """
        return _opened(self.image).with_mix(one_band(self.band)).read(window)


def reopened_bands(image: SceneImage) -> tuple[ReopenedBand, ...]:
    """All bands of an image that are no alpha band; the image itself may be closed."""
    again = pickle.dumps(image)
    return tuple(ReopenedBand(again, band, image.shape) for band in image.validity.image_bands)


def _opened(again: bytes) -> SceneImage:
    """The image, which is opened where it was not among the last ones of this thread."""
    images: OrderedDict[bytes, SceneImage] | None = getattr(_open, "images", None)
    if images is None:
        images = _open.images = OrderedDict()
    if again not in images:
        while len(images) >= OPEN_AT_ONCE:
            images.popitem(last=False)[1].close()
        images[again] = pickle.loads(again)
    images.move_to_end(again)
    return images[again]
