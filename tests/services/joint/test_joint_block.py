"""Scenes adjusted together are as accurate as stated; a wrong one leaves by name."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.geodesy import move_metres
from amers.services.imagery.scene import scene_gsd_m
from amers.services.joint.block import JointBlock, adjust_together, repeated
from amers.services.joint.fitting import SceneFit, adjust_fitting, ties_between
from amers.services.joint.measured import MeasuredScene, nothing_found, options_in_block
from amers.services.joint.registration import qualified
from amers.services.joint.results import (
    held_cells,
    held_draws,
    registered_scene,
    scene_adjustment,
    scene_measures,
)
from amers.services.map_grid import MapGrid
from amers.services.quality.frames import frame_in_image
from amers.services.quality.stability import image_places
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.correction import no_correction
from amers.services.sensors.ortho import OrthoModel
from amers.services.simulation.world import World, make_world
from amers.services.types import Array, Frame, Observations
from benchmarks._joint_scenes import (
    ImagePlan,
    JointTruth,
    SceneTruth,
    errors_px,
    image_truth,
    joint_truth,
    measured_scene,
    places,
    tie_points,
)
from tests.services.ties import whitened_square

OPTIONS = RegistrationOptions()
SHAPE, GSD_M = (8000, 8000), 0.5
EXTENT_M = np.array([-2600.0, 2600.0, -2600.0, 2600.0])
FRAME = Frame.from_sigmas(1.5, 2.0)
VIEWS = ((-400.0, -400.0, 25.0, 80.0), (400.0, -300.0, 8.0, 200.0), (-300.0, 400.0, 20.0, 300.0))
TRIALS = 8


@cache
def world() -> World:
    return make_world(np.random.default_rng(1), size_m=1000.0, posting_m=2.0)


@cache
def origin() -> Array:
    return np.append(world().centre_lon_lat, 150.0)


def truth_of(rng: np.random.Generator, points: int = 80, **last: object) -> JointTruth:
    """Three overlapping images of 4 x 4 km; the last has features of its own."""
    plans = [
        ImagePlan(f"image {k + 1}", view[:2], view[2], view[3], SHAPE, GSD_M)
        for k, view in enumerate(VIEWS)
    ]
    plans[-1] = replace(plans[-1], **last)  # type: ignore[arg-type]
    images = [image_truth(plan, world(), origin(), rng) for plan in plans]
    ground = places(rng, origin(), EXTENT_M, points, 60.0)
    return joint_truth(images, ground, rng, frame=FRAME)


def observed(truth: JointTruth, rng: np.random.Generator) -> tuple[list[MeasuredScene], Observations]:
    scenes = [measured_scene(truth, k, rng) for k in range(len(truth.images))]
    return scenes, tie_points(truth.images, places(rng, origin(), EXTENT_M, 900, 60.0), rng)


def ortho_truth(
    like: SceneTruth, middle: Array, side: int, gsd_m: float, shift_px: tuple[float, float]
) -> SceneTruth:
    """An ortho-image around a place, off by a shift, a drift and a skew."""
    centre = MapGrid("EPSG:32631", np.zeros(2), np.eye(2), (2, 2)).line_sample(middle[None, :2])[0]
    step = gsd_m * np.array([[0.0, 1.0], [-1.0, 0.0]])
    grid = MapGrid("EPSG:32631", centre - step @ np.full(2, (side - 1) / 2.0), step, (side, side))
    plan = replace(like.plan, name="ortho", shape=(side, side), gsd_m=gsd_m)
    parameters = np.column_stack([shift_px, [[0.4, -0.3], [0.2, 0.5]]])
    geometry = replace(like.geometry, rpc=OrthoModel(grid))  # type: ignore[arg-type]
    return SceneTruth(plan, geometry, replace(no_correction(plan.shape), parameters=parameters))


def adjusted(seed: int | list[int], **last: object) -> tuple[JointTruth, JointBlock]:
    """A block of which all scenes fit."""
    rng = np.random.default_rng(seed)
    truth = truth_of(rng, **last)  # type: ignore[arg-type]
    block, left = adjust_fitting(*observed(truth, rng), OPTIONS)
    assert not left
    return truth, block


def normalised(truth: JointTruth, block: JointBlock, number: int) -> tuple[float, float]:
    """Mean squares of the errors at corners and centre over what is declared: relative, on the Earth."""
    adjustment = scene_adjustment(block, number, OPTIONS)
    at = image_places(SHAPE) * 0.98 + 0.01 * np.array(SHAPE)
    model = block.model(number)
    relative, earth = errors_px(truth, number, model, at)
    covariance = adjustment.covariance_at(at)
    ground = model.locate(at, np.full(len(at), origin()[2]))
    of_frame = frame_in_image(FRAME, model.project_derivative(ground), 0.0)
    on_earth = whitened_square(earth, covariance + of_frame).mean()
    return float(whitened_square(relative, covariance).mean()), float(on_earth)


@pytest.mark.monte_carlo
def test_errors_are_those_stated_relative_and_on_the_earth() -> None:
    squares = []
    for trial in range(TRIALS):
        truth, block = adjusted([1, trial])
        squares += [normalised(truth, block, number) for number in range(3)]
    relative, earth = np.mean(squares, axis=0)
    assert 0.4 < relative < 1.5
    assert 0.5 < earth < 1.7


@pytest.mark.long
def test_a_scene_with_few_points_is_held_by_the_ties_of_its_neighbours() -> None:
    alone, together = [], []
    for trial in range(4):
        rng = np.random.default_rng([2, trial])
        truth = truth_of(rng, found=0.14)
        scenes, ties = observed(truth, rng)
        block, left = adjust_fitting(scenes, ties, OPTIONS)
        assert not left
        at = image_places(SHAPE)
        together.append(errors_px(truth, 2, block.model(2), at)[0])
        own = adjust_together([scenes[2]], ties.take(np.zeros(len(ties), bool)), OPTIONS)
        alone.append(errors_px(truth, 2, own.model(0), at)[0])
        assert normalised(truth, block, 2)[0] < 4.0
    rms = [float(np.sqrt(np.mean(np.square(each)))) for each in (alone, together)]
    assert rms[1] < 0.6 * rms[0]


@pytest.mark.long
def test_a_single_scene_is_adjusted_as_it_is_alone() -> None:
    for trial in range(6):
        rng = np.random.default_rng([3, trial])
        truth = truth_of(rng)
        measured = measured_scene(truth, 0, rng)
        none = tie_points(truth.images[:1], truth.true_lon_lat_h, rng)
        block = adjust_together([measured], none, OPTIONS)
        assert measured.alone is not None
        at = image_places(SHAPE)
        joint, alone = scene_adjustment(block, 0, OPTIONS), measured.alone
        moved_px = joint.correction.apply(at) - alone.correction.apply(at)
        sigma_px = np.sqrt(np.diagonal(alone.covariance_at(at), 0, 1, 2))
        assert (np.abs(moved_px) < 1.0 * sigma_px).all()
        stated = np.sqrt(np.diagonal(joint.covariance_at(at), 0, 1, 2))
        assert 0.6 < np.median(stated / sigma_px) < 1.5


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("wave_px", [(5.0, 3.0), (0.0, 6.0)])
def test_a_scene_that_oscillates_is_followed_with_the_stated_accuracy(
    wave_px: tuple[float, float],
) -> None:
    squares, errors = [], []
    side = np.linspace(0.03, 0.97, 9) * SHAPE[0]
    at = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    for trial in range(TRIALS):
        truth, block = adjusted([5, trial], wave_px=wave_px)
        error, _ = errors_px(truth, 2, block.model(2), at)
        stated = scene_adjustment(block, 2, OPTIONS).covariance_at(at)
        squares.append(float(whitened_square(error, stated).mean()))
        errors.append(float(np.quantile(np.hypot(*error.T), 0.9)))
        assert max(normalised(truth, block, number)[0] for number in range(2)) < 4.0
    assert 0.5 < np.mean(squares) < 1.7
    assert np.median(errors) < 0.35 * np.hypot(*wave_px)


@pytest.mark.parametrize("bend_px", [(8.0, 0.0), (6.0, 6.0)])
@pytest.mark.long
def test_a_bent_scene_is_named_and_does_not_spoil_the_others(bend_px: tuple[float, float]) -> None:
    rng = np.random.default_rng(4)
    truth = truth_of(rng, bend_px=bend_px)
    scenes, ties = observed(truth, rng)
    block, left = adjust_fitting(scenes, ties, OPTIONS)
    assert [one.measured.name for one in left] == ["image 3"]
    assert "image 3" in str(left[0].error)
    assert max(normalised(truth, block, number)[0] for number in range(2)) < 4.0


def test_a_scene_of_other_ground_is_named() -> None:
    rng = np.random.default_rng(5)
    truth = truth_of(rng, found=0.0)
    scenes, ties = observed(truth, rng)
    ties = ties.take(ties.image != 2)
    ties = ties.take(np.bincount(ties.point)[ties.point] >= 2)
    ties = replace(ties, point=np.unique(ties.point, return_inverse=True)[1].astype(np.int64))
    block, left = adjust_fitting(scenes, ties, OPTIONS)
    assert [one.measured.name for one in left] == ["image 3"]
    assert [one.name for one in block.scenes] == ["image 1", "image 2"]


def test_a_repetition_without_holding_anything_out_is_the_block() -> None:
    _, block = adjusted(6)
    again = repeated(block, [np.zeros(0, dtype=np.int64)] * 3, None)
    for number in range(3):
        at = image_places(SHAPE)
        one, other = (scene_adjustment(each, number, OPTIONS) for each in (block, again))
        moved_px = one.correction.apply(at) - other.correction.apply(at)
        sigma_px = np.sqrt(np.diagonal(one.covariance_at(at), 0, 1, 2))
        assert (np.abs(moved_px) < 0.1 * sigma_px).all()
        np.testing.assert_allclose(one.covariance_at(at), other.covariance_at(at), rtol=0.1, atol=1e-4)


def test_every_scene_is_qualified_with_the_stability_of_the_block() -> None:
    _, block = adjusted(6)
    measures = [scene_measures(block, number, OPTIONS) for number in range(3)]
    draws = held_draws(measures, 3, 0.8, np.random.default_rng(6))
    drawn = [(held, repeated(block, held, None)) for held in draws]
    registration = registered_scene(block, 0, OPTIONS, drawn=drawn, cells=[])
    stability = registration.qualification.stability
    assert stability.draws == 3
    assert stability.held_out_per_draw >= 4
    largest_m = max(place.max_m for place in stability.displacements)
    assert 0.0 < largest_m < 1.0
    assert registration.qualification.verdict in ("good", "usable")
    assert scene_gsd_m(block.scenes[0].scene) == pytest.approx(GSD_M, rel=0.1)
    assert held_cells(measures)


def joining(seed: list[int], new: int, **last: object) -> tuple[float, float, JointBlock]:
    """A scene joins the two others: how far it lies from one adjustment of all, and its accuracy.

    Both as mean squares over what is stated.
    """
    rng = np.random.default_rng(seed)
    truth = truth_of(rng, **last)  # type: ignore[arg-type]
    scenes, ties = observed(truth, rng)
    redone, _ = adjust_fitting(scenes, ties, OPTIONS)
    old = [number for number in range(3) if number != new]
    first, _ = adjust_fitting([scenes[k] for k in old], ties_between(ties, old), OPTIONS)
    known = first.adjustment.known
    assert known is not None
    for k in old:
        scenes[k] = nothing_found(scenes[k].scene, scenes[k].points.take(np.zeros(0, np.int64)))
    joined, left = adjust_fitting(scenes, ties, OPTIONS, known)
    assert not left
    at = image_places(SHAPE)
    one, other = (scene_adjustment(each, new, OPTIONS) for each in (joined, redone))
    moved_px = one.correction.apply(at) - other.correction.apply(at)
    apart = float(whitened_square(moved_px, one.covariance_at(at)).mean())
    return apart, normalised(truth, joined, new)[0], joined


@pytest.mark.thorough
@pytest.mark.monte_carlo
def test_a_scene_that_joins_agrees_with_one_adjustment_of_all_scenes() -> None:
    apart, accurate, _ = zip(*(joining([10, trial], 2) for trial in range(4)), strict=True)
    assert np.mean(apart) < 0.5
    assert 0.1 < np.mean(accurate) < 2.5


@pytest.mark.thorough
def test_a_scene_that_joins_an_oscillating_one_is_tied_to_what_that_scene_truly_shows() -> None:
    waves = {"wave_px": (8.0, 5.0)}
    apart, _, blocks = zip(*(joining([12, trial], 0, **waves) for trial in range(3)), strict=True)
    assert np.mean(apart) < 0.5
    for joined in blocks:
        assert joined.adjustment.active[joined.of_ties(2)].mean() > 0.9


def test_an_ortho_image_joins_images_with_rpcs() -> None:
    """It tells positions, no heights, and is held by its own points and by ties like the others."""
    rng = np.random.default_rng(9)
    truth = truth_of(rng)
    ortho = ortho_truth(truth.images[2], origin(), 4000, 1.0, (7.0, -5.0))
    images = (*truth.images[:2], ortho)
    truth = replace(truth, images=images)
    scenes, ties = observed(truth, rng)
    block, left = adjust_fitting(scenes, ties, OPTIONS)
    assert not left
    for number, image in enumerate(images):
        at = image_places(image.shape)
        relative_px, _ = errors_px(truth, number, block.model(number), at)
        assert np.hypot(*relative_px.T).max() * image.plan.gsd_m < 0.6


def test_blocks_that_lie_apart_both_keep_their_points() -> None:
    rng = np.random.default_rng(11)
    truth = truth_of(rng)
    points = truth.points
    second = np.arange(len(points)) % 3 == 0
    moved_m = np.where(second[:, None], [2.0, -1.0, 1.0], 0.0)
    two = replace(
        points,
        lon_lat_h=move_metres(points.lon_lat_h, moved_m),
        block=second.astype(np.int64),
        frames=(FRAME, Frame.from_sigmas(1.5, 2.0)),
    )
    truth = replace(truth, points=two)
    scenes, ties = observed(truth, rng)
    block, left = adjust_fitting(scenes, ties, OPTIONS)
    assert not left
    used = block.adjustment.control_active
    assert used[block.control.source == 0].mean() > 0.9
    assert used[block.control.source == 1].mean() > 0.9
    for number in range(3):
        relative_px, _ = errors_px(truth, number, block.model(number), image_places(SHAPE))
        assert np.hypot(*relative_px.T).max() * GSD_M < 1.0


@pytest.mark.parametrize("shows_points", [True, False])
@pytest.mark.long
def test_a_scene_without_control_points_is_stated_with_those_of_its_neighbours(
    shows_points: bool,
) -> None:
    rng = np.random.default_rng(21)
    truth = truth_of(rng, found=0.0)
    scenes, ties = observed(truth, rng)
    if not shows_points:
        none = scenes[2].points.take(np.zeros(0, np.int64))
        scenes[2] = nothing_found(scenes[2].scene, none)
    block, left = adjust_fitting(scenes, ties, OPTIONS)
    assert not left
    qualification = qualified(block, range(3))[2].qualification
    assert qualification.verdict == "usable"
    assert qualification.point_counts.active == 0
    assert 0.1 < qualification.predicted.worst_m < 3.0
    on_earth_m = qualification.predicted.on_the_earth_worst_m
    assert 2.0 * FRAME.sigma_m < on_earth_m < 4.0 * FRAME.sigma_m


def test_control_points_are_held_out_of_all_scenes_that_show_them(registered) -> None:
    """A fifth of those that are used, whichever scenes use them."""
    measures = [registered(seed=seed).measures for seed in (0, 1)]
    used = np.union1d(*(one.point_id[one.active] for one in measures))
    for held in held_draws(measures, 4, 0.8, np.random.default_rng(3)):
        ids = [one.point_id[rows] for one, rows in zip(measures, held, strict=True)]
        drawn = np.union1d(*ids)
        assert len(drawn) == len(used) - round(0.8 * len(used))
        for one, own in zip(measures, ids, strict=True):
            np.testing.assert_array_equal(own, np.intersect1d(drawn, one.point_id[one.active]))


def test_what_points_share_is_in_the_accuracy_of_a_scene_of_a_block() -> None:
    """What the match of all is off by is a shift; a deformation of the points is more at corners."""
    rng = np.random.default_rng(22)
    truth = truth_of(rng)
    scenes, ties = observed(truth, rng)
    block, _ = adjust_fitting(scenes[:2], ties_between(ties, [0, 1]), OPTIONS)
    measured = block.scenes[0]
    search, common_m2 = measured.search, np.array([[0.04, 0.01], [0.01, 0.09]])
    deformed_m2 = np.diag([0.4, 0.2, 0.3])
    frames = tuple(replace(frame, shared_m2=deformed_m2) for frame in search.points.frames)
    shifted = replace(search, matches=replace(search.matches, common_covariance_m2=common_m2))
    deformed = replace(search, points=replace(search.points, frames=frames))
    last = np.array(SHAPE) - 1.0
    places = np.array([last / 2.0, [0.0, 0.0], last])

    def covariance_px2(of: MeasuredScene) -> Array:
        changed = replace(block, scenes=(of, *block.scenes[1:]))
        return scene_adjustment(changed, 0, OPTIONS).covariance_at(places)

    derivative = measured.scene.model.project_derivative(search.points.lon_lat_h).mean(axis=0)
    before = covariance_px2(measured)
    by_shift = covariance_px2(replace(measured, search=shifted)) - before
    own_px2 = derivative[:, :2] @ common_m2 @ derivative[:, :2].T
    np.testing.assert_allclose(by_shift, np.tile(own_px2, (3, 1, 1)), rtol=0.05, atol=0.005)
    by_deformation = covariance_px2(replace(measured, search=deformed)) - before
    own_px2 = derivative @ deformed_m2 @ derivative.T
    expected = np.array([0.5, 2.5, 2.5])[:, None, None] * own_px2
    np.testing.assert_allclose(by_deformation, expected, rtol=0.05, atol=0.02)
    assert measured.alone is not None
    seams = replace(measured, alone=replace(measured.alone, local_sigma_px=np.array([0.6, 0.8])))
    none = replace(measured, alone=replace(measured.alone, local_sigma_px=np.zeros(2)))
    by_seams = covariance_px2(seams) - covariance_px2(none)
    np.testing.assert_allclose(by_seams, np.tile(np.diag([0.36, 0.64]), (3, 1, 1)), atol=1e-6)


def test_bends_that_the_points_of_a_scene_leave_open_are_left_to_the_ties() -> None:
    own = options_in_block(OPTIONS).adjustment
    assert (OPTIONS.adjustment.bends, own.bends) == (True, False)
    assert own == replace(OPTIONS.adjustment, bends=False)


def test_a_point_that_one_of_the_scenes_left_shows_ties_nothing() -> None:
    """Of four scenes the first has left: its points remain where two others show them."""
    point, image = np.array([0, 0, 1, 1, 1, 2, 2, 3]), np.array([0, 1, 0, 2, 3, 2, 3, 1])
    line_sample = np.arange(16.0).reshape(8, 2)
    ties = Observations(point, image, line_sample, np.arange(8.0))
    own = ties_between(ties, [1, 2, 3])
    np.testing.assert_array_equal(own.point, [0, 0, 1, 1])
    np.testing.assert_array_equal(own.image, [1, 2, 1, 2])
    np.testing.assert_array_equal(own.line_sample, line_sample[3:7])
    np.testing.assert_array_equal(own.sigma_px, [3.0, 4.0, 5.0, 6.0])


def test_a_scene_fits_by_its_ties_and_by_its_control_where_either_are_enough() -> None:
    assert SceneFit(ties=100, used_ties=90, control=10, used_control=3, normalised=1.0).used == 0.3
    assert SceneFit(ties=100, used_ties=20, control=10, used_control=9, normalised=1.0).used == 0.2
    assert SceneFit(ties=100, used_ties=90, control=3, used_control=0, normalised=1.0).used == 0.9
    assert SceneFit(ties=3, used_ties=3, control=3, used_control=3, normalised=1.0).used == 0.0


@pytest.mark.parametrize(
    ("ties", "control", "stays"), [(11, 0, False), (12, 0, True), (2, 1, False), (2, 2, True)]
)
def test_a_scene_is_placed_by_twelve_ties_or_by_four_with_control(
    ties: int, control: int, stays: bool
) -> None:
    rng = np.random.default_rng(23)
    scenes, every = observed(truth_of(rng), rng)
    search = scenes[2].search
    inliers = search.inliers & (np.cumsum(scenes[2].usable) <= control)
    scenes[2] = replace(scenes[2], search=replace(search, inliers=inliers), alone=None)
    own = ties_between(every, [0, 1, 2])
    few = own.take((own.image != 2) | (np.cumsum(own.image == 2) <= ties))
    _, left = adjust_fitting(scenes, few, OPTIONS)
    told = [str(one.error) for one in left if one.measured.name == "image 3"]
    too_few = f"image 3: {ties} tie points and {control} control points found"
    assert any(one.startswith(too_few) for one in told) != stays
