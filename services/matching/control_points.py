"""Control points found in a scene: their chips, the views combined, every failure with its reason."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from services.conventions import CHIP_CENTRE
from services.geodesy import move_metres
from services.imagery.source import ImageSource, ReducedImage, image_gsd_m, low_pass, render_chip
from services.matching.chip_extent import central_square, visible_half_side
from services.matching.correlate import FOUND, CorrelationOptions, Peak, find_chip, sigma_per_coordinate
from services.matching.least_squares import covariance_from_influence
from services.matching.radiometry import cloud_mask, edges, patch_statistics
from services.matching.shadows import ShadowShift, shadow_shift
from services.matching.systematic_error import common_covariance_px2
from services.matching.view_selection import ViewDistanceScales, select_views
from services.sensors.base import SensorModel
from services.types import (
    Acquisition,
    Array,
    BoolArray,
    ChipSource,
    ControlPoints,
    FloatImage,
    IntArray,
    Progress,
    ViewMeasures,
    no_progress,
    point_chips,
)

TILE_PX = 512


@dataclass(frozen=True)
class MatchingOptions:
    """How points are searched.

    Attributes:
        max_views: how many views of a point are tried.
        agreement_px: views of a point agree when their measures are this near, in chip pixels.
        min_gradient_score: least correlation of gradients for a point that is not found by its grey
            values.
        likeness: which views are tried first.
        correlation: when a correlation peak is believed. From 0.6 on 215 of 216 peaks of four simulated
            scenes were right; views and the other points have to agree with it all the same.
    """

    max_views: int = 4
    agreement_px: float = 0.7
    min_gradient_score: float = 0.5
    likeness: ViewDistanceScales = field(default_factory=ViewDistanceScales)
    correlation: CorrelationOptions = field(default_factory=lambda: CorrelationOptions(min_score=0.6))


@dataclass(frozen=True)
class PointMatches:
    """Where n points were found.

    Attributes:
        line_sample: (n, 2) pixels of the scene; NaN where not found.
        displacement_m: (n, 2) east, north, from where the model expected them; NaN where not found.
        sigma_px: (n,) pixels of the scene.
        score: (n,) best correlation among the views; of edges where `by_gradient`.
        views: (n,) how many views agree.
        reason: (n,) "" where found; "cloud" where what was not found is bright and smooth.
        by_gradient: (n,) found by the edges of the chips only.
        common_covariance_m2: (2, 2) east, north, of what all the measures have in common: see
            `shared_error`.
        view_measures: what became of every view that was tried; its rows are those of the points.
    """

    line_sample: Array
    displacement_m: Array
    sigma_px: Array
    score: Array
    views: IntArray
    reason: np.ndarray
    by_gradient: BoolArray
    common_covariance_m2: Array
    view_measures: ViewMeasures


@dataclass(frozen=True)
class ChipSearch:
    """The scene that chips are searched in, which chips, and how far.

    Attributes:
        image: the scene, or a reduction of it.
        model: of the scene.
        acquisition: how the scene was taken.
        gsd_m: ground sampling of the chips to use, metres, as they are stored.
        radius_px: search radius, pixels of the chips after their reduction.
        reduction: factor by which the chips are reduced before the search.
    """

    image: ImageSource | ReducedImage
    model: SensorModel
    acquisition: Acquisition
    gsd_m: float
    radius_px: int
    reduction: int = 1


def match_points(
    search: ChipSearch,
    points: ControlPoints,
    chips: ChipSource,
    options: MatchingOptions,
    progress: Progress = no_progress,
) -> PointMatches:
    """Search every point around where a model expects it.

    The scene is rendered into the geometry of the chips through the model; the displacement found there
    goes back through the same model, so that relief and sampling are the chip's own.

    Args:
        image: the scene, or a reduction of it.
        model: of the scene.
        points: all of them are tried.
        chips: of the points.
        gsd_m: ground sampling of the chips to use.
        radius_px: how far to search, pixels of the chips as they are searched.
        scene: how it was taken.
        options: thresholds.
        progress: told the fraction of the points done.
        reduction: chips are degraded to so many times their ground sampling before they are searched.
    """
    n = len(points)
    image, model, scene = search.image, search.model, search.acquisition
    gsd_m, radius_px, reduction = search.gsd_m, search.radius_px, search.reduction
    level_m, whole = gsd_m * reduction, CHIP_CENTRE // reduction
    displacement_m = np.full((n, 2), np.nan)
    sigma_m = np.full(n, np.nan)
    score = np.full(n, np.nan)
    views = np.zeros(n, dtype=np.int64)
    reason = np.full(n, "", dtype="<U16")
    by_gradient = np.zeros(n, dtype=bool)
    looks = [np.empty((0, 2))] * n
    scene_gsd_m = np.full(n, np.nan)
    chosen = select_views(points, gsd_m, scene, options.max_views, options.likeness)
    shadows = [shadow_shift(image, scene, level_m) for image in points.views.images]
    offsets: list[Array] = []
    seen: list[tuple[int, int, Peak, bool]] = []
    for done, row in enumerate(_tile_order(model.project(points.lon_lat_h))):
        if done % 64 == 0:
            progress(done / n, f"searching {n} points with chips of {level_m:g} m")
        rows = chosen.row[chosen.start[row] : chosen.start[row + 1]]
        numbers = rows - points.views.start[row]
        if len(numbers) == 0:
            reason[row] = "no_chip"
            continue
        ground = points.lon_lat_h[row]
        patch = render_chip(image, model, ground, level_m, 2 * (whole + radius_px) + 1)
        if not np.isfinite(patch).any():
            reason[row] = "nodata"
            continue
        scene_gsd_m[row] = image_gsd_m(model, ground)
        stack = point_chips(points, chips, row)
        ratio = scene_gsd_m[row] / gsd_m
        looks[row] = patch_statistics(patch)
        half = visible_half_side(patch, whole, radius_px)
        patch = central_square(patch, half + radius_px)
        like_scene = [
            central_square(_as_seen(stack[number], ratio, reduction), half) for number in numbers
        ]
        moves = [shadows[image] for image in points.views.image[rows]]
        peaks, combined, by_gradient[row] = _search(patch, like_scene, moves, options)
        row_col, sigma, agreeing, reason[row] = combined
        for number, peak, agreed in zip(numbers, peaks, agreeing, strict=True):
            seen.append((row, int(number), peak, bool(agreed)))
            offsets.append((peak.row_col - row_col)[::-1] * [1.0, -1.0])
        views[row] = agreeing.sum()
        score[row] = max((p.score for p in peaks if np.isfinite(p.score)), default=np.nan)
        displacement_m[row] = row_col[1] * level_m, -row_col[0] * level_m
        sigma_m[row] = sigma * level_m
    # Where the scene ends it is not a cloud that hides a point.
    reason[cloud_mask(looks, reason == FOUND) & (reason != "nodata")] = "cloud"
    moved = move_metres(points.lon_lat_h, np.column_stack([displacement_m, np.zeros(n)]))
    found_views = np.array([np.isfinite(offset).all() for offset in offsets], dtype=bool)
    view_row = np.array([points.views.start[row] + number for row, number, *_ in seen], dtype=np.int64)
    shared_px2 = common_covariance_px2(
        scene,
        points.views,
        view_row[found_views],
        np.array(offsets).reshape(-1, 2)[found_views],
        np.array([agreed for *_, agreed in seen], dtype=bool)[found_views],
    )
    return PointMatches(
        model.project(moved),
        displacement_m,
        sigma_m / scene_gsd_m,
        score,
        views,
        reason,
        by_gradient,
        shared_px2 * level_m**2,
        _view_measures(seen),
    )


Combined = tuple[Array, float, BoolArray, str]
"""Displacement (2,), sigma, which views agree, reason."""


def _search(
    patch: FloatImage,
    chips: list[FloatImage],
    shadows: list[ShadowShift | None],
    options: MatchingOptions,
) -> tuple[list[Peak], Combined, bool]:
    """The views of a point in a patch: by grey values, else by their edges alone."""
    peaks = [
        find_chip(patch, chip, options.correlation, moved)
        for chip, moved in zip(chips, shadows, strict=True)
    ]
    combined = _combined(peaks, options.agreement_px)
    if combined[-1] == "low_score":
        outlines = edges(patch)
        correlation = replace(options.correlation, min_score=options.min_gradient_score)
        by_edges = [find_chip(outlines, edges(chip), correlation) for chip in chips]
        again = _combined(by_edges, options.agreement_px)
        if again[-1] == FOUND:
            return by_edges, again, True
    return peaks, combined, False


def _view_measures(seen: list[tuple[int, int, Peak, bool]]) -> ViewMeasures:
    """The views tried: point, number, peak, whether it agrees; by point and number."""
    seen = sorted(seen, key=lambda view: view[:2])
    return ViewMeasures(
        point=np.array([point for point, *_ in seen], dtype=np.int64),
        view=np.array([number for _, number, *_ in seen], dtype=np.int64),
        score=np.array([peak.score for *_, peak, _ in seen], dtype=np.float64),
        agreed=np.array([agreed for *_, agreed in seen], dtype=bool),
        reason=np.array([peak.reason for *_, peak, _ in seen], dtype="<U16"),
    )


def chip_pixels(chip: np.ndarray) -> FloatImage:
    """A stored chip as float32, NaN where nodata."""
    pixels = chip.astype(np.float32)
    pixels[chip == 0] = np.nan
    return pixels


def _as_seen(chip: np.ndarray, ratio: float, reduction: int) -> FloatImage:
    """A chip at the resolution of a scene whose pixels are `ratio` times larger, degraded or not.

    Every `reduction`-th pixel is kept, the centre among them.
    """
    seen = low_pass(chip_pixels(chip), max(ratio, float(reduction)))
    first = CHIP_CENTRE % reduction
    return np.ascontiguousarray(seen[first::reduction, first::reduction])


def _tile_order(line_sample: Array) -> Sequence[int]:
    """Rows in the order of the tiles of the image they fall in."""
    tile = np.nan_to_num(line_sample // TILE_PX, nan=-1.0)
    return [int(row) for row in np.lexsort((tile[:, 1], tile[:, 0]))]


def _combined(peaks: list[Peak], agreement_px: float) -> Combined:
    """One measure from the views of a point."""
    nothing, none = np.full(2, np.nan), np.zeros(len(peaks), dtype=bool)
    found = [p for p in peaks if p.reason == FOUND]
    if not found:
        best = max(peaks, key=lambda p: -1.0 if np.isnan(p.score) else p.score)
        return nothing, np.nan, none, best.reason
    row_col = np.array([p.row_col for p in found])
    near = np.hypot(*(row_col - np.median(row_col, axis=0)).T) <= agreement_px
    if 2 * near.sum() <= len(found) and len(found) > 1:
        return nothing, np.nan, none, "views_disagree"
    agreeing = none.copy()
    agreeing[np.flatnonzero([p.reason == FOUND for p in peaks])[near]] = True
    mean, sigma = weighted_mean([p for p, agreed in zip(peaks, agreeing, strict=True) if agreed])
    return mean, sigma, agreeing, FOUND


def weighted_mean(peaks: list[Peak]) -> tuple[Array, float]:
    """The weighted mean (2,) of places of one point, and its sigma.

    Views of one scene share its noise and its shadows: their influences are averaged square by square,
    and what they have in common stays. What scatters beyond that is added.
    """
    weight = np.array([peak.sigma_px for peak in peaks]) ** -2.0
    weight /= weight.sum()
    places = np.array([peak.row_col for peak in peaks])
    mean = weight @ places
    influences = np.stack([peak.influence for peak in peaks])
    common = np.tensordot(weight, influences, axes=1)
    own = sum(np.trace(covariance_from_influence(each - common)) for each in influences)
    scatter = float(((places - mean) ** 2).sum())
    beyond = max(0.0, scatter - own) / (2.0 * len(peaks) ** 2)
    return mean, float(
        np.hypot(sigma_per_coordinate(covariance_from_influence(common)), np.sqrt(beyond))
    )
