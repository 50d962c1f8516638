"""Production of chips for the points of another base, cut from images at known ground."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from amers.services.errors import InputError, NotEnoughPoints
from amers.services.geodesy import box_around
from amers.services.imagery.scene import Scene, scene_gsd_m, view_direction
from amers.services.matching.multi_image import chip_inside
from amers.services.production.chip_sampling import chip_samplings_m
from amers.services.production.detail_points import detail_points, detail_saliency
from amers.services.production.point_views import check_image_names, chips_of
from amers.services.production.view_agreement import AgreedViews, agreed_views
from amers.services.statements import Statements
from amers.services.types import (
    Array,
    BoolArray,
    ChipArray,
    ControlPoints,
    Frame,
    GroundPoints,
    IntArray,
    Progress,
    StrArray,
    no_progress,
    part_of,
)

MIN_POINTS = 6
"""Fewest points of a block."""

NO_HEIGHT = "no height"
SAME_PLACE = "at the place of another point"
OUTSIDE = "no image shows the whole chip"
MISSING = "pixels of the chip are missing"
NOT_SALIENT = "not salient"
NOT_CONFIRMED = "not found in the other images"
"""Why a point is left out, in the order in which the points are judged."""
Reasons = npt.NDArray[np.object_]
"""(n,) of points; empty for those that are taken."""


@dataclass(frozen=True)
class KnownPointOptions:
    """How chips are cut for points of another base.

    Attributes:
        fine_gsd_m, coarse_gsd_m: ground samplings of the chips, metres; by default that of the coarsest
            image in two digits, and four times that.
        min_saliency: smallest saliency of a point's chip.
        min_views: smallest number of images in which a point must be found.
        local_sigma_px: position of a detail relative to the rest of its image, pixels of the image, one
            standard deviation a coordinate; several images raise it when they disagree by more.
    """

    fine_gsd_m: float | None = None
    coarse_gsd_m: float | None = None
    min_saliency: float = 0.05
    min_views: int = 2
    local_sigma_px: float = 0.3


@dataclass(frozen=True)
class KnownPoints:
    """Points of another base with chips.

    Attributes:
        points: as in `Production`.
        chips: from the row of a point to its chips, (views, 101, 101) uint16; 0 is nodata.
        gsds_m: ground samplings of the chips, finest first, metres.
        outline: (m, 2) lon, lat of a rectangle that contains the points, counter-clockwise, not closed.
        scenes: the images, with models that are shifted onto the earlier ones; none when the base has
            chips of its own.
        source_id: (n,) id of each point in its own base.
        left_out: number of points left out, by the reason.
        shift_m: (k, 2) east, north, by which each image lay off the earlier ones.
        local_sigma_m: horizontal error of details relative to the rest of their image, from the
            disagreement of the images; NaN where nothing shows it.
        statements: of the files, as far as the caller adds them.
    """

    points: ControlPoints
    chips: Callable[[int], ChipArray]
    gsds_m: tuple[float, ...]
    outline: Array
    scenes: list[Scene]
    source_id: StrArray
    left_out: dict[str, int]
    shift_m: Array
    local_sigma_m: float
    statements: Statements = ()


def produce_known_points(
    ground: GroundPoints,
    scenes: Sequence[Scene],
    frame: Frame,
    options: KnownPointOptions = KnownPointOptions(),
    progress: Progress = no_progress,
) -> KnownPoints:
    """The points of another base that images show, with chips of these images.

    A chip shows what the model of its image puts at the point. Its horizontal error is therefore that of
    the image: a local one, in the covariance of the point, and one that all points share, in the frame.
    A wrong height moves the content along the line of sight, so that the sigma of the height acts along
    that line. The horizontal sigmas of the base are added: they cover the position of its own detail.

    Args:
        ground: the points, all of them with sigmas.
        scenes: with registered models, or with the accuracy that is known of their models; the most
            accurate first.
        frame: error on the Earth that all points of the base share, NaN where unknown; that of the
            images is added.
        options: thresholds.
        progress: receives the fraction done.

    Raises:
        InputError: a point has no sigmas, two images have one name, or the samplings are wrong.
        NotEnoughPoints: too few points have chips; the message counts the others by their reason.
    """
    check_sigmas(ground)
    check_image_names(scenes)
    gsds_m = chip_samplings_m(scenes, options.fine_gsd_m, options.coarse_gsd_m)
    reason = reasons_of_places(ground, "")
    rows = np.flatnonzero(reason == "")
    at = ground.lon_lat_h[rows]
    agreed = agreed_views(scenes, at, gsds_m[0], progress=part_of(progress, 0.0, 0.7))
    saliency = _saliency(agreed, at, gsds_m[0], part_of(progress, 0.7, 0.3))
    reason[rows[~agreed.confirmed(options.min_views)]] = NOT_CONFIRMED
    reason[rows[saliency < options.min_saliency]] = NOT_SALIENT
    reason[rows[agreed.reference < 0]] = MISSING
    reason[rows[~_inside(scenes, at, gsds_m[0])]] = OUTSIDE
    left_out, taken = count_left_out(reason), np.flatnonzero(reason[rows] == "")
    sigma_m = ground.sigma_m[rows[taken]]
    covariance_m2 = _covariance_m2(sigma_m, at[taken], agreed, taken, options.local_sigma_px)
    frame = _frame_with_image(frame, agreed)
    points = detail_points(
        agreed, taken, at[taken], covariance_m2, saliency=saliency[taken], frame=frame, gsds_m=gsds_m
    )
    progress(1.0, f"{len(points)} points")
    return KnownPoints(
        points=points,
        chips=chips_of(agreed.scenes, points.lon_lat_h, points.views),
        gsds_m=gsds_m,
        outline=box_around(points.lon_lat_h),
        scenes=agreed.scenes,
        source_id=ground.id[rows[taken]],
        left_out=left_out,
        shift_m=agreed.shift_m,
        local_sigma_m=agreed.local_sigma_m,
    )


def _saliency(agreed: AgreedViews, lon_lat_h: Array, gsd_m: float, progress: Progress) -> Array:
    """The saliency (n,) of points (n, 3) in the first image that shows each; 0 where none does."""
    saliency = np.zeros(len(lon_lat_h))
    for number, image in enumerate(agreed.reference):
        if number % 64 == 0:
            progress(number / len(lon_lat_h), f"looking at {len(lon_lat_h)} points")
        if image >= 0:
            saliency[number] = detail_saliency(agreed.scenes[image], lon_lat_h[number], gsd_m)
    return saliency


def reasons_of_places(ground: GroundPoints, otherwise: str) -> Reasons:
    """Why points (n,) have no usable place; `otherwise` for those that have one."""
    reason = np.full(len(ground), otherwise, dtype=object)
    reason[_repeated_places(ground.lon_lat_h)] = SAME_PLACE
    reason[np.isnan(ground.lon_lat_h).any(axis=1)] = NO_HEIGHT
    return reason


def count_left_out(reason: Reasons) -> dict[str, int]:
    """The number of points left out by reason (n,), which is empty for those that are taken.

    Raises:
        NotEnoughPoints: fewer than `MIN_POINTS` are taken.
    """
    left_out = dict(Counter(reason[reason != ""].tolist()).most_common())
    taken = int((reason == "").sum())
    if taken < MIN_POINTS:
        counts = ", ".join(f"{count} {why}" for why, count in left_out.items())
        raise NotEnoughPoints(taken, MIN_POINTS, f"of {len(reason)} points: {counts}")
    return left_out


def check_sigmas(ground: GroundPoints) -> None:
    """Raise `InputError` when a point has no sigmas."""
    unknown = np.isnan(ground.sigma_m)
    if unknown.any():
        row = int(np.flatnonzero(unknown.any(axis=1))[0])
        axes = [name for axis, name in enumerate(("east", "north", "up")) if unknown[:, axis].any()]
        raise InputError(
            f"{int(unknown.any(axis=1).sum())} of {len(ground)} points, such as {ground.id[row]}, have "
            f"no sigma {', '.join(axes)}: state it (--point-sigma-m HORIZONTAL,UP); for an ASP file, "
            "state the axes of its sigmas (--sigma-axes) where you know them"
        )


def _inside(scenes: Sequence[Scene], lon_lat_h: Array, gsd_m: float) -> BoolArray:
    """Which points (n, 3) have their chip inside an image."""
    inside = np.zeros(len(lon_lat_h), dtype=bool)
    for scene in scenes:
        inside |= chip_inside(scene.model, scene.image.shape, lon_lat_h, gsd_m)
    return inside


def _repeated_places(lon_lat_h: Array) -> BoolArray:
    """Which points (n, 3) have the place of an earlier one."""
    first = np.unique(lon_lat_h, axis=0, return_index=True)[1]
    repeated = np.ones(len(lon_lat_h), dtype=bool)
    repeated[first] = False
    return repeated


def _covariance_m2(
    sigma_m: Array, lon_lat_h: Array, agreed: AgreedViews, rows: IntArray, local_sigma_px: float
) -> Array:
    """Covariances (n, 3, 3): sigmas of the base, that of heights along the line of sight, of images."""
    up = np.zeros((len(rows), 3))
    up[:, 2] = 1.0
    local_m = np.zeros(len(rows))
    for image in np.unique(agreed.reference[rows]):
        scene = agreed.scenes[image]
        of_image = agreed.reference[rows] == image
        ground = lon_lat_h[of_image]
        incidence, azimuth = view_direction(scene.model, scene.model.project(ground), ground)
        slope = np.tan(np.radians(incidence))
        up[of_image, 0] = slope * np.sin(np.radians(azimuth))
        up[of_image, 1] = slope * np.cos(np.radians(azimuth))
        local_m[of_image] = max(
            scene_gsd_m(scene) * local_sigma_px, float(np.nan_to_num(agreed.local_sigma_m))
        )
        if not agreed.tied.all():  # The images have errors of their own, which are not those of a frame.
            local_m[of_image] = np.hypot(local_m[of_image], scene.sigma_m * agreed.disagreement)
    horizontal_m2 = sigma_m[:, :2] ** 2 + local_m[:, None] ** 2
    covariance = sigma_m[:, 2, None, None] ** 2 * up[:, :, None] * up[:, None, :]
    covariance[:, [0, 1], [0, 1]] += horizontal_m2
    return covariance


def _frame_with_image(frame: Frame, agreed: AgreedViews) -> Frame:
    """The frame of the base with the error of the images, where they have one in common."""
    if not agreed.tied.all():
        return frame
    image_m = agreed.scenes[0].sigma_m * agreed.disagreement
    of_images = np.diag([image_m**2, image_m**2, 0.0])
    return replace(frame, covariance_m2=frame.covariance_m2 + of_images)
