"""Masks: files that exclude pixels of an image."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.images.raster import OpenImage, RasterImage, map_grid_of, open_values
from amers.services.imagery.source import Window
from amers.services.map_grid import MapGrid
from amers.services.statements import Statement, Statements, Subject, Use
from amers.services.types import Array, FloatImage

_SAME_SHAPE = 0.01
"""Largest relative difference between the pixel size ratios of mask and image along both axes."""
_NODE_PX = 64
"""Pixels of the image between those whose place in a mask on a map is computed."""
_BORDER_NODES = 33
"""Places along each side of the image at which a mask on a map has to reach it."""
_BEYOND_PX = 1.0
"""Pixels of a mask by which it may end inside the image: the next one is taken there."""


@dataclass(frozen=True)
class MaskGrids:
    """The map grids of an image and of its mask.

    Attributes:
        image: of the image.
        mask: of the mask.
    """

    image: MapGrid
    mask: MapGrid

    def position(self, line_sample: Array) -> Array:
        """Positions (n, 2) in the mask of positions in the image (n, 2)."""
        return self.mask.line_sample(self.image.lon_lat(line_sample))

    def pixels(self, window: Window) -> tuple[Array, Array]:
        """Rows and columns (lines, samples) of the mask under the pixels of a window of the image.

        Positions are bilinear between nodes, whose maps are smooth.
        """
        axes = [_nodes(window.line, window.lines), _nodes(window.sample, window.samples)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        seen = self.position(nodes.reshape(-1, 2)).reshape(nodes.shape)
        weight = [
            _weights(first + np.arange(count, dtype=np.float64), nodes_along)
            for first, count, nodes_along in (
                (window.line, window.lines, axes[0]),
                (window.sample, window.samples, axes[1]),
            )
        ]
        row, column = (
            np.clip(np.rint(weight[0] @ seen[..., k] @ weight[1].T), 0, self.mask.shape[k] - 1)
            for k in range(2)
        )
        return row.astype(np.int64), column.astype(np.int64)


@dataclass(frozen=True)
class MaskedImage:
    """An image without the pixels that a mask excludes; an `ImageSource`.

    Attributes:
        image: the image.
        mask: nonzero where pixels are excluded; covers the same ground, with the same or other pixels.
        grids: where both lie on a map; None where the mask has the frame of the image.
    """

    image: OpenImage
    mask: RasterImage
    grids: MaskGrids | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Lines and samples."""
        return self.image.shape

    @cached_property
    def statements(self) -> Statements:
        """Of the image, and of the mask about valid pixels and its place."""
        name = self.mask.path.name
        said = Statement(name, Subject.VALIDITY, Use.USED, "mask: no data where it is not 0")
        if self.grids is not None:
            place = Statement(name, Subject.PLACE, Use.USED, "map grid of the mask")
        else:
            place = Statement(name, Subject.PLACE, Use.ASSUMED, f"the frame of {self.image.path.name}")
        return (*self.image.statements, said, place)

    def close(self) -> None:
        """Close both files."""
        self.image.close()
        self.mask.close()

    def read(self, window: Window) -> FloatImage:
        """Pixels of a window; NaN beyond the image, where nodata, and under the mask."""
        pixels = self.image.read(window)
        if self.grids is None:
            line = _mask_pixels(window.line, window.lines, self.shape[0], self.mask.shape[0])
            sample = _mask_pixels(window.sample, window.samples, self.shape[1], self.mask.shape[1])
            row, column = np.broadcast_arrays(line[:, None], sample[None, :])
        else:
            row, column = self.grids.pixels(window)
        first = int(row.min()), int(column.min())
        covered = self.mask.read(
            Window(*first, int(row.max()) - first[0] + 1, int(column.max()) - first[1] + 1)
        )
        # Nodata in a mask excludes nothing.
        excluded = np.nan_to_num(covered) != 0.0
        pixels[excluded[row - first[0], column - first[1]]] = np.nan
        return pixels


def apply_mask(image: OpenImage, mask: Path) -> MaskedImage:
    """The image without the pixels that a mask file excludes.

    A mask on a map lies where its map grid says, and has to cover an image on a map. Any other has the
    frame of the image.

    Args:
        image: opened image.
        mask: GeoTIFF, JPEG 2000 or NITF of the same ground as the image, with the same or coarser
            pixels; nonzero where pixels are excluded.

    Raises:
        FormatError: the mask cannot be read, does not cover the image, is on a map while the image is
            not, or has other proportions.
    """
    opened = open_values(mask)
    try:
        on_map, of_image = map_grid_of(opened), map_grid_of(image)
        if on_map is not None:
            if of_image is None:
                raise FormatError(
                    f"{mask}: has a map grid, and {image.path.name} has none: give a mask in the pixels "
                    "of the image, without a coordinate reference system"
                )
            grids = MaskGrids(of_image, on_map)
            _check_cover(grids, mask, image)
            return MaskedImage(image, opened, grids)
        by_line, by_sample = (n / m for n, m in zip(image.shape, opened.shape, strict=True))
        if abs(by_line / by_sample - 1.0) > _SAME_SHAPE:
            raise FormatError(
                f"{mask}: {opened.shape[0]} x {opened.shape[1]} pixels found, a mask of the same ground "
                f"as {image.path.name} with the proportions of {image.shape[0]} x {image.shape[1]} "
                "expected"
            )
    except FormatError:
        opened.close()
        raise
    return MaskedImage(image, opened)


def _check_cover(grids: MaskGrids, mask: Path, image: OpenImage) -> None:
    """Refuse a mask on a map that does not reach the whole image."""
    axes = [np.linspace(-0.5, size - 0.5, _BORDER_NODES) for size in image.shape]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    position = grids.position(places)
    last = np.array(grids.mask.shape) - 0.5 + _BEYOND_PX
    inside = ((position >= -0.5 - _BEYOND_PX) & (position <= last)).all(axis=1)
    if not inside.all():
        raise FormatError(
            f"{mask}: covers {100.0 * inside.mean():.0f} % of {image.path.name} by its map grid, a mask "
            "of all its ground expected"
        )


def _nodes(first: int, count: int) -> Array:
    """Positions along an axis from the first to the last pixel of a window, about `_NODE_PX` apart."""
    return np.linspace(first, first + count - 1, max(2, -(-count // _NODE_PX) + 1))


def _weights(position: Array, nodes: Array) -> Array:
    """Weights (n, k) of nodes (k,) in bilinear values at positions (n,)."""
    step = nodes[1] - nodes[0]
    if step == 0.0:
        return np.eye(1, len(nodes)).repeat(len(position), axis=0)
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(position[:, None] - nodes) / step))


def _mask_pixels(first: int, count: int, size: int, mask_size: int) -> np.ndarray:
    """The mask pixel that covers each of `count` image pixels, along one axis."""
    position = (np.arange(first, first + count) + 0.5) * mask_size / size
    return np.clip(np.floor(position).astype(np.int64), 0, mask_size - 1)
