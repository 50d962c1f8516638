"""Positions in images and on the ground, by sensor models; and details that two images share."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from amers.opened import (
    FilePath,
    Scene,
    Terrain,
    as_scene,
    as_terrain,
    ground_rows,
    one_or_many,
    rows_of,
)
from amers.services.errors import InputError
from amers.services.imagery.scene import scene_gsd_m
from amers.services.lines_of_sight import intersect_terrain
from amers.services.matching.ground_features import find_features
from amers.services.matching.tie_points import MatchOptions, match_features
from amers.services.sensors.base import SensorModel
from amers.services.types import Array


class HasModel(Protocol):
    """Anything with a sensor model: a `Scene`, or what `register` and `refine` return."""

    @property
    def model(self) -> SensorModel:
        """The model that transforms ground positions to image positions."""
        ...


@dataclass(frozen=True, repr=False)
class TiePoints:
    """Tie points: k details that two images show.

    Attributes:
        first, second: (k, 2) line and sample in the first and in the second image, pixels.
        similarity: (k,) similarity of each detail in both images; 1 means equal.
    """

    first: Array
    second: Array
    similarity: Array

    def __len__(self) -> int:
        return len(self.similarity)

    def __repr__(self) -> str:
        spread = np.ptp(self.first, axis=0) if len(self) else np.zeros(2)
        similarity = f"{np.median(self.similarity):.2f}" if len(self) else "unknown"
        return (
            f"TiePoints: {len(self)} details of two images\n"
            f"  over {spread[0]:.0f} lines and {spread[1]:.0f} samples of the first\n"
            f"  similarity {similarity} (median)"
        )


def project(scene: HasModel | FilePath, lon_lat_h: ArrayLike) -> Array:
    """Compute the image positions of ground positions.

    Args:
        scene: a scene, its path, or a result of `register` or `refine`, whose refined model is used.
        lon_lat_h: (3,) or (n, 3) longitude, latitude, height; degrees, metres above the ellipsoid.

    Returns:
        (2,) or (n, 2) line and sample, pixels; (0, 0) is the centre of the first pixel. NaN where the
        model is not valid. Positions can be outside the image.

    Raises:
        InputError: a latitude is beyond 90 degrees, or the shape is wrong.
    """
    rows = ground_rows(lon_lat_h, "lon_lat_h")
    return one_or_many(_model(scene).project(rows), lon_lat_h)


def locate(
    scene: HasModel | FilePath,
    line_sample: ArrayLike,
    height_m: ArrayLike | None = None,
    *,
    terrain: Terrain | FilePath | None = None,
) -> Array:
    """Compute the ground positions of image positions, at a height or on a terrain.

    On a terrain, the ground position is where the line of sight first meets the terrain.

    Args:
        scene: a scene, its path, or a result of `register` or `refine`, whose refined model is used.
        line_sample: (2,) or (n, 2) pixels; (0, 0) is the centre of the first pixel.
        height_m: one height or (n,) heights above the ellipsoid, metres. By default none: then a terrain
            is required.
        terrain: an open terrain, or the path of a file that states its vertical datum. By default none:
            then a height is required.

    Returns:
        (3,) or (n, 3) longitude, latitude, height. NaN where the model is not valid, or where the line
        of sight does not meet the terrain.

    Raises:
        InputError: height and terrain are both given or both missing, the shape is wrong, or no line of
            sight comes near the terrain.
    """
    rows = rows_of(line_sample, "line_sample", (2,))
    if (height_m is None) == (terrain is None):
        raise InputError("height_m, terrain: either a height or a terrain is expected")
    model = _model(scene)
    if terrain is not None:
        ground = intersect_terrain(model, rows, as_terrain(terrain).grid)
    else:
        heights = np.asarray(height_m, dtype=np.float64)
        if heights.shape not in ((), (1,), (len(rows),)):
            raise InputError(
                f"height_m: shape {heights.shape} found, one height or ({len(rows)},) expected"
            )
        ground = model.locate(rows, np.broadcast_to(heights, len(rows)).copy())
    return one_or_many(ground, line_sample)


def match_images(
    first: Scene | FilePath,
    second: Scene | FilePath,
    *,
    gsd_m: float | None = None,
    max_ratio: float = 0.75,
    tolerance_px: float = 1.5,
) -> TiePoints:
    """Find details that two overlapping images show, with the help of their sensor models.

    Args:
        first, second: scenes or their paths.
        gsd_m: ground sampling at which details are compared, metres. By default the ground sampling of
            the coarser image; a larger value is faster and finds fewer details.
        max_ratio: largest ratio of the distances to the best and to the second best candidate. By
            default 0.75; a smaller value gives fewer and more reliable details.
        tolerance_px: largest deviation from the common offset of the two images, across the epipolar
            lines, pixels of `gsd_m`. By default 1.5.

    Raises:
        InputError: an image cannot be used.
    """
    if gsd_m is not None and not gsd_m > 0.0:
        raise InputError(f"gsd_m: {gsd_m:g} found, a length above 0 m expected")
    one, other = (as_scene(scene).content for scene in (first, second))
    sampling_m = gsd_m or max(scene_gsd_m(one), scene_gsd_m(other))
    features, others = (find_features(scene, sampling_m) for scene in (one, other))
    options = MatchOptions(max_ratio=max_ratio, tolerance_px=tolerance_px)
    matches = match_features(one, other, features, others, gsd_m=sampling_m, options=options)
    return TiePoints(
        features.line_sample[matches.rows[:, 0]],
        others.line_sample[matches.rows[:, 1]],
        matches.similarity,
    )


def _model(scene: HasModel | FilePath) -> SensorModel:
    return as_scene(scene).model if isinstance(scene, FilePath) else scene.model
