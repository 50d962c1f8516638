"""A hole in a block is filled from registered scenes, with points as precise as they declare."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from services.adjustment.intersection import intersect
from services.errors import ComputationError, InputError
from services.geodesy import east_north_up
from services.imagery.scene import Scene
from services.matching.multi_image import refine_on_chips
from services.production.new_points import (
    NewPoints,
    ShortGround,
    points_where_short,
    short_ground,
    shown_twice,
)
from services.registration.on_points import register_scene
from services.registration.options import RegistrationOptions
from services.simulation.render import Radiometry
from services.simulation.view import render_view
from services.types import Array
from tests.services.block_with_hole import (
    FRAME_ERROR_M,
    HOLE_M,
    OWN_SIGMA_M,
    PER_KM2,
    SIGMA_M,
    older,
    simulated,
)
from tests.services.simulated import world
from tests.services.ties import difference_m, whitened_square

pytestmark = pytest.mark.long

SEEDS = (21, 22, 23)


def hole() -> ShortGround:
    _, block, outline = older()
    return short_ground(block.points, outline, PER_KM2)


@cache
def registered(seed: int) -> tuple[Scene, ...]:
    """Later scenes with registered models, and the accuracy of the models as delivered."""
    _, block, _ = older()
    scenes = []
    for view in simulated(seed, SIGMA_M):
        scene = view.as_scene(SIGMA_M)
        made = register_scene(scene, block.points, block.chips, RegistrationOptions(max_points=0))
        scenes.append(replace(scene, model=made.model))
    return tuple(scenes)


@cache
def filled(seed: int) -> NewPoints:
    _, block, _ = older()
    return points_where_short(registered(seed), block, hole(), min_views=2)


def true_places(seed: int, made: NewPoints) -> Array:
    """Where the content of the chips truly lies, by true models and noiseless images under one sun."""
    silent = Radiometry(noise_floor=0.0, noise_per_signal=0.0)
    views = simulated(seed, SIGMA_M)
    first, clean = views[0].geometry, []
    for view in views:
        plan = replace(view.geometry.plan, radiometry=silent, acquired_at=first.plan.acquired_at)
        acquisition = replace(
            view.geometry.acquisition,
            sun_elevation_deg=first.acquisition.sun_elevation_deg,
            sun_azimuth_deg=first.acquisition.sun_azimuth_deg,
        )
        geometry = replace(view.geometry, plan=plan, acquisition=acquisition)
        strips = render_view(world(), geometry, np.random.default_rng(1))
        shown = replace(view, pixels=np.concatenate([pixels for _, pixels in strips]))
        clean.append(replace(shown.as_scene(0.1), model=view.geometry.true_model))
    points = made.points
    places = np.full((len(points), 3), np.nan)
    for row, ground in enumerate(points.lon_lat_h):
        mine = slice(points.views.start[row], points.views.start[row + 1])
        image = np.unique(points.views.image[mine])
        best = min(image, key=lambda i: clean[i].acquisition.incidence_deg)
        centre = made.models[best].project(ground[None, :])
        height_m = ground[2] - FRAME_ERROR_M[2]
        for _ in range(3):
            start = clean[best].model.locate(centre, np.array([height_m]))
            scenes = [clean[i] for i in image]
            found = refine_on_chips(scenes, start, 1.0).observations
            places[row] = intersect([scene.model for scene in scenes], found, 1).lon_lat_h[0]
            height_m = places[row, 2]
    return places


def test_the_hole_is_the_ground_without_points() -> None:
    whole, block, outline = older()
    ground = hole()
    lost = whole.points.lon_lat_h[~np.isin(whole.points.id, block.points.id)]
    assert len(lost) >= 6
    assert ground.holds(lost).mean() > 0.6
    assert not ground.holds(block.points.lon_lat_h).any()
    far = outline.mean(axis=0) + [0.5, 0.0]
    assert not ground.holds(np.array([[*far, 100.0]])).any()
    centres = ground.centres()
    assert ground.holds(np.column_stack([centres, np.zeros(len(centres))])).all()
    assert len(
        np.unique(ground.squares(np.column_stack([centres, np.zeros(len(centres))])), axis=0)
    ) == len(centres)
    assert shown_twice(ground, registered(SEEDS[0])[:1]) == 0
    assert shown_twice(ground, registered(SEEDS[0])) > 0


def test_new_points_fill_the_hole_one_in_each_square() -> None:
    made, ground = filled(SEEDS[0]), hole()
    _, block, outline = older()
    enu = east_north_up(made.points.lon_lat_h, np.array([*outline.mean(axis=0), 0.0]))
    in_hole = (np.abs(enu[:, :2]) < HOLE_M).all(axis=1)
    assert in_hole.sum() >= 6
    assert ground.holds(made.points.lon_lat_h).all()
    squares = ground.squares(made.points.lon_lat_h)
    assert len(np.unique(squares, axis=0)) == len(squares)
    views = made.points.views
    assert set(views.gsd_m.tolist()) == set(block.points.views.gsd_m.tolist())
    for row in range(len(made.points)):
        mine = slice(views.start[row], views.start[row + 1])
        assert len(np.unique(views.image[mine])) >= 2
        assert made.chips(row).shape == (mine.stop - mine.start, 101, 101)


def test_new_points_are_in_the_frame_of_the_block_as_precisely_as_they_declare() -> None:
    squares, errors = [], []
    for seed in SEEDS:
        made = filled(seed)
        places = true_places(seed, made)
        known = np.isfinite(places).all(axis=1)
        assert known.mean() > 0.8
        error_m = difference_m(made.points.lon_lat_h[known], places[known]) - FRAME_ERROR_M
        squares.append(whitened_square(error_m, made.points.covariance_m2[known]))
        errors.append(error_m)
    normalised = float(np.concatenate(squares).mean())
    sigma_m = np.sqrt(np.diagonal(filled(SEEDS[0]).points.covariance_m2, 0, 1, 2)).mean(axis=0)
    rms_m = np.sqrt((np.concatenate(errors) ** 2).mean(axis=0))
    print(f"normalised {normalised:.2f}; errors {rms_m.round(3)} m, declared {sigma_m.round(3)} m")
    assert 0.7 < normalised < 1.5
    # What the scenes' own registration leaves in doubt is part of it.
    assert sigma_m[:2].min() > OWN_SIGMA_M / np.sqrt(60.0)


def test_scenes_that_show_nothing_in_common_make_no_points() -> None:
    _, block, _ = older()
    one = registered(SEEDS[0])[:1]
    with pytest.raises((ComputationError, InputError)):
        points_where_short(one, block, hole(), min_views=2)
