"""Tie points over any number of images: features of each, matches of chosen pairs, tracks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.matching.ground_features import (
    FeatureOptions,
    Features,
    GroundPatches,
    find_features,
)
from amers.services.matching.tie_points import Matches, match_features
from amers.services.matching.tracks import image_cells, spread_tracks, tracks
from amers.services.production.image_pairs import image_pairs
from amers.services.production.tie_patches import reduction_of, sparse_patches
from amers.services.tasks import Arrays, Work
from amers.services.types import Array, BoolArray, IntArray, Observations, Progress, part_of

_CELLS_A_SIDE = 16
_PER_CELL = 8
"""Tie points of every cell of an image that the adjustment takes: some 2,000 of an image."""
_FEWEST = 200
"""Tie points of an image below which it is searched again, larger or at a finer sampling: fewer than the
points of a block by default."""
_SHARE_OF_FEATURES = 0.5
"""Of the time; the rest is matching."""

CellsOf = Callable[[int, Array], IntArray]
"""Number (m,) of the cell that positions (m, 2) of an image, given by its row, lie in."""


@dataclass(frozen=True)
class TieSearch:
    """One search for tie points.

    Attributes:
        name: of its tasks, different for every search of a block.
        gsd_m: ground sampling in which features are found, metres.
        patches: of every image; None searches all of the image.
        pairs: (k, 2) rows of images that are matched.
        cells: in which tie points are counted, so that they spread.
        per_cell: tie points of a cell that are enough.
    """

    name: str
    gsd_m: float
    patches: Sequence[GroundPatches | None]
    pairs: IntArray
    cells: CellsOf
    per_cell: int = _PER_CELL


def find_tie_points(
    scenes: Sequence[Scene],
    passes: Sequence[BoolArray],
    options: FeatureOptions,
    work: Work,
    progress: Progress,
) -> Observations:
    """Image positions of details that two images or more show.

    Images are reduced, and large ones are searched in patches of the ground that all of them have in
    common. An image that has too few tie points then is searched whole, then at finer samplings, with
    all that it is matched with.

    Args:
        scenes: images with their models as delivered.
        passes: masks (n,) of images of one pass.
        options: of the features.
        work: computes the tasks and keeps their results.
        progress: receives the fraction done.

    Returns:
        Observations of tie points, spread over all images; `point` counts from 0.
    """
    pairs, reduction = image_pairs(scenes, passes), feature_reduction(scenes, options)
    finest_m = max(scene_gsd_m(scene) for scene in scenes)
    whole: Sequence[GroundPatches | None] = [None] * len(scenes)
    sparse = sparse_patches(scenes, finest_m * reduction)
    searches: list[tuple[float, Sequence[GroundPatches | None]]] = []
    if any(patches is not None for patches in sparse):
        searches.append((reduction, sparse))
    while reduction > 1.0:
        searches.append((reduction, whole))
        reduction = max(1.0, reduction / 2.0)
    searches.append((1.0, whole))
    cells = partial(_cells_of_image, [scene.image.shape for scene in scenes])
    found = no_ties()
    for number, (reduction, patches) in enumerate(searches):
        lacking = np.bincount(found.image, minlength=len(scenes)) < _FEWEST
        left = pairs[lacking[pairs].any(axis=1)]
        if len(left) == 0:
            break
        search = TieSearch(f"{number}", finest_m * reduction, patches, left, cells)
        found = joined_ties(found, search_ties(scenes, search, options, work, progress))
    return found


def feature_reduction(scenes: Sequence[Scene], options: FeatureOptions) -> float:
    """How many times coarser than the coarsest image features are looked for at first."""
    smallest = min(scene.image.shape[0] * scene.image.shape[1] for scene in scenes)
    return reduction_of(smallest, options)


def no_ties() -> Observations:
    """No observation."""
    none = np.zeros(0, dtype=np.int64)
    return Observations(none, none, np.empty((0, 2)), np.empty(0))


def joined_ties(one: Observations, other: Observations) -> Observations:
    """The tie points of two searches, those of the second behind those of the first."""
    return Observations(
        np.concatenate([one.point, other.point + int(one.point.max(initial=-1)) + 1]),
        np.concatenate([one.image, other.image]),
        np.concatenate([one.line_sample, other.line_sample]),
        np.concatenate([one.sigma_px, other.sigma_px]),
    )


def search_ties(
    scenes: Sequence[Scene],
    search: TieSearch,
    options: FeatureOptions,
    work: Work,
    progress: Progress,
) -> Observations:
    """The tie points of one search; see `find_tie_points`."""
    gsd_m = search.gsd_m

    def features(i: int) -> str:
        return f"features/{search.name}-{i:06d}"

    def matches(i: int, j: int) -> str:
        return f"matches/{search.name}-{i:06d}-{j:06d}"

    def image(i: int) -> tuple[Any, ...]:
        return scenes[i], gsd_m, options, search.patches[i]

    def pair(i: int, j: int) -> tuple[Any, ...]:
        return scenes[i], scenes[j], dict(work.kept[features(i)]), dict(work.kept[features(j)]), gsd_m

    used = np.unique(search.pairs).tolist()
    finding = [(features(i), partial(image, i)) for i in used]
    work.run(feature_task, finding, part_of(progress, 0.0, _SHARE_OF_FEATURES))
    matching = [(matches(i, j), partial(pair, i, j)) for i, j in search.pairs.tolist()]
    work.run(match_task, matching, part_of(progress, _SHARE_OF_FEATURES, 1.0 - _SHARE_OF_FEATURES))
    positions = [np.empty((0, 2))] * len(scenes)
    for i in used:
        positions[i] = np.asarray(work.kept[features(i)]["line_sample"])
    links = [(i, j, Matches(**work.kept[matches(i, j)])) for i, j in search.pairs.tolist()]
    sigma_px = [options.sigma_px * gsd_m / scene_gsd_m(scene) for scene in scenes]
    return _observations(positions, links, sigma_px, search)


def feature_task(
    scene: Scene, gsd_m: float, options: FeatureOptions, patches: GroundPatches | None
) -> Arrays:
    """The features of one image."""
    return vars(find_features(scene, gsd_m, options, patches))


def match_task(one: Scene, other: Scene, features: Arrays, others: Arrays, gsd_m: float) -> Arrays:
    """The matches of two images."""
    return vars(match_features(one, other, Features(**features), Features(**others), gsd_m=gsd_m))


def _cells_of_image(shapes: Sequence[tuple[int, int]], image: int, line_sample: Array) -> IntArray:
    return image_cells(line_sample, shapes[image], _CELLS_A_SIDE)


def _observations(
    positions: Sequence[Array],
    links: Sequence[tuple[int, int, Matches]],
    sigmas_px: Sequence[float],
    search: TieSearch,
) -> Observations:
    """The tie points that matches of features, at positions (n, 2) of every image, make."""
    count = [len(of_image) for of_image in positions]
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    image = np.repeat(np.arange(len(positions)), count)
    point = tracks(image, links, start)
    matched = np.flatnonzero(point >= 0)
    matched = matched[np.argsort(point[matched], kind="stable")]
    image, line_sample = image[matched], np.concatenate(positions)[matched]
    cell = np.empty(len(matched), dtype=np.int64)
    for i in range(len(positions)):
        rows = np.flatnonzero(image == i)
        if len(rows):
            cell[rows] = search.cells(i, line_sample[rows])
    kept = spread_tracks(point[matched], image, cell, search.per_cell)
    _, number = np.unique(point[matched][kept], return_inverse=True)
    sigma_px = np.array(sigmas_px)[image[kept]]
    return Observations(number.astype(np.int64), image[kept], line_sample[kept], sigma_px)
