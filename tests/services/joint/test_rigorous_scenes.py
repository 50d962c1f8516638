"""Rigorous models registered together with RPCs and ortho-images: as accurate as stated, and by name."""

from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import pytest

from amers.services.adjustment.rigorous_parameters import RigorousParameters, rigorous_parameters
from amers.services.errors import InputError
from amers.services.imagery.scene import Scene
from amers.services.joint.block import JointBlock, adjust_together
from amers.services.joint.fitting import adjust_fitting, ties_between
from amers.services.joint.measured import MeasuredScene, nothing_found
from amers.services.joint.model_errors import _variance
from amers.services.joint.nearest import nearest_correction, scene_heights_m
from amers.services.joint.registration import qualified
from amers.services.joint.results import rigorous_scene, scene_adjustment
from amers.services.quality.stability import image_places
from amers.services.registration.options import RegistrationOptions
from amers.services.sensors.correction import CorrectedModel
from amers.services.sensors.parameter_sets import SRP, TOUTIN, ParameterSet
from amers.services.sensors.pushbroom import PushbroomModel
from amers.services.sensors.refined import refined_rpc
from amers.services.sensors.rpc_fit import fit_rpc
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
from tests.services.joint.test_joint_block import ortho_truth, world
from tests.services.ties import whitened_square

pytestmark = pytest.mark.thorough

OPTIONS = RegistrationOptions()
SHAPE, GSD_M = (16000, 16000), 1.5
EXTENT_M = np.array([-14000.0, 14000.0, -14000.0, 14000.0])
RELIEF_M = 500.0
HEIGHTS_M = (0.0, 1200.0)
FRAME = Frame.from_sigmas(1.5, 2.0)
VIEWS = ((-1500.0, -1500.0, 25.0, 80.0), (1500.0, -1000.0, 12.0, 250.0), (-1000.0, 1500.0, 20.0, 300.0))
TRIALS = 6


@dataclass(frozen=True)
class RigorousTruth(SceneTruth):
    """An image whose satellite is off by terms of a set; its delivered model is the rigorous one."""

    delivered: RigorousParameters
    values: Array
    parameter_set: ParameterSet

    def position(self, lon_lat_h: Array) -> Array:
        return self.moved(self.delivered.corrected(self.values).project(lon_lat_h))

    def scene(self) -> Scene:
        model = self.delivered.model
        return replace(super().scene(), model=model, parameter_set=self.parameter_set)


@dataclass(frozen=True)
class BrokenTruth(RigorousTruth):
    """An image of which 25 lines were lost in the middle."""

    def position(self, lon_lat_h: Array) -> Array:
        position = super().position(lon_lat_h)
        position[:, 0] -= np.where(position[:, 0] > 0.5 * self.shape[0], 25.0, 0.0)
        return position


@cache
def origin() -> Array:
    return np.append(world().centre_lon_lat, 600.0)


def rigorous_truth(
    plan: ImagePlan, free: ParameterSet, rng: np.random.Generator, values: Array | None = None
) -> RigorousTruth:
    image = image_truth(plan, world(), origin(), rng)
    model = replace(image.geometry.true_model, height_range_m=HEIGHTS_M)
    delivered = rigorous_parameters(plan.name, model, free, sigma_m=plan.sigma_m)
    drawn = rng.normal(0.0, delivered.sigma) if values is None else values
    return RigorousTruth(plan, image.geometry, image.error, delivered, drawn, free)


def rpc_truth(plan: ImagePlan, rng: np.random.Generator) -> SceneTruth:
    """An image with an RPC for all heights of the block."""
    image = image_truth(plan, world(), origin(), rng)
    rpc = fit_rpc(image.geometry.true_model, plan.shape, HEIGHTS_M).model
    return replace(image, geometry=replace(image.geometry, rpc=rpc))


def plan_of(number: int, **other: object) -> ImagePlan:
    view = VIEWS[number]
    plan = ImagePlan(f"image {number + 1}", view[:2], view[2], view[3], SHAPE, GSD_M)
    return replace(plan, **other)  # type: ignore[arg-type]


def mixed(rng: np.random.Generator, free: ParameterSet = SRP, points: int = 80) -> JointTruth:
    """Two images with rigorous models, one with an RPC, and an ortho-image."""
    rigorous = [rigorous_truth(plan_of(number), free, rng) for number in (0, 1)]
    rpc = rpc_truth(plan_of(2), rng)
    ground = places(rng, origin(), EXTENT_M, points, RELIEF_M)
    ortho = ortho_truth(rpc, origin(), 8000, 3.0, (2.5, -1.5))
    return joint_truth([*rigorous, rpc, ortho], ground, rng, frame=FRAME)


