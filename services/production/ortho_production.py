"""Production of points from ortho-images and heights: the salient corners of the images."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from amers.services.errors import AmersError, InputError, NotEnoughPoints
from amers.services.geodesy import box_around
from amers.services.imagery.gaps import bridged, filled
from amers.services.imagery.scene import Scene, scene_centre, scene_gsd_m
from amers.services.imagery.source import Window, block_means
from amers.services.matching.multi_image import chip_inside
from amers.services.production.chip_sampling import chip_samplings_m
from amers.services.production.detail_points import detail_points, detail_saliency
from amers.services.production.point_views import check_image_names, chips_of
from amers.services.production.view_agreement import AgreedViews, agreed_views, refuse
from amers.services.statements import Statements
from amers.services.tasks import Arrays, Work
from amers.services.terrain import Terrain
from amers.services.types import (
    Array,
    BoolArray,
    ChipArray,
    ControlPoints,
    FloatImage,
    Frame,
    IntArray,
    Progress,
    no_progress,
    part_of,
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
        spacing_m: side of the squares that get one point each, metres.
        points: desired number of points; --spacing-m overrides it.
        candidates: number of corners of every square that are tried.
        min_saliency: smallest saliency of a point's chip.
        local_sigma_px: position of a detail relative to the rest of the image, pixels of the image, one
            standard deviation a coordinate; several images raise it when they disagree by more.
        min_views: smallest number of images in which a point must be found.
        min_share: least share of the images showing a point in which it is found, 0 to 1.
    """

    fine_gsd_m: float | None = None
    coarse_gsd_m: float | None = None
    spacing_m: float | None = None
    points: int = 300
    candidates: int = 3
    min_saliency: float = 0.05
    local_sigma_px: float = 0.3
    min_views: int = 2
    min_share: float = 0.0


@dataclass(frozen=True)
class GroundHeights:
    """Heights of the ground.

    Attributes:
        terrain: a terrain model; None for flat ground.
        flat_m, flat_sigma_m: height of flat ground, metres above the ellipsoid, and its standard
            deviation; not used with a terrain.
        frame_sigma_m: of the error that all the heights share, such as that of their datum; NaN when
            unknown.
    """

    terrain: Terrain | None
    flat_m: float = math.nan
    flat_sigma_m: float = math.nan
    frame_sigma_m: float = math.nan

    @property
    def statements(self) -> Statements:
        """Of the files of the terrain."""
        return () if self.terrain is None else self.terrain.statements

    def at(self, lon_lat: Array) -> Array:
        """Heights (n,) at longitudes and latitudes (n, 2), metres; NaN where unknown."""
        if self.terrain is not None:
            return self.terrain.height_m(lon_lat)
        return np.full(len(lon_lat), self.flat_m)

    def sigma_m(self, lon_lat: Array) -> Array:
        """One standard deviation (n,) of the heights at longitudes and latitudes (n, 2), metres."""
        if self.terrain is not None:
            return self.terrain.sigma_m(lon_lat)
        return np.full(len(lon_lat), self.flat_sigma_m)


def everywhere(lon_lat: Array) -> BoolArray:
    """True (n,) for all places (n, 2)."""
    return np.ones(len(lon_lat), dtype=np.bool_)


@dataclass(frozen=True)
class OrthoPoints:
    """The points of ortho-images.

    Attributes:
        points: as in `Production`; each has a view of every image in which it was found, at every ground
            sampling that shows it whole.
        chips: from the row of a point to its chips, (views, 101, 101) uint16; 0 is nodata.
        gsds_m: ground samplings of the chips, fine and coarse, metres.
        outline: (m, 2) lon, lat of a rectangle that contains the points, counter-clockwise, not closed.
        shift_m: (k, 2) east, north, by which each image lay off the first one.
        local_sigma_m: horizontal error of details relative to the rest of their image, from the
            disagreement of the images; NaN where nothing shows it.
        statements: of the files, as far as the caller adds them.
    """

    points: ControlPoints
    chips: Callable[[int], ChipArray]
    gsds_m: tuple[float, float]
    outline: Array
    shift_m: Array
    local_sigma_m: float
    statements: Statements = ()


