"""Small simulated worlds, views, blocks and productions, each computed once for all tests."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache

import numpy as np

from amers.services.adjustment.intersection import Intersection, intersect
from amers.services.production.image_production import Production, ProductionOptions, produce_points
from amers.services.simulation.view import (
    SimulatedView,
    ViewGeometry,
    ViewPlan,
    plan_geometry,
    simulate_block,
    simulate_view,
)
from amers.services.simulation.world import World, make_world
from amers.services.tasks import Work
from amers.services.types import (
    UNKNOWN_FRAME,
    Acquisition,
    Array,
    ChipArray,
    ControlPoints,
    Observations,
    Views,
)

SHAPE = (700, 700)
GSD_M = 1.0
BLOCK_SIGMA_M = 3.0
OPTIONS = ProductionOptions(fine_gsd_m=1.0, coarse_gsd_m=4.0, points=60, surface_pairs=0)


@cache
def world(seed: int = 1) -> World:
    """A world of one square kilometre."""
    return make_world(np.random.default_rng(seed), size_m=1000.0, posting_m=1.0)


def views_of(
    ground: World, rng: np.random.Generator, count: int = 3, error_m: float = BLOCK_SIGMA_M
) -> tuple[SimulatedView, ...]:
    """Views of the middle of a world from all sides."""
    common = {"shape": SHAPE, "gsd_m": GSD_M, "largest_incidence_deg": 20.0}
    return tuple(simulate_block(ground, rng, n_views=count, error_m=error_m, **common))  # type: ignore[arg-type]


@cache
def block_views() -> tuple[SimulatedView, ...]:
    """Three views of the middle of the world, each with an error of about 3 m."""
    return views_of(world(), np.random.default_rng(2))


@cache
def production_with_work() -> tuple[Production, Work]:
    """The points produced from the three views, with surfaces, and what was kept on the way."""
    scenes, work = [view.as_scene(BLOCK_SIGMA_M) for view in block_views()], Work()
    return produce_points(scenes, replace(OPTIONS, surface_pairs=10), work=work), work


def production() -> Production:
    """The points produced from the three views."""
    return production_with_work()[0]


def truth_of(made: Production, views: Sequence[SimulatedView]) -> Intersection:
    """Positions by the true models of the details that the adjusted models project the points to."""
    n, count = len(made.points), len(views)
    seen = np.stack([model.project(made.points.lon_lat_h) for model in made.adjustment.models], axis=1)
    point, image = np.repeat(np.arange(n), count), np.tile(np.arange(count), n)
    observations = Observations(point, image, seen.reshape(-1, 2), np.full(n * count, 0.1))
    return intersect([view.geometry.true_model for view in views], observations, n)


@dataclass(frozen=True)
class MemoryChips:
    """The chips of a production, in consecutive rows as in one file."""

    chips: ChipArray

    def read(self, file: str, row: int, count: int) -> ChipArray:
        return self.chips[row : row + count]


def views_of_points(
    count: int,
    gsds_m: Sequence[float],
    incidence_deg: float | Sequence[float] = 0.0,
    azimuth_deg: float = 0.0,
    *,
    image: int | Sequence[int] = 0,
    images: tuple[Acquisition, ...] = (Acquisition("ground"),),
) -> Views:
    """Views of points which all have the same: one at each ground sampling."""
    each = len(gsds_m)
    return Views(
        start=each * np.arange(count + 1),
        gsd_m=np.tile(gsds_m, count),
        image=np.tile(np.broadcast_to(image, each), count),
        incidence_deg=np.tile(np.broadcast_to(incidence_deg, each), count),
        azimuth_deg=np.full(each * count, azimuth_deg),
        health=np.ones(each * count),
        images=images,
    )


def points_with(lon_lat_h: Array, views: Views, sigma_m: float) -> ControlPoints:
    """Points of one block, as precise in each coordinate, whose chips are in the rows of their views."""
    n = len(lon_lat_h)
    return ControlPoints(
        id=np.arange(n),
        lon_lat_h=lon_lat_h,
        covariance_m2=np.tile(sigma_m**2 * np.eye(3), (n, 1, 1)),
        block=np.zeros(n, dtype=np.int64),
        frames=(UNKNOWN_FRAME,),
        saliency=np.ones(n),
        health=np.ones(n),
        views=views,
        chip_file=np.zeros(n, dtype=np.int64),
        chip_row=views.start[:-1],
        chip_files=("chips",),
    )


@cache
def block() -> tuple[ControlPoints, MemoryChips]:
    """The points and their chips, as a registration receives them."""
    made = production()
    chips = np.concatenate([made.chips(row) for row in range(len(made.points))])
    return made.points, MemoryChips(chips)


def plan(name: str = "scene", **changes: object) -> ViewPlan:
    """The plan of a view of the middle of the world, from a direction that no view of the block has."""
    lon, lat = (float(v) for v in world().centre_lon_lat)
    base = ViewPlan(
        name,
        (lon, lat),
        SHAPE,
        GSD_M,
        incidence_deg=11.0,
        azimuth_deg=200.0,
        acquired_at=datetime(2024, 7, 3, 10, 30, tzinfo=UTC),
    )
    return replace(base, **changes)  # type: ignore[arg-type]


@cache
def spoiled_view(
    ground_error_m: tuple[float, float] = (31.0, -24.0),
    skew_px: float = 1.5,
    seed: int = 11,
    world_seed: int = 1,
) -> SimulatedView:
    """A later view, delivered with an error on the ground and a skew at the edge of the image."""
    error_px = np.array([[0.0, 0.8, skew_px], [0.0, -0.5 * skew_px, -0.6]]) if skew_px else None
    return simulate_view(
        world(world_seed), plan(), np.random.default_rng(seed), ground_error_m, error_px
    )


@cache
def ring_of_geometries(
    count: int, incidence_deg: float = 15.0, shape: tuple[int, int] = (4000, 4000)
) -> list[ViewGeometry]:
    """Views of one place from all sides, without pixels and without error."""
    return [
        plan_geometry(
            world(),
            plan(
                f"ring_{k}",
                shape=shape,
                incidence_deg=incidence_deg,
                azimuth_deg=30.0 + 360.0 * k / count,
            ),
            np.random.default_rng(k),
        )
        for k in range(count)
    ]