def observed(truth: JointTruth, rng: np.random.Generator) -> tuple[list[MeasuredScene], Observations]:
    scenes = [measured_scene(truth, k, rng) for k in range(len(truth.images))]
    return scenes, tie_points(truth.images, places(rng, origin(), EXTENT_M, 900, RELIEF_M), rng)


def normalised(truth: JointTruth, block: JointBlock, number: int) -> float:
    """Mean square of the errors relative to the points at corners and centre over what is declared."""
    shape = truth.images[number].shape
    at = image_places(shape) * 0.98 + 0.01 * np.array(shape)
    error, _ = errors_px(truth, number, block.model(number), at)
    stated = scene_adjustment(block, number, OPTIONS).covariance_at(at)
    return float(whitened_square(error, stated).mean())


def largest_m(truth: JointTruth, block: JointBlock, number: int) -> float:
    image = truth.images[number]
    error, _ = errors_px(truth, number, block.model(number), image_places(image.shape))
    return float(np.hypot(*error.T).max() * image.plan.gsd_m)


@pytest.mark.monte_carlo
@pytest.mark.parametrize("free", [SRP, TOUTIN], ids=["SRP", "Toutin"])
def test_a_mixed_block_is_as_accurate_as_stated(free: ParameterSet) -> None:
    squares, of_parameters, errors_m = [], [], []
    for trial in range(TRIALS):
        rng = np.random.default_rng([31, trial])
        truth = mixed(rng, free)
        block, left = adjust_fitting(*observed(truth, rng), OPTIONS)
        assert not left
        squares.append([normalised(truth, block, number) for number in range(4)])
        errors_m.append([largest_m(truth, block, number) for number in range(4)])
        for number in (0, 1):
            # Parameters absorb the frame of the points; drifts and the yaw do not.
            image, found = truth.images[number], rigorous_scene(block, number)
            assert isinstance(image, RigorousTruth)
            assert found is not None
            unit = np.array([parameter.per_px for parameter in image.delivered.parameters])
            for own, true in zip(found.parameters, image.values * unit, strict=True):
                if "drift" in own.name or own.name == "yaw":
                    of_parameters.append(((own.value - true) / own.sigma) ** 2)
    assert (np.mean(errors_m, axis=0) < 1.0).all()
    assert 0.4 < np.mean(np.array(squares)[:, :2]) < 1.6
    assert 0.4 < np.mean(squares) < 1.6
    assert 0.5 < np.mean(of_parameters) < 1.6


@pytest.mark.monte_carlo
def test_a_rigorous_scene_that_joins_agrees_with_one_adjustment_of_all_scenes() -> None:
    """It joins a mixed block; and an image with an RPC joins a block of rigorous models alone."""
    squares, accurate = [], []
    for trial in range(4):
        rng = np.random.default_rng([32, trial])
        truth = mixed(rng)
        scenes, ties = observed(truth, rng)
        redone, _ = adjust_fitting(scenes, ties, OPTIONS)
        for new, order in ((1, [0, 2, 3, 1]), (2, [0, 1, 2])):
            first, _ = adjust_fitting(
                [scenes[k] for k in order[:-1]], ties_between(ties, order[:-1]), OPTIONS
            )
            known = first.adjustment.known
            assert known is not None
            assert {len(own) for own in known.parameters} == ({6, 7} if new == 1 else {7})
            none = np.zeros(0, np.int64)
            before = [nothing_found(scenes[k].scene, scenes[k].points.take(none)) for k in order[:-1]]
            joined, left = adjust_fitting(
                [*before, scenes[new]], ties_between(ties, order), OPTIONS, known
            )
            assert not left
            last, shape = len(order) - 1, truth.images[new].shape
            at = image_places(shape) * 0.98 + 0.01 * np.array(shape)
            ground = redone.model(new).locate(at, np.full(len(at), origin()[2]))
            moved_px = joined.model(last).project(ground) - at
            stated = scene_adjustment(joined, last, OPTIONS).covariance_at(at)
            squares.append(whitened_square(moved_px, stated).mean())
            one = replace(truth, images=tuple(truth.images[k] for k in order))
            accurate.append(normalised(one, joined, last))
    assert np.mean(squares) < 0.6
    assert 0.2 < np.mean(accurate) < 2.0