def produce_ortho_points(
    scenes: Sequence[Scene],
    heights: GroundHeights,
    options: OrthoPointOptions = OrthoPointOptions(),
    progress: Progress = no_progress,
    *,
    wanted: Callable[[Array], BoolArray] = everywhere,
    not_found: Callable[[AmersError], None] = refuse,
    work: Work | None = None,
) -> OrthoPoints:
    """Control points with chips, produced from ortho-images of one place and the heights of its ground.

    The first image is divided into squares. The most salient corner of each square becomes a point. Its
    horizontal position is that of the first image and its height that of the ground: the points inherit
    the errors and the frame of that image. It is searched in the other images (dates, mosaics), which
    become further views; their disagreement raises the sigmas (`agreed_views`). The height of the
    surface stays unknown, as views without parallax do not show it, and a terrain need not have roofs
    and trees.

    Source of the corners: Shi and Tomasi (1994), Good features to track.

    Args:
        scenes: ortho-images, with their map grids as models, the most accurate first.
        heights: of the ground.
        options: thresholds.
        progress: receives the fraction done.
        wanted: whether the squares with centres (n, 2), longitude and latitude, need a point.
        not_found: receives the error of an image in which the points are not found, see `agreed_views`.
        work: see `agreed_views`.

    Raises:
        InputError: a scene has a parallax, so that it is no ortho-image, or two have one name.
        NotEnoughPoints: too few corners are salient and have a known height, or are found in the other
            images.
    """
    _check_scenes(scenes)
    scene, gsds_m = scenes[0], chip_samplings_m(scenes, options.fine_gsd_m, options.coarse_gsd_m)
    squares = _squares(scene, scene_gsd_m(scene), options)
    squares = [
        square
        for square, is_wanted in zip(squares, wanted(_centres(scene, squares)), strict=True)
        if is_wanted
    ]
    search = part_of(progress, 0.0, 0.9 if len(scenes) == 1 else 0.5)
    corners = _corners(scenes, heights, squares, gsds_m[0], options, progress=search)
    lon_lat_h = np.array([corner.lon_lat_h for corner in corners]).reshape(-1, 3)
    searching = part_of(progress, 0.5, 0.4)
    agreed = agreed_views(scenes, lon_lat_h, gsds_m[0], searching, not_found, work=work)
    _check_one_place(scenes, agreed, not_found)
    rows = _best_of_squares(corners, agreed, options)
    if len(rows) < _MIN_POINTS:
        found = f", found in {options.min_views} images" if len(scenes) > 1 else ""
        what = f"salient corners of known height in {len(squares)} squares of the image{found}"
        raise NotEnoughPoints(len(rows), _MIN_POINTS, what)
    progress(1.0, f"{len(rows)} points")
    sigma_m = max(scene_gsd_m(scene) * options.local_sigma_px, np.nan_to_num(agreed.local_sigma_m))
    covariance_m2 = np.tile(np.eye(3) * sigma_m**2, (len(rows), 1, 1))
    covariance_m2[:, 2, 2] = heights.sigma_m(lon_lat_h[rows]) ** 2
    points = detail_points(
        agreed,
        rows,
        lon_lat_h[rows],
        covariance_m2,
        saliency=np.array([corners[row].saliency for row in rows]),
        frame=Frame.from_sigmas(scene.sigma_m * agreed.disagreement, heights.frame_sigma_m),
        gsds_m=gsds_m,
    )
    vertical = np.zeros(len(points.views.gsd_m))
    points = replace(points, views=replace(points.views, incidence_deg=vertical, azimuth_deg=vertical))
    chips = chips_of(agreed.scenes, points.lon_lat_h, points.views)
    outline = box_around(points.lon_lat_h)
    return OrthoPoints(points, chips, gsds_m, outline, agreed.shift_m, agreed.local_sigma_m)


def shifts_of_scenes(
    scenes: Sequence[Scene],
    heights: GroundHeights,
    options: OrthoPointOptions = OrthoPointOptions(),
    progress: Progress = no_progress,
    work: Work | None = None,
) -> Array:
    """Shifts (n, 2) east, north, metres, by which ortho-images lie off the first; NaN where not found.

    Each is searched alone at the salient corners of the first, so that one that shows other ground,
    clouds or another season does not stop the others. The arguments are those of `produce_ortho_points`.

    Raises:
        InputError: a scene has a parallax, or two have one name.
    """
    _check_scenes(scenes)
    gsds_m = chip_samplings_m(scenes, options.fine_gsd_m, options.coarse_gsd_m)
    squares = _squares(scenes[0], scene_gsd_m(scenes[0]), options)
    corners = _corners(scenes[:1], heights, squares, gsds_m[0], options, progress=no_progress)
    lon_lat_h = np.array([corner.lon_lat_h for corner in corners]).reshape(-1, 3)
    progress(0.0, f"comparing {len(scenes)} images")
    tasks = [(scenes[0], other, lon_lat_h, gsds_m[0]) for other in scenes[1:]]
    results = (work or Work()).results("shifts", shift_task, tasks)
    return np.stack([np.zeros(2), *(one["shift_m"] for one in results)])


