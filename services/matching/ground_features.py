"""Features of images: details with descriptors, detected in the geometry of the ground."""

from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np
import numpy.typing as npt

from amers.services.geodesy import east_north_up, lon_lat_h_from_east_north_up
from amers.services.imagery.gaps import bridged, filled
from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m
from amers.services.imagery.source import chip_positions, render_chip
from amers.services.types import Array, FloatImage

_LARGEST_PX = 1100
"""Largest side of the parts of the ground in which features are found."""
_MARGIN_PX = 32
"""Ground around a part that descriptors may reach into."""
_BORDER_NODES = 5
"""Positions along each side of an image that bound its ground."""
_MIN_PER_PART = 50
_DESCRIPTOR_SCALE = 255.0


@dataclass(frozen=True)
class FeatureOptions:
    """How features are found.

    Attributes:
        per_image: number of features aimed at in an image, the strongest of each part of the ground.
        per_megapixel: largest number of features per million pixels of the image, for small ones.
        reduced_px: pixels that an image keeps at least when it is reduced for its features.
        most_reduced: largest reduction. The models that such features adjust are right to a pixel of the
            image or two, within the reach of the search on chips.
        largest_px: largest diameter of a feature; larger ones cannot be located precisely.
        sigma_px: of the position of a feature, one standard deviation a coordinate, pixels of the ground
            sampling in which it was found.
    """

    per_image: int = 12_000
    per_megapixel: int = 10_000
    reduced_px: int = 250_000
    most_reduced: float = 4.0
    largest_px: float = 5.0
    sigma_px: float = 0.3

    def for_chips(self, coarsest_gsd_m: float, fine_gsd_m: float) -> Self:
        """Options by which features are no coarser than the fine chips of the points that come of them.

        Details of 1.4 times the sampling of the chips have heights that err by 0.8 to 0.9 m, those of
        their own sampling by 0.5 to 0.6 m; 0.6 to 0.7 m is stated (`test_new_points.py`, three draws).

        Args:
            coarsest_gsd_m: ground sampling of the coarsest image of the block.
            fine_gsd_m: that of the fine chips.
        """
        most = min(self.most_reduced, max(1.0, fine_gsd_m / coarsest_gsd_m))
        return replace(self, most_reduced=most)


@dataclass(frozen=True)
class GroundPatches:
    """Squares of the ground in which features are found.

    Attributes:
        centres: (n, 3) lon, lat, h.
        size_px: (2,) columns and rows, pixels of the ground sampling.
        margin_px: ground around a square that descriptors may reach into.
    """

    centres: Array
    size_px: Array
    margin_px: int = _MARGIN_PX


@dataclass(frozen=True)
class Features:
    """n features of one image.

    Attributes:
        line_sample: (n, 2) pixels of the image.
        descriptor: (n, 128) uint8, the square roots of SIFT's descriptors.
    """

    line_sample: Array
    descriptor: npt.NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.line_sample)

    def directions(self) -> FloatImage:
        """Descriptors (n, 128) of unit length; their scalar product is their similarity.

        The distance of the square roots is the Hellinger distance of the histograms. Source:
        Arandjelovic and Zisserman (2012), Three things everyone should know to improve object retrieval.
        """
        values = self.descriptor.astype(np.float32)
        return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-6))


