"""ORTHO-IMAGE AND HEIGHTS IN -> NEW POINTS OUT: the salient corners of one image that lies on a map."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from services.errors import InputError, NotEnoughPoints
from services.geodesy import box_around
from services.imagery.gaps import bridged, filled
from services.imagery.scene import Scene, scene_centre, scene_gsd_m
from services.imagery.source import Window, block_means, render_chip
from services.matching.control_points import chip_pixels
from services.matching.multi_image import chip_inside, chip_saliency, nearly_whole, stored_chip
from services.production.point_views import chips_of
from services.terrain import Terrain
from services.types import (
    Array,
    ChipArray,
    ControlPoints,
    FloatImage,
    Frame,
    Progress,
    Views,
    no_progress,
)

_MIN_POINTS = 6
"""Fewest points of a block."""
_CORNER_DISTANCE_PX = 10
"""Smallest distance between the corners tried in a square, pixels of the fine chips."""


@dataclass(frozen=True)
class OrthoPointOptions:
    """How points are produced from an ortho-image.

    Attributes:
        fine_gsd_m, coarse_gsd_m: ground samplings of the chips, metres; by default that of the image in
            two digits, and four times that.
        spacing_m: side of the squares that get one point each; None divides the image into about
            `points` squares.
        points: number of points aimed at when there is no spacing.
        candidates: number of corners of every square that are tried.
        min_saliency: smallest saliency of a point's chip.
        local_sigma_px: position of a detail relative to the rest of the image, pixels of the image, one
            standard deviation a coordinate.
    """

    fine_gsd_m: float | None = None
    coarse_gsd_m: float | None = None
    spacing_m: float | None = None
    points: int = 300
    candidates: int = 3
    min_saliency: float = 0.05
    local_sigma_px: float = 0.3


@dataclass(frozen=True)
class GroundHeights:
    """Heights of the ground.

    Attributes:
        terrain: a terrain model; None for flat ground.
        flat_m: height of flat ground, metres above the ellipsoid; not used with a terrain.
        sigma_m: of the heights, one standard deviation.
        frame_sigma_m: of the error that all the heights share, such as that of their datum; NaN when
            unknown.
    """

    terrain: Terrain | None
    flat_m: float
    sigma_m: float
    frame_sigma_m: float = math.nan

    def at(self, lon_lat: Array) -> Array:
        """Heights (n,) at longitudes and latitudes (n, 2), metres; NaN where unknown."""
        if self.terrain is not None:
            return self.terrain.height_m(lon_lat)
        return np.full(len(lon_lat), self.flat_m)


@dataclass(frozen=True)
class OrthoPoints:
    """The points of an ortho-image.

    Attributes:
        points: as in `Production`; each has one view at every ground sampling that shows it whole.
        chips: from the row of a point to its chips, (views, 101, 101) uint16; 0 is nodata.
        gsds_m: ground samplings of the chips, fine and coarse, metres.
        outline: (m, 2) lon, lat of a rectangle that contains the points, counter-clockwise, not closed.
    """

    points: ControlPoints
    chips: Callable[[int], ChipArray]
    gsds_m: tuple[float, float]
    outline: Array


def produce_ortho_points(
    scene: Scene,
    heights: GroundHeights,
    options: OrthoPointOptions = OrthoPointOptions(),
    progress: Progress = no_progress,
) -> OrthoPoints:
    """Control points with chips, produced from one ortho-image and the heights of its ground.

    The image is divided into squares. The most salient corner of each square becomes a point. Its
    horizontal position is that of the image and its height that of the ground: the points inherit the
    errors and the frame of the image. The height of the surface stays unknown, as a single view without
    parallax does not show it, and a terrain need not have roofs and trees.

    Source of the corners: Shi and Tomasi (1994), Good features to track.

    Args:
        scene: an ortho-image, with its map grid as model.
        heights: of the ground.
        options: thresholds.
        progress: receives the fraction done.

    Raises:
        InputError: the scene has a parallax, so that it is no ortho-image.
        NotEnoughPoints: too few corners are salient and have a known height.
    """
    gsd_m = scene_gsd_m(scene)
    middle = scene_centre(scene)[None, :]
    if scene.model.project_derivative(middle)[0, :, 2].any():
        raise InputError(
            "an ortho-image is needed: positions in this scene depend on the height of the ground. "
            "Orthorectify it first"
        )
    fine_m = options.fine_gsd_m or float(f"{gsd_m:.2g}")
    coarse_m = options.coarse_gsd_m or 4.0 * fine_m
    if not 0.0 < fine_m < coarse_m:
        raise InputError(
            f"ground samplings of {fine_m:g} and {coarse_m:g} m given: fine_gsd_m must be above 0 and "
            "below coarse_gsd_m"
        )
    squares = _squares(scene, gsd_m, options)
    points: list[tuple[Array, float]] = []
    for number, square in enumerate(squares):
        if number % 16 == 0:
            progress(0.9 * number / len(squares), f"searching {len(squares)} squares")
        best = _best_corner(scene, heights, square, fine_m, options)
        if best is not None:
            points.append(best)
    if len(points) < _MIN_POINTS:
        raise NotEnoughPoints(
            len(points),
            _MIN_POINTS,
            f"salient corners of known height in {len(squares)} squares of the image",
        )
    progress(1.0, f"{len(points)} points")
    return _assembled(scene, heights, points, (fine_m, coarse_m), gsd_m * options.local_sigma_px)


def _squares(scene: Scene, gsd_m: float, options: OrthoPointOptions) -> list[Window]:
    """The windows of an image divided into squares, as nearly as its size permits."""
    lines, samples = scene.image.shape
    if options.spacing_m is not None:
        side = options.spacing_m / gsd_m
    else:
        side = float(np.sqrt(lines * samples / options.points))
    rows, cols = max(1, int(lines / side)), max(1, int(samples / side))
    line = [lines * k // rows for k in range(rows + 1)]
    sample = [samples * k // cols for k in range(cols + 1)]
    return [
        Window(top, left, bottom - top, right - left)
        for top, bottom in pairwise(line)
        for left, right in pairwise(sample)
    ]


def _best_corner(
    scene: Scene, heights: GroundHeights, square: Window, fine_m: float, options: OrthoPointOptions
) -> tuple[Array, float] | None:
    """The most salient corner (lon, lat, height) of a square and its saliency; None without any."""
    factor = max(1, int(fine_m / scene_gsd_m(scene)))
    corners = _corners(block_means(scene.image.read(square), factor), options.candidates)
    line_sample = corners * factor + (factor - 1) / 2.0 + [square.line, square.sample]
    lon_lat = scene.model.locate(line_sample, np.zeros(len(corners)))[:, :2]
    lon_lat_h = np.column_stack([lon_lat, heights.at(lon_lat)])
    lon_lat_h = lon_lat_h[np.isfinite(lon_lat_h).all(axis=1)]
    whole = chip_inside(scene.model, scene.image.shape, lon_lat_h, fine_m)
    best: tuple[Array, float] | None = None
    for ground in lon_lat_h[whole]:
        stored = stored_chip(render_chip(scene.image, scene.model, ground, fine_m))
        saliency = chip_saliency(chip_pixels(stored))
        if saliency >= options.min_saliency and (best is None or saliency > best[1]):
            best = ground, saliency
    return best


def _corners(pixels: FloatImage, count: int) -> Array:
    """The strongest corners (n, 2), row and column, away from areas without data and saturated ones."""
    if not np.isfinite(pixels).any() or min(pixels.shape) < 8:
        return np.empty((0, 2))
    mask = cv2.erode(np.isfinite(bridged(pixels)).astype(np.uint8), np.ones((9, 9), np.uint8))
    col_row = cv2.goodFeaturesToTrack(
        filled(pixels), count, 0.01, _CORNER_DISTANCE_PX, mask=mask, blockSize=7
    )
    return np.empty((0, 2)) if col_row is None else col_row.reshape(-1, 2)[:, ::-1].astype(np.float64)


def _assembled(
    scene: Scene,
    heights: GroundHeights,
    corners: list[tuple[Array, float]],
    gsds_m: tuple[float, float],
    sigma_m: float,
) -> OrthoPoints:
    """Corners as control points with their views and chips."""
    lon_lat_h = np.array([ground for ground, _ in corners])
    n = len(lon_lat_h)
    has_coarse = chip_inside(scene.model, scene.image.shape, lon_lat_h, gsds_m[1])
    for row in np.flatnonzero(has_coarse):
        has_coarse[row] = nearly_whole(render_chip(scene.image, scene.model, lon_lat_h[row], gsds_m[1]))
    start = np.concatenate([[0], np.cumsum(1 + has_coarse)]).astype(np.int64)
    gsd_m = np.full(start[-1], gsds_m[0])
    gsd_m[start[1:][has_coarse] - 1] = gsds_m[1]
    vertical = np.zeros(start[-1])
    variance_m2 = np.array([sigma_m, sigma_m, heights.sigma_m]) ** 2
    points = ControlPoints(
        id=np.arange(n, dtype=np.int64),
        lon_lat_h=lon_lat_h,
        covariance_m2=np.tile(np.diag(variance_m2), (n, 1, 1)),
        block=np.zeros(n, dtype=np.int64),
        frames=(Frame.from_sigmas(scene.sigma_m, heights.frame_sigma_m),),
        saliency=np.array([saliency for _, saliency in corners]),
        health=np.ones(n),
        views=Views(
            start=start,
            gsd_m=gsd_m,
            image=np.zeros(start[-1], dtype=np.int64),
            incidence_deg=vertical,
            azimuth_deg=vertical,
            health=np.ones(start[-1]),
            images=(scene.acquisition,),
        ),
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=start[:-1].copy(),
        chip_files=("chips",),
    )

    return OrthoPoints(points, chips_of([scene], points), gsds_m, box_around(lon_lat_h))
