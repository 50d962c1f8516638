"""Rendered scenes registered together, on control points and tie points that are found in pixels."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from services.imagery.scene import Scene
from services.imagery.source import ArrayImage
from services.joint.registration import JointRegistration, register_together
from services.registration.on_points import register_scene
from services.simulation.view import SimulatedView, simulate_view
from tests.services.registration.test_on_points import SIGMA_M, ce90_px
from tests.services.simulated import block, plan, spoiled_view, world

pytestmark = pytest.mark.long

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
def scenes() -> tuple[Scene, ...]:
    """Two clear views, one under haze but for an edge, and one of another world."""
    hazy = views()[2].pixels.astype(np.float32)
    noise = np.random.default_rng(7).normal(0.0, 150.0, hazy.shape).astype(np.float32)
    hazy[:, 250:] = (hazy * 0.12 + 2000.0 + noise)[:, 250:]
    made = [view.as_scene(SIGMA_M) for view in views()]
    made[2] = replace(made[2], image=ArrayImage(hazy))
    other = spoiled_view(world_seed=5).as_scene(SIGMA_M)
    made.append(replace(other, model=made[0].model))
    return tuple(named(scene, name) for scene, name in zip(made, NAMES, strict=True))


@cache
def registered() -> JointRegistration:
    return register_together(scenes(), *block())


def test_scenes_registered_together_lie_in_the_frame_of_the_block() -> None:
    result = registered()
    names = [result.block.scenes[number].name for number in result.numbers]
    assert names == ["first", "second", "hazy"]
    for view, registration in zip(views(), result.registrations, strict=True):
        assert ce90_px(view, registration) < 0.5
        assert registration.qualification.verdict in ("good", "usable")
        assert registration.qualification.stability.draws == 10


def test_a_scene_of_other_ground_leaves_by_name() -> None:
    (left,) = registered().left
    assert left.measured.name == "elsewhere"
    assert "elsewhere: " in str(left.error)


def test_a_scene_registered_by_itself_is_the_same() -> None:
    points, chips = block()
    joint = register_together(scenes()[:1], points, chips).registrations[0]
    alone = register_scene(scenes()[0], points, chips)
    image = np.random.default_rng(0).uniform(0.0, 700.0, (50, 2))
    moved_px = joint.adjustment.correction.apply(image) - alone.adjustment.correction.apply(image)
    sigma_px = np.sqrt(np.diagonal(alone.adjustment.covariance_at(image), 0, 1, 2))
    assert (np.abs(moved_px) < sigma_px).all()
    assert joint.measures.matched.tolist() == alone.measures.matched.tolist()
