"""Control from an elevation model: the heights of points of a block on smooth, open ground."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from amers.services.adjustment.control_ground import ControlGround
from amers.services.errors import NotEnoughPoints
from amers.services.geodesy import move_metres
from amers.services.imagery.scene import Scene
from amers.services.matching.multi_image import seen_whole
from amers.services.matching.surface_heights import surface_height
from amers.services.production.ground_parts import image_parts
from amers.services.production.ortho_control import place_names
from amers.services.sensors.correction import CorrectedModel
from amers.services.sensors.ortho import OrthoModel
from amers.services.tasks import Arrays, Work
from amers.services.terrain import Terrain
from amers.services.types import Array, Frame, Observations, Progress, SurfaceHeights

_PER_SIDE = 7
"""Heights along each side of the square around a point."""
_FRAME_SIGMAS = 2.0
"""Half of the square around a point, in standard deviations of its place."""
_FILLED = 0.5
"""Smallest share of the square where the model has heights."""
_STEEPEST = 0.4
"""Largest slope of the ground at a point."""
_ROUGHEST = 2.0
"""Largest deviation of the ground from a plane, root mean square, in sigmas of its heights."""
_MOST = 400
"""Points that take part: those with the smallest sigmas first."""
_MIN_FOUND = 3


@dataclass(frozen=True)
class ControlHeights:
    """An elevation model that gives a block its heights.

    Attributes:
        name: for messages and reports.
        terrain: heights of the ground, or of the surface; their sigma is independent from point to
            point.
        frame: error that all of them share: position of the model, and its heights.
    """

    name: str
    terrain: Terrain
    frame: Frame


def surfaces_above(
    scenes: Sequence[Scene], lon_lat_h: Array, gsd_m: float, work: Work, progress: Progress
) -> SurfaceHeights:
    """The surface at points (n, 3), metres above each; unknown where it is not smooth.

    The height of a point is that of the content of its chip, an average over roofs and trees. An
    elevation model has the surface, or the ground.
    """
    parts, images = image_parts(scenes, lon_lat_h)

    def arguments(number: int) -> tuple[Any, ...]:
        return [scenes[i] for i in images[number]], lon_lat_h[parts[number]], gsd_m

    names = [f"control_heights/{number:06d}" for number in range(len(parts))]
    work.run(surface_task, [(name, partial(arguments, i)) for i, name in enumerate(names)], progress)
    found = [work.kept[name] for name in names]
    return SurfaceHeights(
        np.concatenate([one["above_m"] for one in found]),
        np.concatenate([one["sigma_m"] for one in found]),
    )


def surface_task(scenes: Sequence[Scene], lon_lat_h: Array, gsd_m: float) -> Arrays:
    """The surface at the points of one part."""
    above_m, sigma_m = np.full(len(lon_lat_h), np.nan), np.full(len(lon_lat_h), np.nan)
    for row, seen_by in enumerate(seen_whole(scenes, lon_lat_h, gsd_m)):
        if len(seen_by) >= 2:
            own = [scenes[i] for i in seen_by]
            above_m[row], sigma_m[row] = surface_height(own, lon_lat_h[row], gsd_m)
    return {"above_m": above_m, "sigma_m": sigma_m}


def known_heights(
    lon_lat_h: Array, above: SurfaceHeights, place_sigma_m: float, heights: ControlHeights
) -> ControlGround:
    """The points of a block on smooth ground, with the heights of an elevation model.

    At each point the model has the height of the surface, and the point lies as far from it as the
    images show. Block and model may lie off each other: the ground around a point is a plane, and what
    deviates from it is in the sigma. Of the error that its slope makes, the part of the mean slope is
    shared by all points, hence in the frame. Nothing is told of the position.

    Args:
        lon_lat_h: (n, 3) the points.
        above: surface at the points, relative to their heights.
        place_sigma_m: of their positions east and north on the Earth, one standard deviation.
        heights: of the ground.

    Raises:
        NotEnoughPoints: fewer than three points lie on smooth ground of the model.
    """
    off_m = float(np.hypot(place_sigma_m, heights.frame.sigma_m))
    ground_m, slope, rough_m = _planes(lon_lat_h, heights.terrain, off_m)
    sigma_m = heights.terrain.sigma_m(lon_lat_h)
    with np.errstate(invalid="ignore"):
        smooth = (rough_m <= _ROUGHEST * sigma_m) & (np.hypot(*slope.T) <= _STEEPEST)
    rows = np.flatnonzero(smooth & np.isfinite(above.height_m))
    if len(rows) < _MIN_FOUND:
        raise NotEnoughPoints(
            len(rows),
            _MIN_FOUND,
            f"points on smooth ground of the elevation model {heights.name}: {len(lon_lat_h)} tried, "
            f"{int(np.isfinite(rough_m).sum())} where it has heights, {int(smooth.sum())} of them on "
            f"ground that is not steep and not rougher than {_ROUGHEST:g} times its sigma of "
            f"{np.nanmedian(sigma_m):g} m (--control-dem-sigma-m); the images show no smooth surface at "
            "the others",
        )
    mean = slope[rows].mean(axis=0)
    own_m2 = sigma_m**2 + rough_m**2 + above.sigma_m**2
    own_m2 = own_m2 + ((slope - mean) ** 2).sum(axis=1) * off_m**2
    rows = np.sort(rows[np.argsort(own_m2[rows], kind="stable")[:_MOST]])
    covariance_m2 = np.tile(np.diag([np.inf, np.inf, 0.0]), (len(rows), 1, 1))
    covariance_m2[:, 2, 2] = own_m2[rows]
    up_m2 = heights.frame.covariance_m2[2, 2] + float(mean @ mean) * off_m**2
    place = np.column_stack([lon_lat_h[rows, :2], ground_m[rows] - above.height_m[rows]])
    return ControlGround(
        point=rows,
        lon_lat_h=place,
        covariance_m2=covariance_m2,
        source=np.zeros(len(rows), dtype=np.int64),
        frames=(Frame.from_sigmas(np.nan, float(np.sqrt(up_m2))),),
        names=place_names(heights.name, place),
    )


def ortho_heights(
    scenes: Sequence[Scene], observations: Observations, heights: ControlHeights
) -> ControlGround:
    """The points that ortho-images alone show, with the heights of an elevation model where they lie.

    Their rays tell no height. The place is that in the first image, so that its accuracy, that of the
    model, and the slope of the ground are in the sigma. Voids give no height.

    Args:
        scenes: of the observations.
        observations: of the points, by point.
        heights: of the ground.
    """
    models = [scene.model for scene in scenes]
    delivered = [model.base if isinstance(model, CorrectedModel) else model for model in models]
    ortho = np.array([isinstance(model, OrthoModel) for model in delivered])
    others = np.unique(observations.point[~ortho[observations.image]])
    point, first = np.unique(observations.point, return_index=True)
    flat = ~np.isin(point, others)
    point, first = point[flat], first[flat]
    place, off_m2 = np.full((len(point), 3), np.nan), np.zeros(len(point))
    for number in np.unique(observations.image[first]).tolist():
        rows = np.flatnonzero(observations.image[first] == number)
        line_sample = observations.line_sample[first[rows]]
        place[rows] = scenes[number].model.locate(line_sample, np.zeros(len(rows)))
        off_m2[rows] = scenes[number].sigma_m ** 2 + np.nan_to_num(heights.frame.sigma_m) ** 2
    place[:, 2] = heights.terrain.height_m(place[:, :2])
    steep2 = (heights.terrain.slope(place[:, :2]) ** 2).sum(axis=1)
    known = np.flatnonzero(np.isfinite(place[:, 2]) & np.isfinite(steep2))
    covariance_m2 = np.tile(np.diag([np.inf, np.inf, 0.0]), (len(known), 1, 1))
    sigma_m = heights.terrain.sigma_m(place[known])
    covariance_m2[:, 2, 2] = sigma_m**2 + steep2[known] * off_m2[known]
    return ControlGround(
        point=point[known],
        lon_lat_h=place[known],
        covariance_m2=covariance_m2,
        source=np.zeros(len(known), dtype=np.int64),
        frames=(Frame.from_sigmas(np.nan, heights.frame.sigma_up_m),),
        names=place_names(heights.name, place[known]),
    )


def _planes(lon_lat_h: Array, terrain: Terrain, off_m: float) -> tuple[Array, Array, Array]:
    """Height (n,), slope (n, 2) and roughness (n,) of the ground around points (n, 3), as planes."""
    half_m = max(terrain.posting_m, _FRAME_SIGMAS * off_m)
    axis = np.linspace(-half_m, half_m, _PER_SIDE)
    offset = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    around = np.repeat(lon_lat_h, len(offset), axis=0)
    step = np.column_stack([np.tile(offset, (len(lon_lat_h), 1)), np.zeros(len(around))])
    ground_m = terrain.height_m(move_metres(around, step)[:, :2]).reshape(len(lon_lat_h), -1)
    columns = np.column_stack([np.ones(len(offset)), offset])
    known = np.isfinite(ground_m)
    filled = known.mean(axis=1) >= _FILLED
    ground_m, known = np.nan_to_num(ground_m), known & filled[:, None]
    normal = np.einsum("nk,ki,kj->nij", known, columns, columns)
    normal[~filled] = np.eye(3)
    plane = np.linalg.solve(normal, ((ground_m * known) @ columns)[:, :, None])[:, :, 0]
    plane[~filled] = np.nan
    square = (known * (ground_m - plane @ columns.T) ** 2).sum(axis=1)
    freedom = np.maximum(known.sum(axis=1) - columns.shape[1], 1)
    return plane[:, 0], plane[:, 1:], np.sqrt(square / freedom)