def find_features(
    scene: Scene,
    gsd_m: float,
    options: FeatureOptions = FeatureOptions(),
    patches: GroundPatches | None = None,
) -> Features:
    """SIFT features of an image, found on the ground north up: the strongest of every part.

    All images show the ground at the same sampling and orientation, so that descriptors need not be
    indifferent to rotation, which makes them tell more. The memory needed is that of one part.

    Args:
        scene: the image and its model.
        gsd_m: ground sampling, metres; that of the coarsest image of a block, or a larger one.
        options: number and size of features.
        patches: parts of the ground that are searched; None searches all that the image shows.
    """
    patches = patches or _covering(scene, gsd_m)
    lines, samples = scene.image.shape
    ratio = gsd_m / scene_gsd_m(scene)
    searched_px = min(lines * samples / ratio**2, len(patches.centres) * float(patches.size_px.prod()))
    per_pixel = min(options.per_megapixel / 1e6 * ratio**2, options.per_image / max(searched_px, 1.0))
    positions, descriptors = [np.empty((0, 2))], [np.empty((0, 128), dtype=np.uint8)]
    side = int(np.ceil(patches.size_px.max())) + 2 * patches.margin_px | 1
    for centre in patches.centres:
        tile = render_chip(scene.image, scene.model, centre, gsd_m, side)
        column_row, descriptor = _tile_features(tile, per_pixel, options.largest_px)
        inside = (np.abs(column_row - side // 2) <= patches.size_px / 2.0).all(axis=1)
        if inside.any():
            in_image = chip_positions(scene.model, centre, gsd_m, side)
            positions.append(_interpolated(in_image, column_row[inside]))
            descriptors.append(descriptor[inside])
    return Features(np.concatenate(positions), np.concatenate(descriptors))


def _covering(scene: Scene, gsd_m: float) -> GroundPatches:
    """Squares that cover the ground of an image."""
    centre = scene_centre(scene)
    lines, samples = (np.linspace(-0.5, n - 0.5, _BORDER_NODES) for n in scene.image.shape)
    border = np.stack(np.meshgrid(lines, samples), axis=-1).reshape(-1, 2)
    ground = scene.model.locate(border, np.full(len(border), centre[2]))
    east_north = east_north_up(ground[np.isfinite(ground).all(axis=1)], centre)[:, :2]
    low, extent = east_north.min(axis=0), np.ptp(east_north, axis=0)
    count = np.ceil(extent / (gsd_m * _LARGEST_PX)).astype(int)
    size_m = extent / count
    parts = np.stack(np.meshgrid(*(np.arange(n) for n in count)), axis=-1).reshape(-1, 2)
    enu = np.zeros((len(parts), 3))
    enu[:, :2] = low + (parts + 0.5) * size_m
    return GroundPatches(lon_lat_h_from_east_north_up(enu, centre), size_m / gsd_m)


def _tile_features(
    pixels: FloatImage, per_pixel: float, largest_px: float
) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Positions (n, 2) column and row, and descriptors (n, 128), away from areas lost or saturated."""
    none = np.empty((0, 2)), np.empty((0, 128), dtype=np.uint8)
    valid = np.isfinite(pixels)
    if not valid.any():
        return none
    low, high = np.percentile(pixels[valid], [0.5, 99.5])
    mask = cv2.erode(np.isfinite(bridged(pixels)).astype(np.uint8) * 255, np.ones((9, 9), np.uint8))
    count = int(per_pixel * np.count_nonzero(mask))
    sift = cv2.SIFT.create(nfeatures=max(count, _MIN_PER_PART), contrastThreshold=0.01)
    stretched = (filled(pixels) - low) / max(high - low, 1e-6) * 255.0
    image8 = np.clip(stretched, 0.0, 255.0).astype(np.uint8)
    sharp = [keypoint for keypoint in sift.detect(image8, mask) if keypoint.size <= largest_px]
    for keypoint in sharp:
        keypoint.angle = 0.0
    keypoints, descriptor = sift.compute(image8, sharp)
    if descriptor is None or not keypoints:
        return none
    column_row = np.array(cv2.KeyPoint.convert(keypoints), dtype=np.float64)
    # SIFT returns a detail with several orientations several times: only the first counts.
    _, first = np.unique(column_row, axis=0, return_index=True)
    values = descriptor[first].astype(np.float64)
    share = values / np.maximum(values.sum(axis=1, keepdims=True), 1e-9)
    return column_row[first], np.rint(np.sqrt(share) * _DESCRIPTOR_SCALE).astype(np.uint8)


def _interpolated(grid: Array, column_row: Array) -> Array:
    """Values (n, 2) of a grid (rows, columns, 2) between its nodes, bilinear."""
    first = np.clip(np.floor(column_row).astype(np.int64), 0, np.array(grid.shape[1::-1]) - 2)
    (u, v), (column, row) = (column_row - first).T, first.T
    u, v = u[:, None], v[:, None]
    top = (1.0 - u) * grid[row, column] + u * grid[row, column + 1]
    bottom = (1.0 - u) * grid[row + 1, column] + u * grid[row + 1, column + 1]
    return np.asarray((1.0 - v) * top + v * bottom)