def shift_task(first: Scene, other: Scene, lon_lat_h: Array, gsd_m: float) -> Arrays:
    """Shift (2,) east, north, metres, of an image against the first; NaN where it is not found."""
    shift_m = np.full(2, np.nan)
    try:
        agreed = agreed_views([first, other], lon_lat_h, gsd_m)
    except NotEnoughPoints:
        return {"shift_m": shift_m}
    return {"shift_m": agreed.shift_m[1] if agreed.tied[1] else shift_m}


@dataclass(frozen=True)
class _Corner:
    """A salient corner: the number of its square, its ground position (3,) and its saliency."""

    square: int
    lon_lat_h: Array
    saliency: float


def _corners(
    scenes: Sequence[Scene],
    heights: GroundHeights,
    squares: list[Window],
    fine_m: float,
    options: OrthoPointOptions,
    *,
    progress: Progress,
) -> list[_Corner]:
    """The salient corners of the squares of the first image, square by square, the best first."""
    corners: list[_Corner] = []
    for number, window in enumerate(squares):
        if number % 16 == 0:
            progress(number / len(squares), f"searching {len(squares)} squares")
        of_square = _salient_corners(scenes[0], heights, window, fine_m, options)
        # Other images may not show the best one.
        corners += [_Corner(number, *c) for c in of_square[: 1 if len(scenes) == 1 else None]]
    return corners


def _best_of_squares(
    corners: list[_Corner], agreed: AgreedViews, options: OrthoPointOptions
) -> IntArray:
    """The first corner of every square that enough images confirm."""
    confirmed = np.flatnonzero(agreed.confirmed(options.min_views, options.min_share))
    squares = [corners[row].square for row in confirmed]
    return np.asarray(confirmed[np.unique(squares, return_index=True)[1]])


def _check_one_place(
    scenes: Sequence[Scene], agreed: AgreedViews, not_found: Callable[[AmersError], None]
) -> None:
    """Report an image that shows too few of the corners."""
    for other, tied in zip(scenes, agreed.tied, strict=True):
        if not tied:
            first = scenes[0].acquisition.image_id
            message = (
                f"{other.acquisition.image_id}: shows fewer than 6 salient corners of {first}; expected "
                "images of one place: make a block of each"
            )
            not_found(InputError(message))


def _check_scenes(scenes: Sequence[Scene]) -> None:
    check_image_names(scenes)
    for scene in scenes:
        if scene.model.project_derivative(scene_centre(scene)[None, :])[0, :, 2].any():
            raise InputError(
                f"{scene.acquisition.image_id}: an ortho-image is needed: positions in this scene "
                "depend on the height of the ground. Orthorectify it first"
            )


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


def _centres(scene: Scene, squares: Sequence[Window]) -> Array:
    """Longitudes and latitudes (n, 2) of the centres of windows."""
    line_sample = np.array(
        [[one.line + one.lines / 2.0, one.sample + one.samples / 2.0] for one in squares]
    )
    return scene.model.locate(line_sample.reshape(-1, 2), np.zeros(len(squares)))[:, :2]


def _salient_corners(
    scene: Scene, heights: GroundHeights, square: Window, fine_m: float, options: OrthoPointOptions
) -> list[tuple[Array, float]]:
    """The salient corners of a square, the best first: lon, lat, height (3,) and saliency."""
    factor = max(1, int(fine_m / scene_gsd_m(scene)))
    corners = _strongest(block_means(scene.image.read(square), factor), options.candidates)
    line_sample = corners * factor + (factor - 1) / 2.0 + [square.line, square.sample]
    lon_lat = scene.model.locate(line_sample, np.zeros(len(corners)))[:, :2]
    lon_lat_h = np.column_stack([lon_lat, heights.at(lon_lat)])
    lon_lat_h = lon_lat_h[np.isfinite(lon_lat_h).all(axis=1)]
    whole = chip_inside(scene.model, scene.image.shape, lon_lat_h, fine_m)
    salient = [(ground, detail_saliency(scene, ground, fine_m)) for ground in lon_lat_h[whole]]
    salient = [corner for corner in salient if corner[1] >= options.min_saliency]
    return sorted(salient, key=lambda corner: -corner[1])


def _strongest(pixels: FloatImage, count: int) -> Array:
    """The strongest corners (n, 2), row and column, away from areas without data and saturated ones."""
    if not np.isfinite(pixels).any() or min(pixels.shape) < 8:
        return np.empty((0, 2))
    mask = cv2.erode(np.isfinite(bridged(pixels)).astype(np.uint8), np.ones((9, 9), np.uint8))
    col_row = cv2.goodFeaturesToTrack(
        filled(pixels), count, 0.01, _CORNER_DISTANCE_PX, mask=mask, blockSize=7
    )
    return np.empty((0, 2)) if col_row is None else col_row.reshape(-1, 2)[:, ::-1].astype(np.float64)
