"""A block of the small simulated world with a hole in its middle, and later views of the same ground."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache

import numpy as np

from amers.services.adjustment.intersection import intersect
from amers.services.geodesy import box_around, east_north_up, move_metres, sun_direction
from amers.services.imagery.scene import Scene
from amers.services.matching.multi_image import refine_on_chips
from amers.services.production.control_points import ControlBlock
from amers.services.production.image_production import Production, produce_points
from amers.services.sensors.base import SensorModel
from amers.services.simulation.render import Radiometry
from amers.services.simulation.view import SimulatedView, render_view, simulate_block
from amers.services.types import Array, ControlPoints, Frame
from tests.services.simulated import GSD_M, OPTIONS, SHAPE, MemoryChips, world

SIGMA_M = 5.0
"""Of the models of later views, as delivered."""
FRAME_ERROR_M = np.array([2.0, -1.5, 3.0])
OWN_SIGMA_M = 0.15
HOLE_M = 150.0
"""Half of the side of the hole."""
OLDER_SEED = 11
SUNS = tuple(datetime(2024, month, day, 11, tzinfo=UTC) for month, day in ((4, 25), (6, 15), (8, 15)))
"""Moments whose suns show the content of chips: among buildings each shows another height of it."""
PER_KM2 = 200.0
"""Density that the block specifies."""


@cache
def simulated(seed: int, error_m: float) -> tuple[SimulatedView, ...]:
    return tuple(
        simulate_block(
            world(),
            np.random.default_rng(seed),
            n_views=3,
            shape=SHAPE,
            gsd_m=GSD_M,
            error_m=error_m,
            largest_incidence_deg=20.0,
        )
    )


@cache
def cut() -> Production:
    """The whole block where its images truly show it: produced with their true models."""
    exact = [
        replace(view.as_scene(0.1), model=view.geometry.true_model)  # type: ignore[arg-type]
        for view in simulated(OLDER_SEED, error_m=0.0)
    ]
    return produce_points(exact, replace(OPTIONS, points=60))


@cache
def older() -> tuple[ControlBlock, ControlBlock, Array]:
    """A block that is off by its frame, whole and with a hole in its middle; and its outline.

    Where its points are is known but for the matching of its images, which its covariances declare.
    """
    made = cut()
    n = len(made.points)
    chips = MemoryChips(np.concatenate([made.chips(row) for row in range(n)]))
    error_m = FRAME_ERROR_M + np.random.default_rng(13).normal(0.0, OWN_SIGMA_M, (n, 3))
    points = replace(
        made.points,
        lon_lat_h=move_metres(made.points.lon_lat_h, error_m),
        covariance_m2=np.eye(3) * OWN_SIGMA_M**2 + made.points.covariance_m2,
        frames=(Frame.from_sigmas(2.0, 3.0),),
    )
    outline = box_around(points.lon_lat_h)
    enu = east_north_up(points.lon_lat_h, np.array([*outline.mean(axis=0), 0.0]))
    outside = np.flatnonzero(np.abs(enu[:, :2]).max(axis=1) > HOLE_M)
    whole = ControlBlock("older", points, chips)
    return whole, replace(whole, points=points.take(outside)), outline


@cache
def clean(seed: int, error_m: float, moment: datetime) -> tuple[Scene, ...]:
    """What the views would show at one moment without noise, with their true models."""
    scenes = []
    for view in simulated(seed, error_m):
        geometry = view.geometry
        plan = replace(geometry.plan, radiometry=_SILENT, acquired_at=moment)
        elevation_deg, azimuth_deg = sun_direction(np.array(plan.lon_lat), moment)
        acquisition = replace(
            geometry.acquisition, sun_elevation_deg=elevation_deg, sun_azimuth_deg=azimuth_deg
        )
        shown = replace(geometry, plan=plan, acquisition=acquisition)
        strips = render_view(world(), shown, np.random.default_rng(1))
        pixels = np.concatenate([of_strip for _, of_strip in strips])
        scene = replace(view, pixels=pixels, geometry=shown).as_scene(0.1)
        scenes.append(replace(scene, model=geometry.true_model))
    return tuple(scenes)


_SILENT = Radiometry(noise_floor=0.0, noise_per_signal=0.0)


def true_places(scenes: Sequence[Scene], models: Sequence[SensorModel], points: ControlPoints) -> Array:
    """Where the content of the chips (n, 3) of points truly lies; NaN where it is not found.

    It is what the centre of the steepest chip shows, at the height where clean images match.

    Args:
        scenes: clean ones, from `clean`.
        models: that the chips were cut with.
        points: where they were cut.
    """
    places = np.full((len(points), 3), np.nan)
    for row, ground in enumerate(points.lon_lat_h):
        image = np.unique(points.views.image[slice(*points.views.start[row : row + 2])])
        best = min(image, key=lambda i: scenes[i].acquisition.incidence_deg)
        centre = models[best].project(ground[None, :])
        height_m = ground[2]
        for _ in range(3):
            start = scenes[best].model.locate(centre, np.array([height_m]))
            found = refine_on_chips([scenes[i] for i in image], start, GSD_M).observations
            places[row] = intersect([scenes[i].model for i in image], found, 1).lon_lat_h[0]
            height_m = places[row, 2]
    return places
