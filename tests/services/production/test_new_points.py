"""A hole in a block is filled from registered scenes, with points as precise as they declare."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.errors import ComputationError
from amers.services.geodesy import east_north_up, move_metres
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.production.new_points import (
    NewPoints,
    ShortGround,
    overlapping_scenes,
    points_where_short,
    registered_scene,
    short_ground,
    shown_twice,
)
from amers.services.production.renewed_views import SeeingScene, with_new_points, with_new_views
from amers.services.quality.stability import image_places
from amers.services.registration.on_points import register_scene
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Array, ChipSource, ControlPoints
from tests.services.block_with_hole import (
    HOLE_M,
    OLDER_SEED,
    PER_KM2,
    SIGMA_M,
    SUNS,
    clean,
    cut,
    older,
    simulated,
    true_places,
)
from tests.services.production.test_renewed_views import CENTRE, old_points, scene
from tests.services.simulated import MemoryChips
from tests.services.ties import difference_m, whitened_square

pytestmark = pytest.mark.long

SEEDS = (21, 22, 23)
ALL_POINTS = RegistrationOptions(max_points=0)


def hole() -> ShortGround:
    _, block, outline = older()
    return short_ground(block.points, outline, PER_KM2)


@cache
def registered(seed: int) -> tuple[Scene, ...]:
    """Later scenes with registered models and their accuracy relative to the block."""
    _, block, _ = older()
    scenes = []
    for view in simulated(seed, SIGMA_M):
        scene = view.as_scene(SIGMA_M)
        made = register_scene(scene, block.points, block.chips, ALL_POINTS)
        scenes.append(registered_scene(scene, made.model, made.adjustment))
    return tuple(scenes)


@cache
def filled(seed: int) -> NewPoints:
    _, block, _ = older()
    return points_where_short(registered(seed), block.points, hole(), min_views=2)


@cache
def frame_error_m(sun: int) -> Array:
    """By how much (3,) the points of the block are off together, most likely, under one of the suns."""
    error_m, covariance_m2 = errors_of_block_m(sun)
    weight = np.linalg.inv(covariance_m2)
    total = (weight @ error_m[:, :, None]).sum(axis=0)[:, 0]
    return np.asarray(np.linalg.solve(weight.sum(axis=0), total))


def errors_of_block_m(sun: int) -> tuple[Array, Array]:
    """Errors (n, 3) of the points around the hole, and their covariances."""
    whole, block, _ = older()
    scenes = clean(OLDER_SEED, 0.0, SUNS[sun])
    places = true_places(scenes, cut().adjustment.models, cut().points)
    known = np.isfinite(places[:, 0]) & np.isin(whole.points.id, block.points.id)
    error_m = difference_m(whole.points.lon_lat_h[known], places[known])
    return error_m, whole.points.covariance_m2[known]


def errors_m(seed: int, sun: int) -> Array:
    """Errors (n, 3) of the new points in the frame of the block; NaN where unknown."""
    made = filled(seed)
    places = true_places(clean(seed, SIGMA_M, SUNS[sun]), made.models, made.points)
    return difference_m(made.points.lon_lat_h, places) - frame_error_m(sun)


def normalised(seed: int, suns: range) -> float:
    """Mean square of the errors over what is declared, of all new points under some of the suns."""
    covariance_m2 = filled(seed).points.covariance_m2
    squares = np.stack([whitened_square(errors_m(seed, sun), covariance_m2) for sun in suns])
    assert np.isfinite(squares).mean() > 0.9
    return float(np.nanmean(squares))


@pytest.mark.thorough
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


@pytest.mark.thorough
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


@pytest.mark.thorough
def test_new_points_are_in_the_frame_of_the_block_as_precisely_as_they_declare() -> None:
    # One scene and one sun: the height of content shifts by half a metre with the shadows.
    assert 0.5 < normalised(SEEDS[0], range(1)) < 1.7


@pytest.mark.endurance
def test_new_points_of_several_scenes_are_as_precise_as_the_block_s_own() -> None:
    whole, own = older()[0].points, []
    for sun in range(len(SUNS)):
        error_m, covariance_m2 = errors_of_block_m(sun)
        own.append(whitened_square(error_m - frame_error_m(sun), covariance_m2).mean())
    new = [normalised(seed, range(len(SUNS))) for seed in SEEDS]
    error_m = np.concatenate([errors_m(seed, sun) for seed in SEEDS for sun in range(len(SUNS))])
    variance_m2 = [np.diagonal(filled(seed).points.covariance_m2, 0, 1, 2) for seed in SEEDS]
    print(
        f"normalised {np.round(new, 2)}, of the block's own points {np.round(own, 2)} (suns); errors "
        f"{np.sqrt(np.nanmean(error_m**2, axis=0)).round(3)} m, declared "
        f"{np.sqrt(np.concatenate(variance_m2).mean(axis=0)).round(3)} m, those of the block "
        f"{np.sqrt(np.diagonal(whole.covariance_m2, 0, 1, 2).mean(axis=0)).round(3)} m"
    )
    assert 0.7 < np.mean(new) < 1.5


def as_block(made: NewPoints) -> tuple[ControlPoints, MemoryChips]:
    """New points alone, and their chips, as a registration receives them."""
    n = len(made.points)
    row = made.points.views.start[:-1]
    points = replace(made.points, chip_file=np.zeros(n, np.int64), chip_row=row, chip_files=("chips",))
    return points, MemoryChips(np.concatenate([made.chips(row) for row in range(n)]))


def squares_on(points: ControlPoints, chips: ChipSource, of: int) -> Array:
    """Errors (k, 5) of later scenes on points, over what is declared, squared; corners and centre."""
    frame_m = np.mean([frame_error_m(sun) for sun in range(len(SUNS))], axis=0)
    squares = []
    for view in simulated(of, SIGMA_M):
        scene = view.as_scene(SIGMA_M)
        registration = register_scene(scene, points, chips, ALL_POINTS)
        heights_m = np.full(5, points.lon_lat_h[:, 2].mean())
        ground = scene.model.locate(image_places(scene.image.shape), heights_m)
        position = registration.model.project(move_metres(ground, np.tile(frame_m, (5, 1))))
        error_px = position - view.geometry.true_model.project(ground)
        covariance_px2 = registration.adjustment.covariance_at(position)
        squares.append(whitened_square(error_px, covariance_px2))
    return np.array(squares)


@pytest.mark.endurance
def test_scenes_registered_on_new_points_alone_are_as_precise_as_they_declare() -> None:
    _, block, _ = older()
    on_new = np.concatenate(
        [squares_on(*as_block(filled(seed)), of) for seed in SEEDS for of in SEEDS if of != seed]
    )
    on_block = np.concatenate([squares_on(block.points, block.chips, of) for of in SEEDS])
    print(f"normalised {on_new.mean():.2f}, on the block {on_block.mean():.2f}")
    assert 0.4 < on_new.mean() < 1.5


@pytest.mark.thorough
def test_the_frame_covers_what_the_new_points_share_and_what_the_others_do() -> None:
    _, block, _ = older()
    made = filled(SEEDS[0])
    more_m2 = np.diag([0.0, 0.0, 4.0])
    deformed = replace(block.points.frames[0], shared_m2=more_m2)
    seeing = [SeeingScene(scene, np.arange(len(block.points))) for scene in registered(SEEDS[0])]
    views = with_new_views(replace(block.points, frames=(deformed,)), block.chips, seeing)
    joined = with_new_points(views, made)
    stated_m2 = joined.points.frames[0].shared_m2
    for shared_m2 in (more_m2, made.points.frames[0].shared_m2):
        assert np.linalg.eigvalsh(stated_m2 - shared_m2).min() > -1e-12
    assert stated_m2[2, 2] == pytest.approx(4.0)
    n = len(block.points)
    np.testing.assert_array_equal(joined.points.covariance_m2[:n], block.points.covariance_m2)
    for row in range(len(made.points)):
        np.testing.assert_array_equal(joined.chips(n + row), made.chips(row))
    images = [image.image_id for image in joined.points.views.images]
    new_views = joined.points.views.image[joined.points.views.start[n] :]
    assert {images[row] for row in new_views.tolist()} == {
        scene.acquisition.image_id for scene in registered(SEEDS[0])
    }


def test_scenes_that_do_not_overlap_are_apart() -> None:
    one, other = scene("one", 0.5, 1), scene("other", 0.5, 1)
    east = [replace(of, model=shifted(of.model)) for of in (one, other)]
    groups = overlapping_scenes([one, east[0], other, east[1], one])
    assert groups == [[one, other, one], east]
    assert overlapping_scenes([one, east[0]]) == []


def shifted(model: RpcModel) -> RpcModel:
    """A model of ground some kilometres farther east."""
    return replace(model, ground_offset=model.ground_offset + [0.05, 0.0, 0.0])


def test_scenes_that_show_no_common_detail_make_no_points() -> None:
    rng = np.random.default_rng(0)
    noise = [
        replace(of, image=ArrayImage(rng.normal(1000.0, 100.0, of.image.shape).astype(np.float32)))
        for of in (scene("one", 0.5, 1), scene("other", 0.5, 1))
    ]
    outline = CENTRE + 1e-3 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    everywhere = ShortGround(outline, 50.0, np.empty((0, 2), dtype=np.int64))
    with pytest.raises(ComputationError):
        points_where_short(noise, old_points(4)[0], everywhere, min_views=2)
