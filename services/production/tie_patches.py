"""Ground squares, common to all images, in which large images are searched for tie points."""

from collections.abc import Sequence

import numpy as np
import shapely
from scipy.spatial import cKDTree

from amers.services.geodesy import ecef_from_lon_lat_h
from amers.services.imagery.scene import Scene, scene_centre, scene_footprint, scene_gsd_m
from amers.services.matching.ground_features import FeatureOptions, GroundPatches
from amers.services.production.ground_cells import GroundGrid, ground_grid, seen_cells
from amers.services.types import Array, IntArray

_WHOLE_PX = 4_000_000
"""Pixels of the features' sampling up to which an image is searched whole."""
_PATCHES_A_SIDE = 6
_PATCH_PX = 320
"""Patches of an image as delivered, and their side: as many pixels as an image that is searched whole.
Half a patch, 640 px of an image reduced by four, covers the errors of delivered models."""
_DETAIL_PX = 64
_DETAIL_MARGIN_PX = 16
"""Side of a patch around a place where a point is wanted, and what small descriptors reach beyond it:
the models are adjusted, the height is that of tie points near by."""
_NEAR = 5
"""Tie points whose median height is that of a place."""


def sparse_patches(scenes: Sequence[Scene], gsd_m: float) -> list[GroundPatches | None]:
    """Patches of every image in which its features are found at first; None where all of it is searched.

    They lie on a grid of the Earth, so that images show the same of them, and their number does not
    depend on the size of the image.

    Args:
        scenes: with models as delivered.
        gsd_m: ground sampling in which features are found, metres.
    """
    reduced = [reduced_pixels(scene, gsd_m) for scene in scenes]
    large = [i for i, pixels in enumerate(reduced) if pixels > _WHOLE_PX]
    patches: list[GroundPatches | None] = [None] * len(scenes)
    if not large:
        return patches
    side_m = float(np.sqrt(min(reduced[i] for i in large))) * gsd_m / _PATCHES_A_SIDE
    grid, height_m = ground_grid(side_m), float(np.mean([scene_centre(scenes[i])[2] for i in large]))
    cells = _cells([scenes[i] for i in large], grid)
    for i, own in zip(large, cells, strict=True):
        lon_lat = grid.centres(own)
        centres = np.column_stack([lon_lat, np.full(len(lon_lat), height_m)])
        patches[i] = GroundPatches(centres, np.full(2, float(_PATCH_PX)))
    return patches


def reduced_pixels(scene: Scene, gsd_m: float) -> float:
    """Pixels of an image at a ground sampling."""
    return scene.image.shape[0] * scene.image.shape[1] * (scene_gsd_m(scene) / gsd_m) ** 2


def searched_pixels(
    pixels: float, smallest: float, squares: float, options: FeatureOptions
) -> tuple[float, float]:
    """Pixels in which features of one image are found, and pixels of the image that are read for them.

    Args:
        pixels: of the image.
        smallest: pixels of the smallest image of the block.
        squares: places in the image where a point is wanted.
        options: of the features.
    """
    reduction = reduction_of(smallest, options)
    reduced = pixels / reduction**2
    if reduced > _WHOLE_PX:
        margin_px = GroundPatches.margin_px
        first = _PATCHES_A_SIDE**2 * (_PATCH_PX + 2 * margin_px) ** 2
        reduced = min(reduced, first + squares * (_DETAIL_PX + 2 * _DETAIL_MARGIN_PX) ** 2)
    return reduced, reduced * reduction**2


def reduction_of(smallest: float, options: FeatureOptions) -> float:
    """How many times coarser than its pixels the smallest image of a block is searched at first.

    Args:
        smallest: its pixels.
        options: of the features.
    """
    return float(np.clip(np.sqrt(smallest / options.reduced_px), 1.0, options.most_reduced))


def is_searched_in_patches(scenes: Sequence[Scene], gsd_m: float) -> bool:
    """Whether tie points of some image come from patches, so that places between have none."""
    return any(reduced_pixels(scene, gsd_m) > _WHOLE_PX for scene in scenes)


def detail_patches(scenes: Sequence[Scene], grid: GroundGrid, tied: Array) -> list[GroundPatches | None]:
    """Small patches of every image in the middle of the squares of a grid that two images show.

    Args:
        scenes: with adjusted models.
        grid: one point is wanted in each of its squares.
        tied: (n, 3) ground of tie points.
    """
    of_images = _cells(scenes, grid)
    cells, images = np.unique(np.concatenate(of_images), return_counts=True)
    cells = cells[images >= 2]
    lon_lat = grid.centres(cells)
    flat = tied * [1.0, 1.0, 0.0]
    near = cKDTree(ecef_from_lon_lat_h(flat)).query(
        ecef_from_lon_lat_h(np.column_stack([lon_lat, np.zeros(len(cells))])), k=min(_NEAR, len(tied))
    )[1]
    height_m = np.median(tied[near.reshape(len(cells), -1), 2], axis=1)
    centres = np.column_stack([lon_lat, height_m])
    size_px = np.full(2, float(_DETAIL_PX))
    return [GroundPatches(centres[np.isin(cells, own)], size_px, _DETAIL_MARGIN_PX) for own in of_images]


def _cells(scenes: Sequence[Scene], grid: GroundGrid) -> list[IntArray]:
    """The cells of a grid in whose ground every image may lie."""
    footprints = np.array([shapely.Polygon(scene_footprint(scene)) for scene in scenes], dtype=object)
    seen = seen_cells(footprints, np.array([None] * len(scenes), dtype=object), grid)
    return [seen.cell[seen.start[i] : seen.start[i + 1]] for i in range(len(scenes))]
