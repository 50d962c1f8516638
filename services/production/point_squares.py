"""Ground squares that need one point each, and the search for tie points in them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from amers.services.geodesy import continuous, east_north_up
from amers.services.imagery.scene import Scene, scene_gsd_m
from amers.services.matching.ground_features import FeatureOptions, GroundPatches
from amers.services.production.ground_cells import GroundGrid, ground_grid
from amers.services.production.image_pairs import image_pairs
from amers.services.production.tie_patches import detail_patches, is_searched_in_patches
from amers.services.production.tie_points import TieSearch, feature_reduction, no_ties, search_ties
from amers.services.sensors.base import SensorModel
from amers.services.tasks import Work
from amers.services.types import Array, BoolArray, IntArray, Observations, Progress

_PER_SQUARE = 4
"""Tie points of a square that the adjustment takes: somewhat more than the candidates that are tried."""


def point_squares(lon_lat_h: Array, spacing_m: float | None, points: int) -> GroundGrid:
    """Squares of the Earth of a side, or of one that gives about a number of points.

    Args:
        lon_lat_h: (n, 3) ground of a block.
        spacing_m: side of the squares; None where `points` decides.
        points: desired number.
    """
    if spacing_m is None:
        enu = east_north_up(lon_lat_h, np.median(continuous(lon_lat_h), axis=0))[:, :2]
        extent = np.ptp(enu, axis=0) + 1.0
        spacing_m = float(np.sqrt(extent[0] * extent[1] / points))
    return ground_grid(spacing_m)


def ties_in_squares(
    scenes: Sequence[Scene],
    passes: Sequence[BoolArray],
    grid: GroundGrid,
    tied: Array,
    options: FeatureOptions,
    *,
    work: Work,
    progress: Progress,
) -> Observations:
    """Tie points in the middle of squares, where images were searched in a few patches only; else none.

    Args:
        scenes: with adjusted models.
        passes: masks (n,) of images of one pass.
        grid: one point is wanted in each of its squares.
        tied: (n, 3) ground of tie points.
        options: of the features.
        work: computes the tasks and keeps their results.
        progress: receives the fraction done.
    """
    gsd_m = feature_reduction(scenes, options) * max(scene_gsd_m(scene) for scene in scenes)
    if not is_searched_in_patches(scenes, gsd_m):
        return no_ties()
    patches = detail_patches(scenes, grid, tied)
    exact = [replace(scene, sigma_m=gsd_m) for scene in scenes]
    cells = partial(_nearest_patch, [scene.model for scene in scenes], patches)
    search = TieSearch("squares", gsd_m, patches, image_pairs(scenes, passes), cells, _PER_SQUARE)
    return search_ties(exact, search, options, work, progress)


def _nearest_patch(
    models: Sequence[SensorModel],
    patches: Sequence[GroundPatches | None],
    image: int,
    line_sample: Array,
) -> IntArray:
    own = patches[image]
    if own is None:
        raise ValueError("patches expected")
    centres = np.nan_to_num(models[image].project(own.centres), nan=-1e9)
    return np.asarray(cKDTree(centres).query(line_sample)[1], dtype=np.int64)
