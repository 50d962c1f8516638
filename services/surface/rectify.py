"""Affine epipolar rectification: image pairs resampled so that the same ground is on one row.

Over a tile of some thousand pixels the rows of two pushbroom images differ from those of affine cameras
by some thousandths of a pixel, so that one affine map an image is enough. Source: de Franchis and others
(2014), An automatic and modular stereo pipeline for pushbroom images.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from amers.services.imagery.gaps import filled
from amers.services.imagery.source import ImageSource, Window, low_pass
from amers.services.map_grid import MapGrid
from amers.services.sensors.base import SensorModel
from amers.services.surface.match import Reason, Reasons
from amers.services.types import Array, BoolArray, FloatImage

_GROUND_NODES = 9
"""Nodes of the tile along each axis, at which the models are evaluated."""
_FEWEST_NODES = 2 * _GROUND_NODES
LEVELS = 3
"""Heights between the lowest and the highest one, at which the models are evaluated."""
_WHOLE = 0.99
"""Share of valid pixels under a rectified one from which it is valid; rounding leaves less than one."""
_MARGIN_PX = 8
"""Pixels read beyond what is resampled, for the kernel and the low-pass."""


@dataclass(frozen=True)
class Rectification:
    """Two images on common rows.

    A detail at column x of the first image and column x - d of the second one has the disparity d.

    Attributes:
        first, second: (2, 3) column and row of the rectified image from 1, sample and line of the image.
        shape: rows and columns of both.
        nodes: (k, 3) column and row of the first image, and disparity, of ground positions.
        xy_h: (k, 3) these positions: map coordinates and height.
        residual_px: largest distance of these positions from a common row.
    """

    first: Array
    second: Array
    shape: tuple[int, int]
    nodes: Array
    xy_h: Array
    residual_px: float

    @property
    def disparities(self) -> tuple[int, int]:
        """First disparity of the ground between the heights of the tile, and their number."""
        low, high = self.nodes[:, 2].min(), self.nodes[:, 2].max()
        first = int(np.floor(low)) - 2
        return first, int(np.ceil(high)) + 3 - first


def rectify(
    first: SensorModel, second: SensorModel, tile: MapGrid, heights_m: tuple[float, float], ratio: float
) -> Rectification | None:
    """The rectification of two images over a tile of the ground; None where a model does not reach it.

    Args:
        first, second: models of the images.
        tile: the ground, a part of the map.
        heights_m: lowest and highest ground there, above the ellipsoid.
        ratio: pixels of the first image per rectified pixel.
    """
    lines, samples = tile.shape
    axes = [np.linspace(-0.5, n - 0.5, _GROUND_NODES) for n in (lines, samples)]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    xy, lon_lat = tile.xy(at), tile.lon_lat(at)
    levels_m = np.linspace(*heights_m, LEVELS)
    ground = np.concatenate([np.column_stack([lon_lat, np.full(len(at), h)]) for h in levels_m])
    xy_h = np.concatenate([np.column_stack([xy, np.full(len(at), h)]) for h in levels_m])
    a, b = first.project(ground)[:, ::-1], second.project(ground)[:, ::-1]
    # Models end somewhere, and a tile may reach farther.
    reached = np.isfinite(a[:, 0] + b[:, 0]).reshape(LEVELS, -1).all(axis=0)
    if reached.sum() < _FEWEST_NODES:
        return None
    everywhere = np.tile(reached, LEVELS)
    a, b, xy_h, at = a[everywhere], b[everywhere], xy_h[everywhere], at[reached]
    centre = np.concatenate([a.mean(axis=0), b.mean(axis=0)])
    normal = np.linalg.svd(np.column_stack([a, b]) - centre, full_matrices=False)[2][-1]
    scale = 1.0 / (np.hypot(*normal[:2]) * ratio)
    across_a, across_b, offset = normal[:2] * scale, -normal[2:] * scale, -(normal @ centre) * scale
    if across_a[1] < 0.0:
        across_a, across_b, offset = -across_a, -across_b, -offset
    along_a = np.array([across_a[1], -across_a[0]])
    rows_a, rows_b, columns_a = a @ across_a + offset, b @ across_b, a @ along_a
    middle = slice(len(at), 2 * len(at))
    b_and_one = np.column_stack([b, np.ones(len(b))])
    along_b = np.linalg.lstsq(b_and_one[middle], columns_a[middle])[0]
    columns_b = b_and_one @ along_b
    low = np.floor([columns_a.min(), rows_a.min()]) - 1.0
    size = np.ceil([columns_a.max(), rows_a.max()]) + 2.0 - low
    return Rectification(
        np.array([[-low[0], *along_a], [offset - low[1], *across_a]]),
        np.array([[along_b[2] - low[0], *along_b[:2]], [-low[1], *across_b]]),
        (int(size[1]), int(size[0])),
        np.column_stack([columns_a - low[0], rows_a - low[1], columns_a - columns_b]),
        xy_h,
        float(np.abs(rows_a - rows_b).max()),
    )


def resampled(image: ImageSource, affine: Array, shape: tuple[int, int]) -> tuple[FloatImage, Reasons]:
    """A rectified image, and why pixels show nothing; `Reason.FOUND` for those that do.

    Args:
        image: to be read where the rectified one needs it.
        affine: (2, 3) column and row from 1, sample and line.
        shape: rows and columns.
    """
    inverse = np.linalg.inv(affine[:, 1:])
    corners = np.array([[0, 0], [0, shape[0]], [shape[1], 0], [shape[1], shape[0]]], dtype=np.float64)
    samples_lines = (corners - affine[:, 0]) @ inverse.T
    ratio = float(np.sqrt(abs(np.linalg.det(inverse))))
    margin = _MARGIN_PX * max(1.0, ratio)
    low = np.maximum(np.floor(samples_lines.min(axis=0) - margin), 0.0).astype(int)
    last = np.array(image.shape[::-1])
    high = np.minimum(np.ceil(samples_lines.max(axis=0) + margin), last).astype(int)
    if (high <= low).any():
        return np.zeros(shape, dtype=np.float32), np.full(shape, Reason.OUTSIDE, dtype=np.uint8)
    pixels = image.read(Window(int(low[1]), int(low[0]), *(int(n) for n in (high - low)[::-1])))
    smooth = low_pass(filled(pixels), ratio) if ratio > 1.0 else filled(pixels)
    matrix = np.column_stack([affine[:, 1:], affine[:, 0] + affine[:, 1:] @ low])
    size = (shape[1], shape[0])
    warped = cv2.warpAffine(smooth, matrix, size, flags=cv2.INTER_CUBIC)

    def share(where: BoolArray) -> FloatImage:
        return np.asarray(cv2.warpAffine(where.astype(np.float32), matrix, size, flags=cv2.INTER_LINEAR))

    unseen = np.where(share(np.isfinite(pixels)) > _WHOLE, Reason.FOUND, Reason.OUTSIDE).astype(np.uint8)
    for reason, gap in ((Reason.NO_DATA, np.isnan(pixels)), (Reason.SATURATED, np.isposinf(pixels))):
        if gap.any():
            unseen[(unseen != Reason.FOUND) & (share(gap) > 1.0 - _WHOLE)] = reason
    return np.asarray(warped, dtype=np.float32), unseen
