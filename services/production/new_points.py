"""BLOCK AND REGISTERED SCENES IN -> NEW POINTS OUT, where the density of the block is short."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from services.adjustment.frame_fit import misfits_m
from services.errors import ComputationError
from services.geodesy import east_north_up, longitudes_near, move_metres
from services.imagery.scene import Scene, scene_footprint
from services.matching.predict import rank_in_group
from services.production.control import Control
from services.production.control_points import ControlBlock
from services.production.from_images import Production, ProductionOptions, produce_points
from services.production.placed_block import FoundControl, find_in_block
from services.production.point_views import chips_of, point_views
from services.sensors.base import SensorModel
from services.types import (
    Array,
    BoolArray,
    ChipArray,
    ControlPoints,
    IntArray,
    Observations,
    Progress,
    no_progress,
)

_COARSE = 4.0
"""Ground sampling of the coarse chips over the fine one, where a block has one sampling only."""
_MEDIAN_SQUARE = 0.4549
"""Median of the square of a normal error over its variance."""


@dataclass(frozen=True)
class ShortGround:
    """The squares of ground inside the outline of a block that should have a point each.

    Attributes:
        outline: (m, 2) lon, lat of the block, as in its document.
        spacing_m: side of the squares.
        taken: (k, 2) int64 squares that have a point, sorted.
    """

    outline: Array
    spacing_m: float
    taken: IntArray

    def squares(self, lon_lat_h: Array) -> IntArray:
        """The square (n, 2) of every point (n, 3), east and north of the corner of the outline."""
        return _squares(lon_lat_h, self.outline, self.spacing_m)

    def holds(self, lon_lat_h: Array) -> BoolArray:
        """Which points (n, 3) lie inside the outline in a square without a point."""
        lon = longitudes_near(lon_lat_h[:, 0], float(self.outline[:, 0].mean()))
        inside = shapely.contains_xy(shapely.Polygon(self.outline), lon, lon_lat_h[:, 1])
        taken = set(map(tuple, self.taken.tolist()))
        free = [tuple(square) not in taken for square in self.squares(lon_lat_h).tolist()]
        return np.asarray(inside & np.array(free, dtype=np.bool_))

    def centres(self) -> Array:
        """Centres (n, 2), lon and lat, of the squares inside the outline without a point."""
        low, high = self.outline.min(axis=0), self.outline.max(axis=0)
        origin = np.array([*low, 0.0])
        last = _squares(np.array([[*high, 0.0]]), self.outline, self.spacing_m)[0]
        grid = np.stack(np.meshgrid(*(np.arange(n + 1) for n in last), indexing="ij"), axis=-1)
        enu = np.column_stack([(grid.reshape(-1, 2) + 0.5) * self.spacing_m, np.zeros(grid.size // 2)])
        lon_lat_h = move_metres(np.tile(origin, (len(enu), 1)), enu)
        return lon_lat_h[self.holds(lon_lat_h), :2]


def short_ground(points: ControlPoints, outline: Array, points_per_km2: float) -> ShortGround:
    """The ground where a block has fewer points than specified: squares of one point without any.

    Args:
        points: of the block.
        outline: (m, 2) lon, lat of the block, longitudes continuous.
        points_per_km2: specified.
    """
    spacing_m = 1000.0 / float(np.sqrt(points_per_km2))
    taken = np.unique(_squares(points.lon_lat_h, outline, spacing_m), axis=0)
    return ShortGround(outline, spacing_m, taken)


def _squares(lon_lat_h: Array, outline: Array, spacing_m: float) -> IntArray:
    origin = np.array([*outline.min(axis=0), 0.0])
    enu = east_north_up(lon_lat_h, origin)[:, :2]
    return np.floor(enu / spacing_m).astype(np.int64)


def shown_twice(ground: ShortGround, scenes: Sequence[Scene]) -> int:
    """Number of the squares without a point whose centres two scenes or more show."""
    centre = ground.centres()
    count = np.zeros(len(centre), dtype=np.int64)
    for scene in scenes:
        footprint = scene_footprint(scene)
        lon = longitudes_near(centre[:, 0], float(footprint[:, 0].mean()))
        count += shapely.contains_xy(shapely.Polygon(footprint), lon, centre[:, 1])
    return int((count >= 2).sum())


@dataclass(frozen=True)
class NewPoints:
    """New points in the frame of a block.

    Attributes:
        points: `views.images` are the scenes.
        models: of the scenes, which the chips are cut with.
        chips: from the row of a point to its chips, (views, 101, 101) uint16; 0 is nodata.
    """

    points: ControlPoints
    models: tuple[SensorModel, ...]
    chips: Callable[[int], ChipArray]


def points_where_short(
    scenes: Sequence[Scene],
    block: ControlBlock,
    ground: ShortGround,
    min_views: int,
    progress: Progress = no_progress,
) -> NewPoints:
    """New points in the squares without one, produced from scenes with the block as control.

    The scenes are adjusted together on the points of the block, whose frame is taken as exact, but for
    what its points share. What the adjustment then states as its frame is how well the scenes are
    placed in that of the block: a part of the covariance of every new point, which is one in the frame
    of the block.

    Args:
        scenes: with registered models, and the accuracy of the models as delivered: registered ones know
            of the block what the control says once more.
        block: the points that are kept, and their chips.
        ground: where points are short.
        min_views: smallest number of scenes that show a new point; two at least.
        progress: receives the fraction done.

    Raises:
        ComputationError: the scenes have too little in common, or no new point lies where it is short.
    """
    gsds_m = np.unique(block.points.views.gsd_m).tolist()
    options = ProductionOptions(
        fine_gsd_m=gsds_m[0],
        coarse_gsd_m=gsds_m[-1] if len(gsds_m) > 1 else _COARSE * gsds_m[0],
        spacing_m=ground.spacing_m,
        min_views=max(min_views, 2),
    )
    exact = replace(
        block.points,
        frames=tuple(replace(frame, covariance_m2=np.zeros((3, 3))) for frame in block.points.frames),
    )
    control = Control(blocks=(replace(block, points=exact),))
    made = produce_points(scenes, options, progress, control=control)
    rows = _chosen(made.points, ground)
    if len(rows) == 0:
        raise ComputationError(
            f"{len(made.points)} points were produced, none of them in a square of "
            f"{ground.spacing_m:g} m without a point"
        )
    adjusted = [
        replace(scene, model=model) for scene, model in zip(scenes, made.adjustment.models, strict=True)
    ]
    scale = _found_scale(find_in_block(adjusted, made.points, control))
    return _in_frame(made, rows, adjusted, scale, block.points)


def _chosen(points: ControlPoints, ground: ShortGround) -> IntArray:
    """Row (k,), ascending, of the most salient point of every square without one."""
    rows = np.flatnonzero(ground.holds(points.lon_lat_h))
    squares = ground.squares(points.lon_lat_h[rows])
    group = np.unique(squares, axis=0, return_inverse=True)[1].ravel().astype(np.int64)
    return rows[rank_in_group(group, points.saliency[rows]) == 0]


def _found_scale(found: FoundControl) -> Array:
    """By how much (3,) errors east, north, up exceed what is declared, by the points of the block.

    They are found again in the scenes, where the rays of the scenes alone tell their places. What these
    scatter about their median beyond the covariances of both is what two matches of one detail differ
    by: in height, where relief and shadows shift it, more than the correlation states.
    """
    misfit_m = misfits_m(found.known, found.lon_lat_h)
    declared = np.diagonal(found.known.covariance_m2 + found.covariance_m2, 0, 1, 2)
    square = (misfit_m - np.median(misfit_m, axis=0)) ** 2 / declared
    horizontal, up = np.median(square[:, :2]), np.median(square[:, 2])
    scale2 = np.array([horizontal, horizontal, up]) / _MEDIAN_SQUARE
    return np.sqrt(np.maximum(scale2, 1.0))


def _in_frame(
    made: Production, rows: IntArray, scenes: Sequence[Scene], scale: Array, block: ControlPoints
) -> NewPoints:
    """Some of the points produced, in the frame of the block, with chips of its samplings.

    Args:
        made: the production.
        rows: (k,) of its points.
        scenes: with adjusted models.
        scale: (3,) of the standard deviations.
        block: points of the block, which have its frame and its samplings.
    """
    points = made.points.take(rows)
    of_view = np.repeat(np.arange(len(points)), np.diff(points.views.start))
    seen = np.unique(np.column_stack([of_view, points.views.image]), axis=0)
    nowhere = np.full((len(seen), 2), np.nan)
    observations = Observations(seen[:, 0], seen[:, 1], nowhere, nowhere[:, 0])
    views = point_views(scenes, observations, points.lon_lat_h, np.unique(block.views.gsd_m).tolist())
    placed_m2 = points.frames[0].covariance_m2
    in_block = replace(
        points,
        covariance_m2=points.covariance_m2 * np.outer(scale, scale) + placed_m2,
        frames=block.frames,
        views=views,
    )
    return NewPoints(
        in_block, tuple(made.adjustment.models), chips_of(scenes, in_block.lon_lat_h, views)
    )
