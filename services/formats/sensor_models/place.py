"""Position of the pixels of a file in the full image, from its records and its product."""

from dataclasses import dataclass

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.raster import RasterImage
from amers.services.formats.images.siblings import Siblings
from amers.services.formats.sensor_models.product_documents import ProductTile, tile_of_product
from amers.services.formats.text_files import parse_number
from amers.services.types import Array

_ICHIPB_BYTES = 224
_ROTATION_PX = 0.01
"""Largest deviation of the corners of a chip from a rectangle along the lines of the full image."""


@dataclass(frozen=True)
class Place:
    """The place of an image in the full image: `full = first + step * (line, sample)`.

    Attributes:
        first: line and sample of the centre of its first pixel in the full image.
        step: pixels of the full image for each of its own, lines and samples; positive.
        file: that states it.
        what: the statement, such as "ICHIPB".
        decides_for: formats of models that are of the full image wherever a place is so stated. Other
            models may be in either pixels: their own range decides.
        is_certain: whether a model of another format whose range does not decide is taken to be in the
            pixels of the image; False where the image may as well be a crop with the full image's model.
    """

    first: tuple[float, float]
    step: tuple[float, float]
    file: str
    what: str
    decides_for: frozenset[str] = frozenset()
    is_certain: bool = False

    def __str__(self) -> str:
        """For people."""
        reduced = (
            "" if self.step == (1.0, 1.0) else f", in steps of {self.step[0]:g} x {self.step[1]:g} px"
        )
        return f"line {self.first[0]:g}, sample {self.first[1]:g}{reduced}"


def stated_place(image: RasterImage, siblings: Siblings, model: FilePlace | None = None) -> Place | None:
    """The place of an image in the full image; None where nothing states one.

    It is that of an ICHIPB record, else of the document of a product in tiles, else of a geotransform
    without a reference system.

    Args:
        image: opened.
        siblings: the files beside it.
        model: file of the model where it was given, beside which the document of its product may be.

    Raises:
        FormatError: a statement contradicts the image, or no RPC can follow it.
    """
    record = image.dataset.tags(ns="TRE").get("ICHIPB")
    if record is not None:
        return _ichipb_place(record, image)
    tile = tile_of_product(image.path, siblings, model)
    if tile is not None:
        return _tile_place(tile, image)
    return _geotransform_place(image)


def _ichipb_place(record: str, image: RasterImage) -> Place | None:
    """The place of a chip. Source: NGA STDI-0002, volume 1, appendix B (ICHIPB).

    Its corners count from 0.5 at the centre of the first pixel, those of the RPC from 0.
    """
    source = f"{image.path.name}: ICHIPB"
    if len(record) != _ICHIPB_BYTES:
        raise FormatError(f"{source}: {len(record)} characters found, {_ICHIPB_BYTES} expected")
    if record[:2] != "00":
        raise FormatError(
            f"{source}: XFRM_FLAG {record[:2]!r} found, 00 expected: the pixels were transformed, and "
            "the RPC of the full image does not hold for them; give the model of this image (--model)"
        )
    fields = [record[16 + 12 * i : 28 + 12 * i] for i in range(16)]
    numbers = np.array([parse_number(field, "corner", source) for field in fields])
    chip, full = numbers.reshape(2, 2, 2, 2)  # [row of corners, column of corners, line or sample]
    axes = []
    for axis in (0, 1):
        near, far = (corners.take(0, axis)[:, axis] for corners in (chip, full))
        chip_end, full_end = (corners.take(1, axis)[:, axis] for corners in (chip, full))
        skew = np.ptp([near, chip_end], axis=1).max() + np.ptp([far, full_end], axis=1).max()
        size = chip_end[0] - near[0]
        step = (full_end[0] - far[0]) / size if size > 0.0 else 0.0
        if not step > 0.0 or skew > _ROTATION_PX:
            raise FormatError(
                f"{source}: its corners are turned or mirrored in the full image, a rectangle along its "
                "lines expected: an RPC cannot follow; give the model of this image (--model)"
            )
        axes.append((far[0] - 0.5 + step * (0.5 - near[0]), step))
    (line, line_step), (sample, sample_step) = axes
    return Place(
        (float(line), float(sample)),
        (float(line_step), float(sample_step)),
        image.path.name,
        "ICHIPB",
        frozenset({"tags"}),
        is_certain=True,
    )


def _tile_place(tile: ProductTile, image: RasterImage) -> Place:
    if image.shape != tile.shape:
        raise FormatError(
            f"{image.path.name}: {image.shape[0]} x {image.shape[1]} pixels found, {tile.document.name} "
            f"states {tile.shape[0]} x {tile.shape[1]} for this tile: give the delivered tile, or the "
            "position of its first pixel in the whole image (--crop-origin LINE,SAMPLE)"
        )
    first = float(tile.first[0]), float(tile.first[1])
    vendors = frozenset({"rpb", "isd", "dimap", "rigorous"})
    return Place(first, (1.0, 1.0), tile.document.name, "tile of a product", vendors, is_certain=True)


def _geotransform_place(image: RasterImage) -> Place | None:
    t = image.dataset.transform
    if image.dataset.crs is not None or (t.b, t.d) != (0.0, 0.0) or not (t.a > 0.0 and t.e > 0.0):
        return None
    step = np.array([t.e, t.a])
    corner = np.array([t.f, t.c])
    if (t.a, t.e) == (1.0, 1.0) and (corner % 1.0 == 0.5).all():
        corner = corner + 0.5
    if (step == 1.0).all() and not corner.any():
        return None
    first: Array = corner + (step - 1.0) / 2.0
    return Place(
        (float(first[0]), float(first[1])),
        (float(step[0]), float(step[1])),
        image.path.name,
        "geotransform",
    )
