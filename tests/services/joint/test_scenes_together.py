"""Rendered scenes registered together, on control points and tie points that are found in pixels."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.joint.registration import JointRegistration, register_together
from amers.services.quality.normal_law import normal_ce90
from amers.services.registration.on_points import register_scene
from amers.services.simulation.distortion import DistortedImage, Distortion, Waves
from amers.services.simulation.view import SimulatedView, simulate_view
from amers.services.types import Array
from tests.services.registration.test_on_points import SIGMA_M, frame_m, per_degree
from tests.services.simulated import block, plan, spoiled_view, world

pytestmark = [pytest.mark.long, pytest.mark.thorough]

NAMES = ("first", "second", "hazy", "elsewhere")


def named(scene: Scene, name: str) -> Scene:
    return replace(scene, acquisition=replace(scene.acquisition, image_id=name))


@cache
def views() -> tuple[SimulatedView, ...]:
    """Views from three sides, each tens of metres off and skewed."""
    skew = np.array([[0.0, 0.8, 1.5], [0.0, -0.7, -0.6]])
    sides = ((11.0, 200.0, (31.0, -24.0)), (18.0, 80.0, (-40.0, 30.0)), (8.0, 320.0, (5.0, -4.0)))
    return tuple(
        simulate_view(
            world(),
            plan(NAMES[k], incidence_deg=incidence, azimuth_deg=azimuth),
            np.random.default_rng(20 + k),
            error_m,
            skew.copy(),
        )
        for k, (incidence, azimuth, error_m) in enumerate(sides)
    )


@cache
def jitter() -> Distortion:
    """Lines that move by 2.5 px across the orbit, with a period of 80 % of the image."""
    lines, samples = views()[1].image.shape
    wave = Waves(np.array([[0.5, 2.5]]), np.array([0.8 * lines]), np.array([[0.3, 1.9]]))
    return Distortion((lines, samples), (wave,), (), None, "")


@cache
def scenes() -> tuple[Scene, ...]:
    """A clear view, one that shakes, one under haze but for an edge, and one of another world."""
    hazy = views()[2].pixels.astype(np.float32)
    noise = np.random.default_rng(7).normal(0.0, 150.0, hazy.shape).astype(np.float32)
    hazy[:, 250:] = (hazy * 0.12 + 2000.0 + noise)[:, 250:]
    made = [view.as_scene(SIGMA_M) for view in views()]
    made[1] = replace(made[1], image=DistortedImage(views()[1].image, jitter()))
    made[2] = replace(made[2], image=ArrayImage(hazy))
    other = spoiled_view(world_seed=5).as_scene(SIGMA_M)
    made.append(replace(other, model=made[0].model))
    return tuple(named(scene, name) for scene, name in zip(made, NAMES, strict=True))


@cache
def registered() -> JointRegistration:
    return register_together(scenes(), *block())


def errors_px(number: int) -> tuple[Array, Array]:
    """True errors (n, 2) of a registered scene in the frame of the block, and stated covariances."""
    result, geometry = registered().registrations[number], views()[number].geometry
    rng = np.random.default_rng(0)
    image = rng.uniform(0.03, 0.97, (400, 2)) * geometry.plan.shape
    shown = jitter().undistorted(image) if number == 1 else image
    ground = geometry.true_model.locate(shown, rng.uniform(*world().height_range_m, 400))
    error = result.model.project(ground + frame_m() / per_degree()) - image
    return error, result.adjustment.covariance_at(image)


def test_scenes_registered_together_lie_in_the_frame_of_the_block() -> None:
    result = registered()
    names = [result.block.scenes[number].name for number in result.numbers]
    assert names == ["first", "second", "hazy"]
    for number, registration in enumerate(result.registrations):
        assert np.quantile(np.hypot(*errors_px(number)[0].T), 0.9) < 0.5
        assert registration.qualification.verdict in ("good", "usable")
        assert registration.qualification.stability.draws == 10


def test_a_scene_whose_lines_move_is_followed_beside_others_with_the_stated_accuracy() -> None:
    shaking = registered().registrations[1]
    assert shaking.adjustment.components
    error, covariance = errors_px(1)
    predicted_px = np.median(normal_ce90(covariance))
    assert 0.2 * predicted_px < np.quantile(np.hypot(*error.T), 0.9) < 2.0 * predicted_px
    families = {structure.family for structure in shaking.adjustment.structures}
    assert {"lines", "steps", "samples", "image", "height"} <= families


def test_a_scene_of_other_ground_leaves_by_name() -> None:
    (left,) = registered().left
    assert left.measured.name == "elsewhere"
    assert "elsewhere: " in str(left.error)


def test_what_pixels_show_stays_with_the_scenes() -> None:
    """They are measured where a scene is searched, in another process as well."""
    assert all(one.scene.pixel_findings is not None for one in registered().block.scenes)


def test_a_scene_registered_by_itself_is_the_same() -> None:
    points, chips = block()
    joint = register_together(scenes()[:1], points, chips).registrations[0]
    alone = register_scene(scenes()[0], points, chips)
    image = np.random.default_rng(0).uniform(0.0, 700.0, (50, 2))
    moved_px = joint.adjustment.correction.apply(image) - alone.adjustment.correction.apply(image)
    sigma_px = np.sqrt(np.diagonal(alone.adjustment.covariance_at(image), 0, 1, 2))
    assert (np.abs(moved_px) < sigma_px).all()
    assert joint.measures.matched.tolist() == alone.measures.matched.tolist()
