"""Leave-out series: errors at known ground by number of control points, images and their base.

The configurations are those of Toutin and Carbonneau (1992, Multi-stereoscopy for the correction of
SPOT-HRV images): one image with known heights, pairs, and all images, on more and more control points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from amers.services.adjustment.block_problem import BlockOptions
from amers.services.adjustment.bundle import adjust_block
from amers.services.adjustment.control_ground import ControlGround
from amers.services.adjustment.intersected_marks import EXACT_MODEL, intersect_marks
from amers.services.adjustment.parameters import AdjustableImage
from amers.services.errors import ComputationError, NotEnoughPoints
from amers.services.geodesy import metres_per_degree_at
from amers.services.quality.known_ground import ground_errors, residual_parallaxes_m
from amers.services.sensors.base import SensorModel
from amers.services.types import Array, BoolArray, Frame, IntArray, Observations, Progress, no_progress

FEWEST_CHECKED = 3
"""Check points that are left at least."""
_ALL_SUBSETS = 3
"""Of up to so many images, all subsets are tried: more make single images, pairs, and all of them."""
_FRAME = Frame.from_sigmas(1e-3, 1e-3)
"""Control and check points have the same frame, which no error of theirs shows: a millimetre."""


@dataclass(frozen=True)
class MarkedGroundPoints:
    """n points marked in k images, on ground that is known of some.

    Attributes:
        names: of the points.
        known: (n, 3); NaN where unknown: such points tie images.
        sigma_m: (n, 3) of known ground, east, north, up.
        marks: by point.
        images: with what may move in each.
        models: of the images, as delivered.
        gsd_m: (k,) ground sampling of the images.
    """

    names: tuple[str, ...]
    known: Array
    sigma_m: Array
    marks: Observations
    images: tuple[AdjustableImage, ...]
    models: tuple[SensorModel, ...]
    gsd_m: Array

    @property
    def usable(self) -> IntArray:
        """Rows of the points of known ground that every image shows."""
        shown = np.bincount(self.marks.point, minlength=len(self.names)) == len(self.images)
        return np.flatnonzero(shown & np.isfinite(self.known).all(axis=1))


@dataclass(frozen=True)
class SeriesRow:
    """The errors of check points with some images on some control points, over all draws.

    Attributes:
        images: their rows.
        base_to_height: largest of two of them; 0 for one image.
        control: number of control points.
        checked: errors of check points, over all draws.
        rms_m: (3,) east, north, up; NaN for up with one image, whose heights are taken as known.
        parallax_m: (2,) residual parallaxes along lines and samples; NaN with one image.
        worst: row of the point with the largest error.
        worst_m: that error.
        reason: why no draw gave a result; "" where one did.
    """

    images: tuple[int, ...]
    base_to_height: float
    control: int
    checked: int
    rms_m: Array
    parallax_m: Array
    worst: int
    worst_m: float
    reason: str = ""


def control_series(
    points: MarkedGroundPoints,
    counts: Sequence[int],
    draws: int,
    rng: np.random.Generator,
    progress: Progress = no_progress,
) -> list[SeriesRow]:
    """Errors of check points by images and number of control points.

    Control points of a draw are as far from each other as possible, from one by chance. All other points
    of known ground that every image shows are check points, the same for all images. Points of unknown
    ground tie images; marks of check points have no part in any adjustment.

    Args:
        points: marked.
        counts: numbers of control points; 0 for the models as delivered.
        draws: of control points.
        rng: source of the draws.
        progress: receives the fraction done and a message.

    Raises:
        NotEnoughPoints: too few points are known and shown by every image.
    """
    usable = points.usable
    fits = [count for count in counts if count + FEWEST_CHECKED <= len(usable)]
    if not fits:
        raise NotEnoughPoints(
            len(usable),
            min(counts) + FEWEST_CHECKED,
            "points of known ground that every image shows are counted: give images that share marks",
        )
    starts = rng.choice(usable, draws, replace=draws > len(usable))
    order = [_spread(points.known, usable, int(start), max(fits)) for start in starts]
    configurations = [(members, count) for members in _subsets(len(points.images)) for count in fits]
    rows = []
    for number, (members, count) in enumerate(configurations):
        message = f"{len(members)} images on {count} control points"
        progress(number / len(configurations), message)
        rows.append(_row(points, members, count, order))
    return rows


def _subsets(count: int) -> list[tuple[int, ...]]:
    sizes = range(1, count + 1) if count <= _ALL_SUBSETS else (1, 2, count)
    return [members for size in sizes for members in combinations(range(count), size)]


def _spread(known: Array, usable: IntArray, start: int, count: int) -> IntArray:
    """Points (count,) from a first one on, each as far from those before it as possible."""
    place = known[usable, :2] * metres_per_degree_at(known[usable][:1])
    chosen = [int(np.flatnonzero(usable == start)[0])]
    apart = np.linalg.norm(place - place[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(place - place[chosen[-1]], axis=1))
    return usable[chosen]


def _row(
    points: MarkedGroundPoints, members: tuple[int, ...], count: int, order: Sequence[IntArray]
) -> SeriesRow:
    """All draws of one configuration; those that cannot be adjusted are left out."""
    errors, parallaxes, rows, reason, base = [], [], [], "", 0.0
    for drawn in order if count else order[:1]:
        control = np.sort(drawn[:count])
        try:
            models = _adjusted(points, members, control)
        except ComputationError as error:
            reason = str(error)
            continue
        except np.linalg.LinAlgError:
            reason = "these points do not determine the models"
            continue
        checked = np.setdiff1d(points.usable, control)
        error_m, parallax_m, base = _errors(points, members, models, checked)
        errors.append(error_m)
        parallaxes.append(parallax_m)
        rows.append(checked)
    if not errors:
        unknown = np.full(3, np.nan)
        return SeriesRow(members, np.nan, count, 0, unknown, unknown[:2], -1, np.nan, reason)
    every, point = np.concatenate(errors), np.concatenate(rows)
    met = np.isfinite(every[:, 0])
    every, point = every[met], point[met]
    length_m = np.sqrt(np.nansum(every**2, axis=1))
    return SeriesRow(
        images=members,
        base_to_height=base,
        control=count,
        checked=len(every),
        rms_m=np.sqrt(np.mean(every**2, axis=0)),
        parallax_m=np.sqrt(np.mean(np.array(parallaxes) ** 2, axis=0)),
        worst=int(point[np.argmax(length_m)]),
        worst_m=float(length_m.max()),
    )


def _adjusted(
    points: MarkedGroundPoints, members: tuple[int, ...], control: IntArray
) -> Sequence[SensorModel]:
    """The models of images on control points and tie points; as delivered without control."""
    if not len(control):
        return [points.models[k] for k in members]
    ties = np.flatnonzero(np.isnan(points.known[:, 0])) if len(members) > 1 else control[:0]
    used = np.sort(np.concatenate([control, ties]))
    marks = _of(points.marks, members, used)
    several = np.bincount(marks.point, minlength=len(used)) >= 2
    marks = marks.take(several[marks.point] | np.isin(used[marks.point], control))
    kept, number = np.unique(marks.point, return_inverse=True)
    ground = ControlGround(
        point=np.searchsorted(used[kept], control),
        lon_lat_h=points.known[control],
        covariance_m2=points.sigma_m[control][:, None, :] ** 2 * np.eye(3),
        source=np.zeros(len(control), dtype=np.int64),
        frames=(_FRAME,),
        names=tuple(points.names[row] for row in control.tolist()),
        by_hand=np.ones(len(control), dtype=np.bool_),
    )
    return adjust_block(
        [points.images[k] for k in members],
        replace(marks, point=number.astype(np.int64)),
        control=ground,
        options=BlockOptions(min_points=0),
    ).models


def _of(marks: Observations, members: Sequence[int], points: IntArray) -> Observations:
    """The marks of some points in some images, in the numbers of these; points ascending."""
    rows: BoolArray = np.isin(marks.image, members) & np.isin(marks.point, points)
    own = marks.take(rows)
    image = np.searchsorted(np.array(members), own.image).astype(np.int64)
    return replace(own, point=np.searchsorted(points, own.point).astype(np.int64), image=image)


def _errors(
    points: MarkedGroundPoints,
    members: tuple[int, ...],
    models: Sequence[SensorModel],
    checked: IntArray,
) -> tuple[Array, Array, float]:
    """Errors (c, 3) of check points, their parallaxes (2,) and the base over height."""
    marks, known = _of(points.marks, members, checked), points.known[checked]
    if len(members) == 1:
        found = models[0].locate(marks.line_sample, known[:, 2])
        errors = ground_errors(
            found, np.zeros((len(checked), 3, 3)), known, np.ones_like(known), _all(checked)
        )
        return errors.error_m * [1.0, 1.0, np.nan], np.full(2, np.nan), 0.0
    met = intersect_marks(models, [EXACT_MODEL] * len(members), marks, len(checked))
    errors = ground_errors(met.lon_lat_h, met.marks_m2, known, points.sigma_m[checked], _all(checked))
    residual_m = met.residual_px * points.gsd_m[list(members)][marks.image][:, None]
    parallax_m = residual_parallaxes_m(residual_m, marks.point, met.used)
    return errors.error_m, parallax_m, float(np.nanmedian(met.base_to_height))


def _all(rows: IntArray) -> BoolArray:
    return np.ones(len(rows), dtype=np.bool_)
