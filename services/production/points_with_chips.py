"""Conversion of the points of another base, with their own chips, to points of a block."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from amers.services.conventions import CHIP_CENTRE
from amers.services.errors import FormatError
from amers.services.geodesy import box_around
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import image_gsd_m, render_chip
from amers.services.matching.multi_image import nearly_whole, stored_chip
from amers.services.production.detail_points import detail_saliency
from amers.services.production.points_production import (
    MISSING,
    NOT_SALIENT,
    KnownPointOptions,
    KnownPoints,
    Reasons,
    check_sigmas,
    count_left_out,
    reasons_of_places,
)
from amers.services.types import (
    Acquisition,
    Array,
    ChipArray,
    ControlPoints,
    Frame,
    GroundPoints,
    IntArray,
    Progress,
    StrArray,
    Views,
    no_progress,
    part_of,
)

NO_CHIP = "it has no chip"
NOT_SHOWN = "its chip does not show its place"
_FULL_SHARE = 0.9
"""Share of the chips that fill the square of a chip at the ground sampling of the block."""


@dataclass(frozen=True)
class OwnChips:
    """The m chips of a base.

    Attributes:
        point_id: (m,) ids of their points.
        image: (m,) rows of `images`.
        images: what the base says about where its chips come from.
        open: the chip of a number as a small ortho-image, or why it is not used.
    """

    point_id: StrArray
    image: IntArray
    images: tuple[Acquisition, ...]
    open: Callable[[int], Scene | str]


def produce_points_with_chips(
    ground: GroundPoints, chips: OwnChips, frame: Frame, progress: Progress = no_progress
) -> KnownPoints:
    """The points of another base with their own chips, resampled to one ground sampling.

    The chips of a base are smaller than those of a block, at a coarser sampling. The block gets the
    sampling at which nine tenths of them fill a chip, not coarser than their own. The position is that
    of the base with its sigmas: the chip shows the detail that the base means.

    Args:
        ground: the points, all of them with sigmas.
        chips: of the points; those of other points are not used.
        frame: error on the Earth that all points of the base share, NaN where unknown.
        progress: receives the fraction done.

    Raises:
        InputError: a point has no sigmas.
        NotEnoughPoints: too few points have a chip; the message counts the others by their reason.
    """
    check_sigmas(ground)
    judged = _judged(ground, chips, progress)
    good, gsd_m = judged.good, judged.gsd_m
    taken, first, count = np.unique(judged.row[good], return_index=True, return_counts=True)
    judged.reason[taken] = ""
    left_out = count_left_out(judged.reason)
    lon_lat_h = ground.lon_lat_h[taken]
    points = ControlPoints(
        id=np.arange(len(taken), dtype=np.int64),
        lon_lat_h=lon_lat_h,
        covariance_m2=ground.sigma_m[taken, :, None] ** 2 * np.eye(3),
        block=np.zeros(len(taken), dtype=np.int64),
        frames=(frame,),
        saliency=np.maximum.reduceat(judged.saliency[good], first),
        health=np.ones(len(taken)),
        views=_views(chips, good, first, gsd_m),
        chip_file=np.zeros(len(taken), dtype=np.int64),
        chip_row=first.astype(np.int64),
        chip_files=("chips",),
    )

    def cut(point: int) -> ChipArray:
        of_point = good[first[point] : first[point] + count[point]]
        return np.stack([_cut(chips, int(k), lon_lat_h[point], gsd_m) for k in of_point])

    progress(1.0, f"{len(points)} points")
    return KnownPoints(
        points=points,
        chips=cut,
        gsds_m=(gsd_m,),
        outline=box_around(lon_lat_h),
        scenes=[],
        source_id=ground.id[taken],
        left_out=left_out,
        shift_m=np.zeros((0, 2)),
        local_sigma_m=math.nan,
    )


@dataclass(frozen=True)
class _Judged:
    """The m chips and n points of a base, judged.

    Attributes:
        row: (m,) of the point of each chip; -1 for none.
        gsd_m: ground sampling at which most chips are whole.
        saliency: (m,) NaN for chips that are not used.
        good: chips that are used, one of each image for a point; point by point.
        reason: (n,) why a point has no chip, or what is wrong with one.
    """

    row: IntArray
    gsd_m: float
    saliency: Array
    good: IntArray
    reason: Reasons


def _judged(ground: GroundPoints, chips: OwnChips, progress: Progress) -> _Judged:
    """Every chip opened twice: for the ground sampling that suits most, and at that sampling."""
    reason = reasons_of_places(ground, NO_CHIP)
    row_of = {name: row for row, name in enumerate(ground.id.tolist()) if reason[row] == NO_CHIP}
    row = np.array([row_of.get(name, -1) for name in chips.point_id.tolist()], dtype=np.int64)
    place = ground.lon_lat_h[row]
    tried = np.flatnonzero(row >= 0).tolist()
    reading = part_of(progress, 0.0, 0.4)
    own = {k: _own_gsd_m(chips.open(k), place[k]) for k in _told(tried, reading, "reading")}
    gsd_m = _common_gsd_m([gsd for gsd in own.values() if not isinstance(gsd, str)])
    judging = part_of(progress, 0.4, 0.6)
    saliency = np.full(len(row), np.nan)
    for k in _told(tried, judging, "looking at"):
        found = own[k]
        if not isinstance(found, str):
            found = _saliency(chips.open(k), place[k], gsd_m)
        if isinstance(found, str):
            reason[row[k]] = found
        else:
            saliency[k] = found
    good = np.flatnonzero(np.isfinite(saliency))
    good = good[np.unique([row[good], chips.image[good]], axis=1, return_index=True)[1]]
    return _Judged(row, gsd_m, saliency, good, reason)


def _views(chips: OwnChips, good: IntArray, first: IntArray, gsd_m: float) -> Views:
    """The views that chips `good` are, of points of which each begins at `first`."""
    used, image = np.unique(chips.image[good], return_inverse=True)
    vertical = np.zeros(len(good))
    return Views(
        start=np.append(first, len(good)).astype(np.int64),
        gsd_m=np.full(len(good), gsd_m),
        image=image.astype(np.int64),
        incidence_deg=vertical,
        azimuth_deg=vertical,
        health=np.ones(len(good)),
        images=tuple(chips.images[i] for i in used),
    )


def _told(numbers: list[int], progress: Progress, what: str) -> Iterator[int]:
    """The numbers of chips, one after the other, with progress."""
    for count, number in enumerate(numbers):
        if count % 256 == 0:
            progress(count / len(numbers), f"{what} {len(numbers)} chips")
        yield number


def _own_gsd_m(scene: Scene | str, place: Array) -> float | str:
    """The largest ground sampling at which the chip of a point (3,) is whole, at most that of the image;
    or why there is none."""
    if isinstance(scene, str):
        return scene
    line_sample = scene.model.project(place[None, :])[0]
    per_metre = np.abs(scene.model.project_derivative(place[None, :])[0, :, :2]).sum(axis=1)
    room_px = np.minimum(line_sample, np.array(scene.image.shape) - 1.0 - line_sample)
    full_m = float((room_px / (CHIP_CENTRE * per_metre)).min())
    return min(full_m, image_gsd_m(scene.model, place)) if full_m > 0.0 else NOT_SHOWN


def _common_gsd_m(gsds_m: list[float]) -> float:
    """The ground sampling at which most chips are whole, in three digits; NaN without any."""
    if not gsds_m:
        return math.nan
    gsd_m = float(np.quantile(gsds_m, 1.0 - _FULL_SHARE, method="lower"))
    digit_m = 10.0 ** (math.floor(math.log10(gsd_m)) - 2)
    return float(f"{math.floor(gsd_m / digit_m) * digit_m:.3g}")


def _saliency(scene: Scene | str, place: Array, gsd_m: float) -> float | str:
    """The saliency of the chip of a point (3,), or why it is left out."""
    if isinstance(scene, str):
        return scene
    if not nearly_whole(render_chip(scene.image, scene.model, place, gsd_m)):
        return MISSING
    saliency = detail_saliency(scene, place, gsd_m)
    return saliency if saliency >= KnownPointOptions.min_saliency else NOT_SALIENT


def _cut(chips: OwnChips, number: int, place: Array, gsd_m: float) -> ChipArray:
    scene = chips.open(number)
    if isinstance(scene, str):
        raise FormatError(f"point {chips.point_id[number]}: {scene}, and before it was: start again")
    return stored_chip(render_chip(scene.image, scene.model, place, gsd_m))