@pytest.mark.parametrize(
    ("wave_px", "free", "told"),
    [
        ((0.0, 0.0), TOUTIN, "the parameters roll, .* are free, and the n"),
        ((5.0, 3.0), SRP, ".* register the scenes of both together"),
    ],
    ids=["other free parameters", "a satellite that turns, whose motion is not kept"],
)
def test_a_scene_that_cannot_join_is_refused(
    wave_px: tuple[float, float], free: ParameterSet, told: str
) -> None:
    rng = np.random.default_rng(33)
    truth = mixed(rng)
    oscillating = rigorous_truth(plan_of(0, wave_px=wave_px), SRP, rng)
    scenes, ties = observed(replace(truth, images=(oscillating, *truth.images[1:])), rng)
    first, _ = adjust_fitting(scenes[:2], ties_between(ties, [0, 1]), OPTIONS)
    none = scenes[0].points.take(np.zeros(0, np.int64))
    other = replace(scenes[0].scene, parameter_set=free)
    before = [nothing_found(scene, none) for scene in (other, scenes[1].scene)]
    with pytest.raises(InputError, match=f"image 1: {told}"):
        adjust_fitting(
            [*before, scenes[2]], ties_between(ties, [0, 1, 2]), OPTIONS, first.adjustment.known
        )


@pytest.mark.long
def test_the_nearest_correction_states_what_it_misses() -> None:
    """At other places than those of the fit, positions and their variances are those of the model."""
    rng = np.random.default_rng(34)
    truth = mixed(rng, TOUTIN)
    block, _ = adjust_fitting(*observed(truth, rng), OPTIONS)
    nearest, low_high = nearest_correction(block, 0), scene_heights_m(block, 0)
    assert low_high[0] < origin()[2] - 0.8 * RELIEF_M < origin()[2] + 0.8 * RELIEF_M < low_high[1]
    delivered = block.images[0].model
    at = rng.uniform(0.0, SHAPE[0], (2000, 2))
    ground = delivered.locate(at, rng.uniform(*low_high, 2000))
    off_px = CorrectedModel(delivered, nearest.correction).project(ground) - block.model(0).project(
        ground
    )
    largest_px = np.hypot(*off_px.T).max()
    assert 0.5 * nearest.max_error_px < largest_px < 1.05 * nearest.max_error_px
    exact = _variance(block, 0, ground)
    affine = nearest.correction.covariance_at(at, nearest.covariance, nearest.local_px)
    ratio = np.diagonal(affine, 0, 1, 2).mean(axis=0) / exact.mean(axis=0)
    np.testing.assert_allclose(ratio, 1.0, rtol=0.05)


@pytest.mark.long
def test_every_scene_of_a_mixed_block_is_qualified_and_has_an_rpc() -> None:
    rng = np.random.default_rng(35)
    truth = mixed(rng)
    block, _ = adjust_fitting(*observed(truth, rng), OPTIONS)
    options = replace(OPTIONS, qualification=replace(OPTIONS.qualification, draws=3))
    registrations = qualified(block, range(4), options)
    assert {one.qualification.verdict for one in registrations} <= {"good", "usable"}
    for number, registration in enumerate(registrations):
        stability = registration.qualification.stability
        assert stability.draws == 3
        gsd_m = truth.images[number].plan.gsd_m
        assert 0.0 < max(place.max_px for place in stability.displacements) * gsd_m < 1.0
    found = rigorous_scene(block, 0)
    assert found is not None
    assert rigorous_scene(block, 2) is None
    assert [own.name for own in found.parameters][:3] == ["roll", "pitch", "yaw"]
    refined = refined_rpc(block.model(0), SHAPE, found.heights_m)
    assert refined.model is not None
    assert refined.max_error_px < 0.01


