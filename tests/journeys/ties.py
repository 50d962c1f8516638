"""Tie points independent of production and registration: features of larger scale than theirs."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from amers.services.adjustment.intersection import intersect
from amers.services.formats.images.raster import open_raster
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.imagery.source import Window
from amers.services.matching.ground_features import FeatureOptions
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Array, FloatImage, Observations

LARGEST_PX = 12.0
MATCHED_PX = 1.5
"""Details farther than this from the median misfit of all are matched wrongly."""


@dataclass(frozen=True)
class KnownGround:
    """Ground of n details by two views, and where a third shows them.

    Attributes:
        model, shape: of the third view, as delivered.
        ground: (n, 3).
        shown: (n, 2).
    """

    model: RpcModel
    shape: tuple[int, int]
    ground: Array
    shown: Array

    @classmethod
    def of_triplet(cls, real_data: Path, view: int = 1) -> Self:
        """The details of the triplet of Calanques, for one of its views."""
        images = [real_data / "phr_calanques_triplet" / f"img_0{k}.tif" for k in (1, 2, 3)]
        pixels = []
        for image in images:
            raster = open_raster(image)
            pixels.append(raster.read(Window(0, 0, *raster.shape)))
            raster.close()
        models = [read_rpc(image).model for image in images]
        tracks = independent_tracks(pixels)
        own = tracks.take(np.flatnonzero(tracks.image == view))
        others = tracks.take(np.flatnonzero(tracks.image != view))
        met = intersect(models, others, int(tracks.point[-1]) + 1).lon_lat_h[own.point]
        misfit = own.line_sample - models[view].project(met)
        near = np.hypot(*(misfit - np.nanmedian(misfit, axis=0)).T) < MATCHED_PX
        return cls(models[view], pixels[view].shape, met[near], own.line_sample[near])


def independent_tracks(images: Sequence[FloatImage]) -> Observations:
    """Tracks of details that every image shows, matched without any model.

    SIFT features of another size than those production uses, mutual best and clearly so, on the epipolar
    geometry that MAGSAC finds, and consistent from the first image to the last.
    """
    found = [_features(pixels) for pixels in images]
    links = [_matches(*one, *other) for one, other in pairwise(found)]
    closing = _matches(*found[0], *found[-1])
    tracks = []
    for first, second in links[0].items():
        track = [first, second]
        for link in links[1:]:
            track.append(link.get(track[-1], -1))
        if -1 not in track and closing.get(first) == track[-1]:
            tracks.append(track)
    rows = np.array(tracks)
    n, views = rows.shape
    line_sample = np.stack([found[k][0][rows[:, k]] for k in range(views)], axis=1)
    return Observations(
        np.repeat(np.arange(n), views),
        np.tile(np.arange(views), n),
        line_sample.reshape(-1, 2),
        np.ones(n * views),
    )


def _features(pixels: FloatImage) -> tuple[Array, FloatImage]:
    low, high = np.percentile(pixels, [0.5, 99.5])
    image = np.clip((pixels - low) / (high - low) * 255.0, 0.0, 255.0).astype(np.uint8)
    sift = cv2.SIFT.create(contrastThreshold=0.01)
    smallest = FeatureOptions().largest_px
    keypoints = [point for point in sift.detect(image) if smallest < point.size < LARGEST_PX]
    keypoints, descriptor = sift.compute(image, keypoints)
    return np.array([point.pt[::-1] for point in keypoints]), descriptor


def _matches(one: Array, one_d: FloatImage, other: Array, other_d: FloatImage) -> dict[int, int]:
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    best = {
        first.queryIdx: first.trainIdx
        for first, second in matcher.knnMatch(one_d, other_d, 2)
        if first.distance < 0.8 * second.distance
    }
    back = {match.queryIdx: match.trainIdx for match in matcher.match(other_d, one_d)}
    pairs = np.array([(i, j) for i, j in best.items() if back.get(j) == i])
    _, inside = cv2.findFundamentalMat(
        one[pairs[:, 0]], other[pairs[:, 1]], cv2.USAC_MAGSAC, 1.5, 0.999, 10_000
    )
    return {int(i): int(j) for i, j in pairs[inside.ravel() > 0]}
