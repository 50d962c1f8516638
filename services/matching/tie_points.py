"""Tie points: details seen in several images, matched with the help of the sensor models."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from services.conventions import MAX_ERROR_SIGMAS
from services.imagery.gaps import bridged, filled
from services.imagery.scene import Scene, scene_gsd_m
from services.imagery.source import ImageSource, Window
from services.sensors.base import SensorModel
from services.types import Array, BoolArray, FloatImage, IntArray, Observations, Progress

_TILE_PX = 2048
_TILE_MARGIN_PX = 32
_MIN_PAIRS = 8
"""Fewest matches of two images from which their relative error is estimated."""


@dataclass(frozen=True)
class FeatureOptions:
    """How tie points are found.

    Attributes:
        per_image: number of features aimed at in an image, the strongest of each tile.
        per_megapixel: largest number of features per million pixels; it limits small images.
        largest_px: largest diameter of a feature; larger ones cannot be located precisely.
        max_ratio: largest ratio of the descriptor distances to the best and the second best candidate.
        tolerance_px: largest distance of matches from their common offset across the epipolar lines.
        sigma_px: of the position of a feature, one standard deviation a coordinate.
        cell_px: side of the squares of the second image in which features are compared, pixels.
    """

    per_image: int = 12_000
    per_megapixel: int = 10_000
    largest_px: float = 5.0
    max_ratio: float = 0.75
    tolerance_px: float = 1.5
    sigma_px: float = 0.3
    cell_px: int = 256


@dataclass(frozen=True)
class Features:
    """n features of one image.

    Attributes:
        line_sample: (n, 2) pixels.
        descriptor: (n, 128) float32.
    """

    line_sample: Array
    descriptor: FloatImage


def find_tie_points(
    scenes: Sequence[Scene], options: FeatureOptions, progress: Progress
) -> Observations:
    """Image positions of details that two images or more show.

    Args:
        scenes: images with their models as delivered.
        options: thresholds.
        progress: receives the fraction done.

    Returns:
        Observations of tie points; `point` counts from 0.
    """
    features = []
    for number, scene in enumerate(scenes):
        progress(0.6 * number / len(scenes), f"features of {scene.acquisition.image_id}")
        features.append(find_features(scene.image, options))
    pairs = list(combinations(range(len(scenes)), 2))
    links = []
    for number, (one, other) in enumerate(pairs):
        progress(0.6 + 0.4 * number / len(pairs), f"matching pair {number + 1} of {len(pairs)}")
        rows = match_features(scenes[one], scenes[other], features[one], features[other], options)
        links.append((one, other, rows))
    return _tracks(features, links, options.sigma_px)


def find_features(image: ImageSource, options: FeatureOptions) -> Features:
    """SIFT features of an image: the strongest of every tile, in proportion to the area of the tile."""
    positions, descriptors = [], []
    per_pixel = min(options.per_megapixel / 1e6, options.per_image / (image.shape[0] * image.shape[1]))
    for line in range(0, image.shape[0], _TILE_PX):
        for sample in range(0, image.shape[1], _TILE_PX):
            lines = min(_TILE_PX, image.shape[0] - line)
            samples = min(_TILE_PX, image.shape[1] - sample)
            window = Window(
                line - _TILE_MARGIN_PX,
                sample - _TILE_MARGIN_PX,
                lines + 2 * _TILE_MARGIN_PX,
                samples + 2 * _TILE_MARGIN_PX,
            )
            count = int(per_pixel * lines * samples)
            features = _tile_features(image.read(window), count, options.largest_px)
            in_tile = features.line_sample - _TILE_MARGIN_PX
            inside = ((in_tile >= -0.5) & (in_tile < [lines - 0.5, samples - 0.5])).all(axis=1)
            positions.append(in_tile[inside] + [line, sample])
            descriptors.append(features.descriptor[inside])
    return Features(np.concatenate(positions), np.concatenate(descriptors))


def _tile_features(pixels: FloatImage, count: int, largest_px: float) -> Features:
    """SIFT features of one tile, away from areas without data and saturated ones."""
    valid = np.isfinite(pixels)
    if not valid.any():
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float32))
    low, high = np.percentile(pixels[valid], [0.5, 99.5])
    mask = cv2.erode(np.isfinite(bridged(pixels)).astype(np.uint8) * 255, np.ones((9, 9), np.uint8))
    sift = cv2.SIFT.create(nfeatures=max(count, 50), contrastThreshold=0.01)
    stretched = (filled(pixels) - low) / max(high - low, 1e-6) * 255.0
    image8 = np.clip(stretched, 0.0, 255.0).astype(np.uint8)
    sharp = [keypoint for keypoint in sift.detect(image8, mask) if keypoint.size <= largest_px]
    keypoints, descriptor = sift.compute(image8, sharp)
    if descriptor is None:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float32))
    sample_line = np.array(cv2.KeyPoint.convert(keypoints), dtype=np.float64)
    # SIFT returns a detail with several orientations several times: only the first counts.
    _, first = np.unique(sample_line, axis=0, return_index=True)
    return Features(sample_line[first][:, ::-1], _root_sift(np.asarray(descriptor[first], np.float32)))


def _root_sift(descriptor: FloatImage) -> FloatImage:
    """Descriptors whose Euclidean distance is the Hellinger distance.

    Source: Arandjelovic and Zisserman (2012), Three things everyone should know: RootSIFT.
    """
    total = descriptor.sum(axis=1, keepdims=True) + 1e-9
    return np.asarray(np.sqrt(descriptor / total), dtype=np.float32)


def match_features(
    one: Scene, other: Scene, features: Features, others: Features, options: FeatureOptions
) -> IntArray:
    """Pairs of features of two images that show the same detail.

    Features are compared where the models allow a match: near the epipolar line, at any height of the
    models. The matches share one offset across that line, which is the relative error of the two models.
    A second round uses this offset and the heights of the first round, and resolves ambiguous features.

    Args:
        one, other: the two images with their models.
        features, others: of the two images.
        options: thresholds.

    Returns:
        (k, 2) rows of both feature sets.
    """
    low = max(one.model.height_range_m[0], other.model.height_range_m[0])
    high = min(one.model.height_range_m[1], other.model.height_range_m[1])
    gate_px = MAX_ERROR_SIGMAS * float(np.hypot(one.sigma_m, other.sigma_m)) / scene_gsd_m(other)
    band = _Band(low, high, 0.0, gate_px, gate_px)
    pairs = np.empty((0, 2), dtype=np.int64)
    for _ in range(2):
        height_m = (band.low_m + band.high_m) / 2.0
        lines = _epipolar_lines(one.model, other.model, features.line_sample, height_m)
        pairs = _descriptor_pairs(features, others, lines, band, options)
        across, along_m = lines.coordinates(pairs[:, 0], others.line_sample[pairs[:, 1]])
        inliers = _densest_window(across, options.tolerance_px)
        if inliers.sum() < _MIN_PAIRS:
            return pairs[inliers]
        heights = height_m + np.percentile(along_m[inliers], [2.0, 98.0])
        margin_m = 10.0 + 0.5 * (heights[1] - heights[0])
        band = _Band(
            low_m=max(low, heights[0] - margin_m),
            high_m=min(high, heights[1] + margin_m),
            across_px=float(np.median(across[inliers])),
            gate_px=2.0 * options.tolerance_px,
            end_px=gate_px,
        )
        pairs = pairs[inliers]
    return pairs


@dataclass(frozen=True)
class _Band:
    """The part of the other image that may show a feature, relative to its epipolar line.

    Attributes:
        low_m, high_m: heights at the ends of the line.
        across_px: offset of the band across the line.
        gate_px: half width of the band.
        end_px: extension of the band beyond the ends of the line.
    """

    low_m: float
    high_m: float
    across_px: float
    gate_px: float
    end_px: float


@dataclass(frozen=True)
class _EpipolarLines:
    """Epipolar lines in one image of n details of another.

    Attributes:
        expected: (n, 2) positions at the reference height, pixels.
        per_metre: (n, 2) derivative of the positions by the height, pixels per metre.
    """

    expected: Array
    per_metre: Array

    def coordinates(self, rows: IntArray, line_sample: Array) -> tuple[Array, Array]:
        """Distance across the lines in pixels and height above the reference in metres of positions.

        Args:
            rows: (...) of the lines.
            line_sample: (..., 2) positions, broadcast against the rows.
        """
        offset = line_sample - self.expected[rows]
        direction = self.per_metre[rows]
        length = np.linalg.norm(direction, axis=-1)
        across = (offset[..., 0] * direction[..., 1] - offset[..., 1] * direction[..., 0]) / length
        return across, (offset * direction).sum(axis=-1) / length**2


def _epipolar_lines(
    one: SensorModel, other: SensorModel, line_sample: Array, height_m: float
) -> _EpipolarLines:
    ground = one.locate(line_sample, np.full(len(line_sample), height_m))
    above = one.locate(line_sample, np.full(len(line_sample), height_m + 1.0))
    expected = other.project(ground)
    return _EpipolarLines(expected, other.project(above) - expected)


def _descriptor_pairs(
    features: Features,
    others: Features,
    lines: _EpipolarLines,
    band: _Band,
    options: FeatureOptions,
) -> IntArray:
    """Rows (k, 2) of mutually best descriptors within the band, by cells of the second image."""
    half_m = (band.high_m - band.low_m) / 2.0
    usable: BoolArray = np.asarray(np.isfinite(lines.expected).all(axis=1))
    cell = np.floor(np.where(usable[:, None], lines.expected, 0.0) / options.cell_px).astype(np.int64)
    reach_px = half_m * np.abs(lines.per_metre) + band.end_px + band.gate_px + abs(band.across_px)
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for key in np.unique(cell[usable], axis=0):
        mine = np.flatnonzero(usable & np.all(cell == key, axis=1))
        low = (lines.expected[mine] - reach_px[mine]).min(axis=0)
        high = (lines.expected[mine] + reach_px[mine]).max(axis=0)
        theirs = np.flatnonzero(
            np.all((others.line_sample >= low) & (others.line_sample <= high), axis=1)
        )
        if len(theirs) < 2:
            continue
        across, along_m = lines.coordinates(mine[:, None], others.line_sample[theirs][None, :])
        end_m = band.end_px / np.linalg.norm(lines.per_metre[mine], axis=1)[:, None]
        possible = (np.abs(across - band.across_px) <= band.gate_px) & (
            np.abs(along_m) <= half_m + end_m
        )
        similarity = np.where(possible, features.descriptor[mine] @ others.descriptor[theirs].T, -1.0)
        matched = _mutual_best(similarity, options.max_ratio)
        pairs.append(np.column_stack([mine[matched[:, 0]], theirs[matched[:, 1]]]))
    return np.concatenate(pairs)


def _mutual_best(similarity: Array, max_ratio: float) -> IntArray:
    """Pairs (k, 2) of rows and columns that are each other's best, clearly above the row's second best.

    Args:
        similarity: (a, b) scalar products of unit descriptors; -1 where a pair is impossible.
        max_ratio: largest ratio of the distances to the best and the second best column.
    """
    rows = np.arange(len(similarity))
    best = similarity.argmax(axis=1)
    top = similarity[rows, best]
    mutual = similarity.argmax(axis=0)[best] == rows
    similarity[rows, best] = -1.0
    second = similarity.max(axis=1)
    # The squared distance of unit descriptors is 2 (1 - similarity).
    clear = (top > 0.5) & ((1.0 - top) <= max_ratio**2 * (1.0 - np.maximum(second, 0.5)))
    matched = np.flatnonzero(mutual & clear)
    return np.column_stack([matched, best[matched]])


def _densest_window(values: Array, tolerance: float) -> BoolArray:
    """Which values lie in the window of half width `tolerance` that contains most of them."""
    if len(values) == 0:
        return np.zeros(0, dtype=bool)
    ordered = np.sort(values)
    count = np.searchsorted(ordered, ordered + 2.0 * tolerance, side="right") - np.arange(len(values))
    first = int(count.argmax())
    centre = np.median(ordered[first : first + count[first]])
    return np.less_equal(np.abs(values - centre), tolerance)


def _tracks(
    features: Sequence[Features], links: Sequence[tuple[int, int, IntArray]], sigma_px: float
) -> Observations:
    """Tie points from connected matches; tracks with two features of one image are dropped.

    Args:
        features: of every image.
        links: two images and the (k, 2) rows of their matched features.
        sigma_px: of a feature.
    """
    start = np.concatenate([[0], np.cumsum([len(f.line_sample) for f in features])])
    image = np.repeat(np.arange(len(features)), np.diff(start))
    line_sample = np.concatenate([f.line_sample for f in features])
    pairs = np.concatenate([rows + [start[one], start[other]] for one, other, rows in links])
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(start[-1], start[-1]))
    _, label = connected_components(graph, directed=False)
    size = np.bincount(label)
    images = np.bincount(np.unique(np.column_stack([label, image]), axis=0)[:, 0], minlength=len(size))
    rows = np.flatnonzero(((size >= 2) & (size == images))[label])
    rows = rows[np.argsort(label[rows], kind="stable")]
    _, point = np.unique(label[rows], return_inverse=True)
    return Observations(
        point.astype(np.int64), image[rows], line_sample[rows], np.full(len(rows), sigma_px)
    )
