"""Tie points of two images: features matched with the help of the sensor models."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from amers.services.conventions import MAX_ERROR_SIGMAS
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.matching.ground_features import Features
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, BoolArray, FloatImage, IntArray

_MIN_PAIRS = 8
"""Fewest matches of two images from which their relative error is estimated."""
_PILOTS = 1000
"""Features that find the relative error and the heights at first: they are compared over the whole
height range of the models, which takes most of the time."""
_CLEAR_PILOTS = 40
"""Matches of the pilots that are enough; with fewer, all features search as they did."""


@dataclass(frozen=True)
class MatchOptions:
    """How features are matched.

    Attributes:
        max_ratio: largest ratio of the descriptor distances to the best and the second best candidate.
        tolerance_px: largest distance of matches from their common offset across the epipolar lines,
            pixels of the ground sampling of the features.
        cell_px: side of the squares of the second image in which features are compared, pixels.
    """

    max_ratio: float = 0.75
    tolerance_px: float = 1.5
    cell_px: int = 256


@dataclass(frozen=True)
class Matches:
    """k details that two images show.

    Attributes:
        rows: (k, 2) of the features of both.
        similarity: (k,) scalar product of the descriptors.
    """

    rows: IntArray
    similarity: Array

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, rows: BoolArray | IntArray) -> "Matches":
        """The matches of some rows."""
        return Matches(self.rows[rows], self.similarity[rows])


def match_features(
    one: Scene,
    other: Scene,
    features: Features,
    others: Features,
    *,
    gsd_m: float,
    options: MatchOptions = MatchOptions(),
) -> Matches:
    """The features of two images that show the same detail.

    Features are compared where the models allow a match: near the epipolar line, at any height of the
    models. The matches share one offset across that line, which is the relative error of the two models.
    A second round uses this offset and the heights of the first round, and resolves ambiguous features.

    Args:
        one, other: the two images with their models.
        features, others: of the two images.
        gsd_m: ground sampling in which the features were found, metres.
        options: thresholds.
    """
    pilots = np.unique(np.linspace(0, len(features) - 1, _PILOTS).astype(np.int64))
    pair = _Pair(one, other, features, others, gsd_m, options)
    found, band = _agreeing(pair, pilots, pair.widest_band())
    if len(found) < _CLEAR_PILOTS:
        found, band = _agreeing(pair, np.arange(len(features)), pair.widest_band())
    if band is None:
        return found
    return _agreeing(pair, np.arange(len(features)), band)[0]


@dataclass(frozen=True)
class _Pair:
    """Two images whose features are compared; see `match_features`."""

    one: Scene
    other: Scene
    features: Features
    others: Features
    gsd_m: float
    options: MatchOptions

    @cached_property
    def other_gsd_m(self) -> float:
        return scene_gsd_m(self.other)

    @property
    def tolerance_px(self) -> float:
        """In pixels of the other image."""
        return self.options.tolerance_px * self.gsd_m / self.other_gsd_m

    @property
    def gate_px(self) -> float:
        """Largest relative error of the two models, pixels of the other image."""
        return (
            MAX_ERROR_SIGMAS * float(np.hypot(self.one.sigma_m, self.other.sigma_m)) / self.other_gsd_m
        )

    @cached_property
    def directions(self) -> tuple[FloatImage, FloatImage]:
        return self.features.directions(), self.others.directions()

    @property
    def heights_m(self) -> tuple[float, float]:
        """Heights that both models can show."""
        low = max(self.one.model.height_range_m[0], self.other.model.height_range_m[0])
        return low, min(self.one.model.height_range_m[1], self.other.model.height_range_m[1])

    def widest_band(self) -> "_Band":
        """All that the models allow."""
        return _Band(*self.heights_m, 0.0, self.gate_px, self.gate_px)


def _agreeing(pair: _Pair, rows: IntArray, band: "_Band") -> tuple[Matches, "_Band | None"]:
    """Matches within a band of some features that agree, and the narrower band around them, if any."""
    height_m = (band.low_m + band.high_m) / 2.0
    lines = _epipolar_lines(pair.one.model, pair.other.model, pair.features.line_sample[rows], height_m)
    found = _descriptor_pairs(pair, rows, lines, band)
    across, along_m = lines.coordinates(found.rows[:, 0], pair.others.line_sample[found.rows[:, 1]])
    inliers = _densest_window(across, pair.tolerance_px)
    agreeing = found.take(inliers)
    agreeing = replace(agreeing, rows=np.column_stack([rows[agreeing.rows[:, 0]], agreeing.rows[:, 1]]))
    if inliers.sum() < _MIN_PAIRS:
        return agreeing, None
    heights = height_m + np.percentile(along_m[inliers], [2.0, 98.0])
    margin_m = 10.0 + 0.5 * (heights[1] - heights[0])
    low, high = pair.heights_m
    return agreeing, _Band(
        low_m=max(low, heights[0] - margin_m),
        high_m=min(high, heights[1] + margin_m),
        across_px=float(np.median(across[inliers])),
        gate_px=2.0 * pair.tolerance_px,
        end_px=pair.gate_px,
    )


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


_NO_PARALLAX = 1e-3
"""Displacement of a detail by a metre of height, pixels, below which its image has no epipolar line."""


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
    per_metre = other.project(above) - expected
    # Two ortho-images have no parallax: any direction is as good, and details lie beyond its ends.
    per_metre[np.hypot(*per_metre.T) < _NO_PARALLAX] = 0.0, _NO_PARALLAX
    return _EpipolarLines(expected, per_metre)


def _descriptor_pairs(pair: _Pair, rows: IntArray, lines: _EpipolarLines, band: _Band) -> Matches:
    """Mutually best descriptors within the band, by cells of the second image; `rows` of the lines."""
    half_m = (band.high_m - band.low_m) / 2.0
    mine_all, theirs_all = pair.directions
    positions, cell_px = pair.others.line_sample, pair.options.cell_px
    usable: BoolArray = np.asarray(np.isfinite(lines.expected).all(axis=1))
    cell = np.floor(np.where(usable[:, None], lines.expected, 0.0) / cell_px).astype(np.int64)
    by_line = np.argsort(positions[:, 0], kind="stable")
    ordered = positions[by_line, 0]
    reach_px = half_m * np.abs(lines.per_metre) + band.end_px + band.gate_px + abs(band.across_px)
    found = [Matches(np.empty((0, 2), dtype=np.int64), np.empty(0))]
    for key in np.unique(cell[usable], axis=0):
        mine = np.flatnonzero(usable & np.all(cell == key, axis=1))
        low = (lines.expected[mine] - reach_px[mine]).min(axis=0)
        high = (lines.expected[mine] + reach_px[mine]).max(axis=0)
        first, last = np.searchsorted(ordered, low[0]), np.searchsorted(ordered, high[0], "right")
        theirs = np.sort(by_line[first:last])
        sample = positions[theirs, 1]
        theirs = theirs[(sample >= low[1]) & (sample <= high[1])]
        if len(theirs) < 2:
            continue
        across, along_m = lines.coordinates(mine[:, None], positions[theirs][None, :])
        end_m = band.end_px / np.linalg.norm(lines.per_metre[mine], axis=1)[:, None]
        possible = (np.abs(across - band.across_px) <= band.gate_px) & (
            np.abs(along_m) <= half_m + end_m
        )
        similarity = np.where(possible, mine_all[rows[mine]] @ theirs_all[theirs].T, -1.0)
        best = _mutual_best(similarity, pair.options.max_ratio)
        found.append(
            Matches(np.column_stack([mine[best.rows[:, 0]], theirs[best.rows[:, 1]]]), best.similarity)
        )
    return Matches(
        np.concatenate([part.rows for part in found]),
        np.concatenate([part.similarity for part in found]),
    )


def _mutual_best(similarity: Array, max_ratio: float) -> Matches:
    """Rows and columns that are each other's best, clearly above the row's second best.

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
    return Matches(np.column_stack([matched, best[matched]]), top[matched])


def _densest_window(values: Array, tolerance: float) -> BoolArray:
    """Which values lie in the window of half width `tolerance` that contains most of them."""
    if len(values) == 0:
        return np.zeros(0, dtype=bool)
    ordered = np.sort(values)
    count = np.searchsorted(ordered, ordered + 2.0 * tolerance, side="right") - np.arange(len(values))
    first = int(count.argmax())
    centre = np.median(ordered[first : first + count[first]])
    return np.less_equal(np.abs(values - centre), tolerance)
