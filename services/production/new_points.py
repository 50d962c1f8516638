"""New points of a block from registered scenes, where the density of the block is too low."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from scipy.sparse.csgraph import connected_components

from amers.services.errors import ComputationError
from amers.services.geodesy import east_north_up, longitudes_near, move_metres
from amers.services.imagery.scene import Scene, scene_footprint, scene_gsd_m
from amers.services.matching.predict import rank_in_group
from amers.services.misfit.scene_adjustment import SceneAdjustment
from amers.services.production.image_production import Production, ProductionOptions, produce_points
from amers.services.production.point_views import chips_of, point_views
from amers.services.sensors.base import SensorModel
from amers.services.types import (
    Array,
    BoolArray,
    ChipArray,
    ControlPoints,
    IntArray,
    Observations,
    Progress,
    no_progress,
)


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


def overlapping_scenes(scenes: Sequence[Scene]) -> list[list[Scene]]:
    """Groups of two scenes or more that overlap, directly or through others."""
    footprints = [scene_footprint(scene) for scene in scenes]
    near = float(footprints[0][:, 0].mean())
    outlines = [
        shapely.Polygon(np.column_stack([longitudes_near(outline[:, 0], near), outline[:, 1]]))
        for outline in footprints
    ]
    meet = np.array([[one.intersects(other) for other in outlines] for one in outlines])
    count, group = connected_components(meet, directed=False)
    groups = [
        [scenes[row] for row in np.flatnonzero(group == number).tolist()] for number in range(count)
    ]
    return [members for members in groups if len(members) >= 2]


def registered_scene(scene: Scene, model: SensorModel, adjustment: SceneAdjustment) -> Scene:
    """A scene with its registered model, and the accuracy of that relative to the points.

    What the points share, as they are deformed, is no error of the scene: it follows them.

    Args:
        scene: as delivered.
        model: registered.
        adjustment: of the model.
    """
    centre = (np.array(scene.image.shape, dtype=np.float64) - 1.0) / 2.0
    own = replace(
        adjustment,
        covariance=adjustment.covariance - adjustment.deformation,
        local_sigma_px=np.zeros(2),
    )
    sigma_px = np.sqrt(np.trace(own.covariance_at(centre[None, :])[0]) / 2.0)
    return replace(scene, model=model, sigma_m=float(sigma_px) * scene_gsd_m(scene))


@dataclass(frozen=True)
class NewPoints:
    """New points in the frame of a block.

    Attributes:
        points: `views.images` are the scenes; the frame is that of the block, with what the new points
            share.
        models: of the scenes, which the chips are cut with.
        chips: from the row of a point to its chips, (views, 101, 101) uint16; 0 is nodata.
    """

    points: ControlPoints
    models: tuple[SensorModel, ...]
    chips: Callable[[int], ChipArray]


def points_where_short(
    scenes: Sequence[Scene],
    block: ControlPoints,
    ground: ShortGround,
    min_views: int,
    progress: Progress = no_progress,
) -> NewPoints:
    """New points in the squares without one, produced from scenes that are registered on a block.

    Registered models are in the frame of the block, each with an error of its own. What production
    states as the frame of its points is then how well these scenes together are placed in that frame: a
    part of the covariance of every new point, which the new points share.

    Args:
        scenes: that overlap; see `registered_scene`.
        block: the points that are kept.
        ground: where points are short.
        min_views: smallest number of scenes that show a new point; two at least.
        progress: receives the fraction done.

    Raises:
        ComputationError: the scenes have too little in common, or no new point lies where it is short.
    """
    gsds_m = np.unique(block.views.gsd_m).tolist()
    options = ProductionOptions(
        fine_gsd_m=gsds_m[0],
        coarse_gsd_m=gsds_m[-1] if len(gsds_m) > 1 else None,
        spacing_m=ground.spacing_m,
        min_views=max(min_views, 2),
    )
    made = produce_points(scenes, options, progress)
    rows = _chosen(made.points, ground)
    if len(rows) == 0:
        raise ComputationError(
            f"{len(made.points)} points were produced, none of them in a square of "
            f"{ground.spacing_m:g} m without a point"
        )
    return _in_frame(made, rows, scenes, block)


def _chosen(points: ControlPoints, ground: ShortGround) -> IntArray:
    """Row (k,), ascending, of the most salient point of every square without one."""
    rows = np.flatnonzero(ground.holds(points.lon_lat_h))
    squares = ground.squares(points.lon_lat_h[rows])
    group = np.unique(squares, axis=0, return_inverse=True)[1].ravel().astype(np.int64)
    return rows[rank_in_group(group, points.saliency[rows]) == 0]


def _in_frame(
    made: Production, rows: IntArray, scenes: Sequence[Scene], block: ControlPoints
) -> NewPoints:
    """Some of the points produced, in the frame of the block, with chips of its samplings.

    Args:
        made: the production.
        rows: (k,) of its points.
        scenes: that it was made from.
        block: points of the block, which have its frame and its samplings.
    """
    models = made.adjustment.models
    adjusted = [replace(scene, model=model) for scene, model in zip(scenes, models, strict=True)]
    points = made.points.take(rows)
    of_view = np.repeat(np.arange(len(points)), np.diff(points.views.start))
    seen = np.unique(np.column_stack([of_view, points.views.image]), axis=0)
    nowhere = np.full((len(seen), 2), np.nan)
    observations = Observations(seen[:, 0], seen[:, 1], nowhere, nowhere[:, 0])
    views = point_views(adjusted, observations, points.lon_lat_h, np.unique(block.views.gsd_m).tolist())
    of_block, of_scenes = block.frames[0], made.points.frames[0]
    placed_m2 = of_scenes.covariance_m2 + of_block.shared_m2
    surface = points.surface
    if surface is not None:
        surface = replace(surface, sigma_m=np.hypot(surface.sigma_m, np.sqrt(placed_m2[2, 2])))
    in_block = replace(
        points,
        covariance_m2=points.covariance_m2 + placed_m2,
        surface=surface,
        frames=(replace(of_block, shared_m2=placed_m2 + of_scenes.shared_m2),),
        views=views,
    )
    return NewPoints(in_block, tuple(models), chips_of(adjusted, in_block.lon_lat_h, views))
