"""Alignment of several images of the same ground, and the views of points that agree."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amers.services.conventions import CHIP_SIZE
from amers.services.errors import AmersError, NotEnoughPoints
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import render_chip
from amers.services.matching.correlate import FOUND, find_chip
from amers.services.matching.multi_image import RefinementOptions, chip_inside, nearly_whole
from amers.services.sensors.base import SensorModel
from amers.services.sensors.correction import CorrectedModel, fold_into_rpc, no_correction
from amers.services.sensors.ortho import OrthoModel, fold_into_ortho
from amers.services.sensors.rpc import RpcModel
from amers.services.tasks import Arrays, Work
from amers.services.types import Array, BoolArray, IntArray, Observations, Progress, no_progress

_SEARCH = RefinementOptions()
"""How the chip of one image is searched in another one."""
_MIN_COMMON = 6
"""Fewest points in common that show the shift between two images."""
_MIN_MEASURES = 20
"""Fewest measures that show the local errors of images."""
_SAMPLE = 40
"""Number of points that show the shift of an image within its stated accuracy."""
_FIRST_REACH_PX = 60
"""Largest search radius for this shift: chips are made coarser for a larger one."""
_CONSENSUS_PX = 2.0
"""Displacements this close to each other agree."""
_MAX_DEVIATION = 4.0
"""Largest deviation of a view from the shift of its image, in standard deviations."""
_OF_TASK = 64
"""Points of a task."""
_NORMAL_MAD = 1.4826
"""Standard deviation of a normal law over its median absolute deviation."""


@dataclass(frozen=True)
class AgreedViews:
    """What several images show of n points.

    Attributes:
        scenes: the images, with models that are shifted onto the earlier ones.
        views: which images show which points where the point was found; `point` is ascending, and the
            reference view of a point is its first.
        reference: (n,) the first image that shows the whole chip of each point; -1 where none does.
        shown_by: (n,) number of images that show the whole chip.
        shift_m: (k, 2) east, north, by which each image lay off the earlier ones.
        tied: (k,) whether an image was brought onto the earlier ones; false where it shows fewer than
            six of their points.
        local_sigma_m: horizontal error of details relative to the rest of their image, a coordinate,
            from the disagreement of the images; NaN when fewer than 20 measures show it.
    """

    scenes: list[Scene]
    views: Observations
    reference: IntArray
    shown_by: IntArray
    shift_m: Array
    tied: BoolArray
    local_sigma_m: float

    def confirmed(self, min_views: int, min_share: float = 0.0) -> BoolArray:
        """Which points (n,) were found in `min_views` images, or in all that show them.

        Args:
            min_views: number of images.
            min_share: share (0 to 1) of the images that show a point, in which it must be found too.
        """
        found_in = np.bincount(self.views.point, minlength=len(self.reference))
        enough = np.maximum(np.minimum(min_views, self.shown_by), min_share * self.shown_by)
        return np.asarray((self.reference >= 0) & (found_in >= enough))

    def take(self, rows: IntArray) -> Observations:
        """The views of some points, ascending rows, numbered from 0."""
        views = self.views.take(np.isin(self.views.point, rows))
        return replace(views, point=np.searchsorted(rows, views.point))

    @property
    def disagreement(self) -> float:
        """Largest shift of an image over what both images state, 1 at least: their sigmas times this."""
        first_m = self.scenes[0].sigma_m
        stated_m = [math.hypot(first_m, scene.sigma_m) * math.sqrt(2.0) for scene in self.scenes]
        ratio = np.linalg.norm(self.shift_m, axis=1) / np.array(stated_m)
        return max(1.0, float(ratio[1:].max(initial=0.0)))


def refuse(error: AmersError) -> None:
    """Raise an error."""
    raise error


def agreed_views(
    scenes: Sequence[Scene],
    lon_lat_h: Array,
    gsd_m: float,
    progress: Progress = no_progress,
    not_found: Callable[[AmersError], None] = refuse,
    *,
    work: Work | None = None,
) -> AgreedViews:
    """The views of points in several images, of which the first that shows a point defines its detail.

    The chip of the first image is searched in each later one, which is shifted by the median
    displacement. Points whose displacement differs from it by more than four standard deviations are not
    views. When the errors of two images are independent and of one size, the variance of their
    displacements is twice that of one image.

    Args:
        scenes: the most accurate first; names differ.
        lon_lat_h: (n, 3) the points.
        gsd_m: ground sampling of the chips, metres.
        progress: receives the fraction done.
        not_found: receives the error of an image in which points are not found: by default it is raised;
            otherwise the image gives no views.
        work: computes chips and displacements; by default here.

    Raises:
        NotEnoughPoints: an image shows the points of earlier ones, but they are not found in it.
    """
    work = work or Work()
    whole = _whole_chips(scenes, lon_lat_h, gsd_m, work)
    reference = np.where(whole.any(axis=0), np.argmax(whole, axis=0), -1).astype(np.int64)
    search = _Search(list(scenes), reference, lon_lat_h, work)
    shift_m, tied = np.zeros((len(scenes), 2)), np.arange(len(scenes)) == 0
    pairs = [(int(row), int(image)) for row, image in enumerate(reference) if image >= 0]
    measures, variance_sum_m2 = 0, 0.0
    for k in range(1, len(scenes)):
        progress(k / len(scenes), f"searching points in {scenes[k].acquisition.image_id}")
        rows = np.flatnonzero(whole[k] & (reference < k))
        if len(rows) < _MIN_COMMON:
            continue
        try:
            shift_m[k], agreeing, sigma_m = search.agreement(scenes[k], rows, gsd_m)
        except NotEnoughPoints as error:
            not_found(error)
            continue
        tied[k] = True
        search.placed[k] = _moved(scenes[k], lon_lat_h[rows], shift_m[k])
        pairs += [(int(row), k) for row in agreeing]
        measures += len(agreeing)
        variance_sum_m2 += len(agreeing) * (sigma_m**2 / 2.0)
    pairs.sort()
    point, image = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    line_sample = np.array(
        [search.placed[i].model.project(lon_lat_h[p][None, :])[0] for p, i in pairs], dtype=np.float64
    ).reshape(-1, 2)
    return AgreedViews(
        scenes=search.placed,
        views=Observations(point, image, line_sample, np.full(len(point), np.nan)),
        reference=reference,
        shown_by=whole.sum(axis=0).astype(np.int64),
        shift_m=shift_m,
        tied=tied,
        local_sigma_m=math.sqrt(variance_sum_m2 / measures) if measures >= _MIN_MEASURES else math.nan,
    )


def _whole_chips(scenes: Sequence[Scene], lon_lat_h: Array, gsd_m: float, work: Work) -> BoolArray:
    """Which images show the whole chips of which points (k, n), at most a tenth of it missing."""
    parts = _parts(len(lon_lat_h))
    tasks = [(scene, lon_lat_h[part], gsd_m) for scene in scenes for part in parts]
    whole = [one["whole"] for one in work.results("chips", whole_task, tasks)]
    return np.concatenate([np.empty(0, dtype=np.bool_), *whole]).reshape(len(scenes), len(lon_lat_h))


def whole_task(scene: Scene, lon_lat_h: Array, gsd_m: float) -> Arrays:
    """Whether an image shows the whole chips (n,) of points (n, 3)."""
    whole = chip_inside(scene.model, scene.image.shape, lon_lat_h, gsd_m)
    for row in np.flatnonzero(whole):
        chip = render_chip(scene.image, scene.model, lon_lat_h[row], gsd_m)
        whole[row] = nearly_whole(chip)
    return {"whole": whole}


def displacement_task(
    first: Scene, scene: Scene, lon_lat_h: Array, gsd_m: float, radius_px: int
) -> Arrays:
    """The rows (m,) of points (n, 3) of one image that are found in another, and where.

    Displacements (m, 2) are metres east and north of their place. Distances of the search are pixels of
    the chips, whose ground sampling is in metres.
    """
    found, off_m = [], []
    for row, ground in enumerate(lon_lat_h):
        patch = render_chip(scene.image, scene.model, ground, gsd_m, CHIP_SIZE + 2 * radius_px)
        chip = render_chip(first.image, first.model, ground, gsd_m)
        peak = find_chip(patch, chip, _SEARCH.correlation)
        if peak.reason == FOUND:
            found.append(row)
            off_m.append((peak.row_col[1] * gsd_m, -peak.row_col[0] * gsd_m))
    return {
        "row": np.array(found, dtype=np.int64),
        "off_m": np.array(off_m, dtype=np.float64).reshape(-1, 2),
    }


def _parts(count: int) -> list[slice]:
    """The points of every task."""
    return [slice(first, first + _OF_TASK) for first in range(0, count, _OF_TASK)]


@dataclass(frozen=True)
class _Search:
    """Points searched in later images: the images in their places so far, the image of each point."""

    placed: list[Scene]
    reference: IntArray
    lon_lat_h: Array
    work: Work

    def agreement(self, scene: Scene, rows: IntArray, gsd_m: float) -> tuple[Array, IntArray, float]:
        """Where a later image lies (2,), the rows that agree (m,), and their standard deviation.

        The position is metres east and north of the earlier images; the standard deviation is that of
        the displacements, a coordinate.
        """
        first_m = self.first_shift(scene, rows, gsd_m)
        moved = _moved(scene, self.lon_lat_h[rows], first_m)
        found, off_m = self.displacements(moved, rows, gsd_m, _SEARCH.radius_px)
        if len(found) < _MIN_COMMON:
            raise _not_found(scene, len(found), len(rows))
        median_m = np.median(off_m, axis=0)
        residual_m = off_m - median_m
        sigma_m = max(_NORMAL_MAD * float(np.median(np.abs(residual_m))), _SEARCH.min_sigma_px * gsd_m)
        agrees = np.linalg.norm(residual_m, axis=1) <= _MAX_DEVIATION * sigma_m
        return first_m + median_m, found[agrees], sigma_m

    def first_shift(self, scene: Scene, rows: IntArray, gsd_m: float) -> Array:
        """Displacement (2,) east, north of an image within its stated accuracy, metres."""
        sigmas_m = [self.placed[i].sigma_m for i in np.unique(self.reference[rows])]
        reach_m = 3.0 * math.hypot(max(sigmas_m), scene.sigma_m)
        coarse_m = max(gsd_m, reach_m / _FIRST_REACH_PX)
        radius_px = math.ceil(reach_m / coarse_m) + _SEARCH.radius_px
        sample = rows[np.linspace(0, len(rows) - 1, min(_SAMPLE, len(rows))).astype(np.int64)]
        found, off_m = self.displacements(scene, sample, coarse_m, radius_px)
        if len(found) < _MIN_COMMON:
            raise _not_found(scene, len(found), len(sample))
        distance_m = np.linalg.norm(off_m[:, None] - off_m[None, :], axis=2)
        agreeing = distance_m <= _CONSENSUS_PX * coarse_m
        best = agreeing[np.argmax(agreeing.sum(axis=1))]
        if best.sum() < max(_MIN_COMMON, len(found) / 2.0):
            raise _not_found(scene, int(best.sum()), len(sample))
        return np.asarray(off_m[best].mean(axis=0))

    def displacements(
        self, scene: Scene, rows: IntArray, gsd_m: float, radius_px: int
    ) -> tuple[IntArray, Array]:
        """The points found (m,) of some rows, and where (m, 2): metres east and north of their place."""
        parts, tasks = [], []
        for image in np.unique(self.reference[rows]).tolist():
            of_image = rows[self.reference[rows] == image]
            for part in _parts(len(of_image)):
                parts.append(of_image[part])
                ground = self.lon_lat_h[of_image[part]]
                tasks.append((self.placed[image], scene, ground, gsd_m, radius_px))
        results = self.work.results("search", displacement_task, tasks)
        found = np.concatenate([part[one["row"]] for part, one in zip(parts, results, strict=True)])
        order = np.argsort(found)
        return found[order], np.concatenate([one["off_m"] for one in results])[order]


def _moved(scene: Scene, lon_lat_h: Array, shift_m: Array) -> Scene:
    """A scene that shows at each point what it showed at a distance (2,) east, north of it."""
    step = np.tile([*shift_m, 0.0], (len(lon_lat_h), 1))
    off_px = scene.model.project(move_metres(lon_lat_h, step)) - scene.model.project(lon_lat_h)
    return replace(scene, model=_shifted(scene.model, scene.image.shape, off_px.mean(axis=0)))


def _shifted(model: SensorModel, shape: tuple[int, int], shift_px: Array) -> SensorModel:
    correction = no_correction(shape)
    parameters = correction.parameters.copy()
    parameters[:, 0] = shift_px
    correction = replace(correction, parameters=parameters)
    if isinstance(model, OrthoModel):
        return fold_into_ortho(model, correction)
    if isinstance(model, RpcModel):
        return fold_into_rpc(model, correction)
    return CorrectedModel(model, correction)


def _not_found(scene: Scene, found: int, tried: int) -> NotEnoughPoints:
    return NotEnoughPoints(
        found,
        _MIN_COMMON,
        f"{tried} points of the earlier images lie in {scene.acquisition.image_id}, and {found} of them "
        "agree there: it shows other ground, is covered, or lies farther off than its accuracy "
        f"states ({scene.sigma_m:g} m); leave it out or state another accuracy (--sigma-m)",
    )
