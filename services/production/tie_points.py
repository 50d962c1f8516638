"""Tie points over any number of images: features of each, matches of chosen pairs, tracks."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.matching.ground_features import FeatureOptions, Features, find_features
from amers.services.matching.tie_points import Matches, match_features
from amers.services.matching.tracks import image_cells, spread_tracks, tracks
from amers.services.production.image_pairs import image_pairs
from amers.services.tasks import Arrays, Work
from amers.services.types import BoolArray, Observations, Progress, part_of

_CELLS_A_SIDE = 16
_PER_CELL = 8
"""Tie points of every cell of an image that the adjustment takes: some 2,000 of an image."""
_SHARE_OF_FEATURES = 0.5
"""Of the time; the rest is matching."""


def find_tie_points(
    scenes: Sequence[Scene],
    passes: Sequence[BoolArray],
    options: FeatureOptions,
    work: Work,
    progress: Progress,
) -> Observations:
    """Image positions of details that two images or more show.

    Args:
        scenes: images with their models as delivered.
        passes: masks (n,) of images of one pass.
        options: of the features.
        work: computes the tasks and keeps their results.
        progress: receives the fraction done.

    Returns:
        Observations of tie points, spread over all images; `point` counts from 0.
    """
    gsd_m = max(scene_gsd_m(scene) for scene in scenes)
    pairs = image_pairs(scenes, passes).tolist()

    def image(i: int) -> tuple[Any, ...]:
        return scenes[i], gsd_m, options

    def pair(i: int, j: int) -> tuple[Any, ...]:
        return scenes[i], scenes[j], dict(work.kept[_features(i)]), dict(work.kept[_features(j)]), gsd_m

    finding = [(_features(i), partial(image, i)) for i in range(len(scenes))]
    work.run(feature_task, finding, part_of(progress, 0.0, _SHARE_OF_FEATURES))
    matching = [(_pair(i, j), partial(pair, i, j)) for i, j in pairs]
    work.run(match_task, matching, part_of(progress, _SHARE_OF_FEATURES, 1.0 - _SHARE_OF_FEATURES))
    return _observations(scenes, pairs, work, options.sigma_px * gsd_m)


def feature_task(scene: Scene, gsd_m: float, options: FeatureOptions) -> Arrays:
    """The features of one image."""
    return vars(find_features(scene, gsd_m, options))


def match_task(one: Scene, other: Scene, features: Arrays, others: Arrays, gsd_m: float) -> Arrays:
    """The matches of two images."""
    return vars(match_features(one, other, Features(**features), Features(**others), gsd_m=gsd_m))


def _features(image: int) -> str:
    return f"features/{image:06d}"


def _pair(one: int, other: int) -> str:
    return f"matches/{one:06d}-{other:06d}"


def _observations(
    scenes: Sequence[Scene], pairs: Sequence[tuple[int, int]], work: Work, sigma_m: float
) -> Observations:
    count = [len(work.kept[_features(i)]["line_sample"]) for i in range(len(scenes))]
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    image = np.repeat(np.arange(len(scenes)), count)
    links = [(one, other, Matches(**work.kept[_pair(one, other)])) for one, other in pairs]
    point = tracks(image, links, start)
    matched = np.flatnonzero(point >= 0)
    matched = matched[np.argsort(point[matched], kind="stable")]
    image = image[matched]
    line_sample, sigma_px = np.empty((len(matched), 2)), np.empty(len(matched))
    cell = np.empty(len(matched), dtype=np.int64)
    for i, scene in enumerate(scenes):
        rows = np.flatnonzero(image == i)
        line_sample[rows] = work.kept[_features(i)]["line_sample"][matched[rows] - start[i]]
        sigma_px[rows] = sigma_m / scene_gsd_m(scene)
        cell[rows] = image_cells(line_sample[rows], scene.image.shape, _CELLS_A_SIDE)
    kept = spread_tracks(point[matched], image, cell, _PER_CELL)
    _, number = np.unique(point[matched][kept], return_inverse=True)
    return Observations(number.astype(np.int64), image[kept], line_sample[kept], sigma_px[kept])