@pytest.mark.monte_carlo
@pytest.mark.parametrize("wave_px", [(5.0, 3.0), (0.0, 6.0)])
def test_a_rigorous_scene_that_oscillates_is_followed_with_the_stated_accuracy(
    wave_px: tuple[float, float],
) -> None:
    """The motion is in the attitude of its model, and in the correction that is nearest to it."""
    squares, errors, attitudes = [], [], []
    side = np.linspace(0.03, 0.97, 9) * SHAPE[0]
    at = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    for trial in range(TRIALS):
        rng = np.random.default_rng([37, trial])
        truth = mixed(rng)
        oscillating = rigorous_truth(plan_of(0, wave_px=wave_px), SRP, rng)
        truth = replace(truth, images=(oscillating, *truth.images[1:]))
        block, left = adjust_fitting(*observed(truth, rng), OPTIONS)
        assert not left
        model = block.model(0)
        assert isinstance(model, PushbroomModel)
        error, _ = errors_px(truth, 0, model, at)
        stated = scene_adjustment(block, 0, OPTIONS).covariance_at(at)
        squares.append(float(whitened_square(error, stated).mean()))
        errors.append(float(np.quantile(np.hypot(*error.T), 0.9)))
        nearest = nearest_correction(block, 0)
        assert nearest.correction.displacement is not None
        assert nearest.max_error_px < 0.3
        attitudes.append(len(model.attitude.breaks) > len(oscillating.delivered.model.attitude.breaks))
        assert max(normalised(truth, block, number) for number in range(1, 4)) < 4.0
    assert all(attitudes)
    assert 0.5 < np.mean(squares) < 1.7
    assert np.median(errors) < 0.35 * np.hypot(*wave_px)


@pytest.mark.monte_carlo
def test_a_rigorous_scene_that_lost_lines_is_right_on_both_sides_of_them() -> None:
    """Its points say where the lines are missing to within the gap between two of them."""
    squares, errors = [], []
    for trial in range(TRIALS):
        rng = np.random.default_rng([38, trial])
        truth = mixed(rng)
        whole = rigorous_truth(plan_of(0, name="broken"), SRP, rng)
        broken = BrokenTruth(**{field.name: getattr(whole, field.name) for field in fields(whole)})
        truth = replace(truth, images=(broken, *truth.images[1:]))
        block, left = adjust_fitting(*observed(truth, rng), OPTIONS)
        assert not left
        at = rng.uniform(0.0, 1.0, (2000, 2)) * SHAPE
        at = at[np.abs(at[:, 0] - 0.5 * SHAPE[0]) > 2000.0]
        error, _ = errors_px(truth, 0, block.model(0), at)
        stated = scene_adjustment(block, 0, OPTIONS).covariance_at(at)
        squares.append(float(whitened_square(error, stated).mean()))
        errors.append(float(np.quantile(np.hypot(*error.T), 0.9)))
    assert 0.5 < np.mean(squares) < 2.5
    assert np.median(errors) < 1.0


@pytest.mark.long
def test_a_bent_rigorous_scene_is_named_and_does_not_spoil_the_others() -> None:
    rng = np.random.default_rng(36)
    truth = mixed(rng)
    bent = rigorous_truth(plan_of(0, name="bent", bend_px=(8.0, 4.0)), SRP, rng)
    truth = replace(truth, images=(bent, *truth.images[1:]))
    block, left = adjust_fitting(*observed(truth, rng), OPTIONS)
    assert [one.measured.name for one in left] == ["bent"]
    without = replace(truth, images=truth.images[1:])
    assert max(normalised(without, block, number) for number in range(3)) < 4.0
    assert max(largest_m(without, block, number) for number in range(3)) < 1.2


@pytest.mark.long
def test_what_no_affine_correction_states_of_a_rigorous_model_is_in_its_accuracy() -> None:
    """At the lowest and the highest ground: a tenth of the variance of lines, by this set."""
    rng = np.random.default_rng(34)
    truth = mixed(rng, SRP)
    truth = replace(truth, images=truth.images[:1])
    measured = measured_scene(truth, 0, rng)
    block = adjust_together([measured], tie_points(truth.images, truth.true_lon_lat_h, rng), OPTIONS)
    at = rng.uniform(0.0, SHAPE[0], (2000, 2))
    ground = block.images[0].model.locate(at, rng.choice(scene_heights_m(block, 0), 2000))
    exact = _variance(block, 0, ground).mean(axis=0)
    local_px2 = nearest_correction(block, 0).local_px ** 2
    assert local_px2[0] > 0.08 * exact[0]
    adjustment = scene_adjustment(block, 0, OPTIONS)
    assert measured.alone is not None
    other_px2 = measured.alone.local_sigma_px**2
    stated = np.diagonal(adjustment.covariance_at(at), 0, 1, 2).mean(axis=0) - other_px2
    # Borders count more than in the mean of an image.
    assert ((0.97 * exact < stated) & (stated < 1.1 * exact)).all()
