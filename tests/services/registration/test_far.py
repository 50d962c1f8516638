"""A scene kilometres off is found to its final accuracy, or refused with how far was searched."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.errors import NoConsensus
from amers.services.imagery.source import ArrayImage, Window
from amers.services.registration.context import SearchStage
from amers.services.registration.on_points import Registration, register_scene
from tests.services.registration.wide_ground import CENTRE, true_model, wide_points, wide_scene

pytestmark = [pytest.mark.long, pytest.mark.thorough]

SCENE = (10_000.0, 2.0, 5_000)
"""Size of the scene, ground sampling, side of what is delivered of it."""
CROP = (20_000.0, 0.5, 3_000)
"""1.5 km of a scene of 20 km."""
FINAL_PX = 0.3
DIRECTION = np.array([0.8, -0.6])


def largest_error_px(registration: Registration, case: tuple[float, float, int]) -> float:
    """Largest distance of the registered model from the true model over the image."""
    side = case[2]
    axis = np.linspace(0.0, side - 1.0, 5)
    shown = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    truth = true_model(*case)
    ground = truth.locate(shown, np.full(len(shown), CENTRE[2]))
    return float(np.linalg.norm(registration.model.project(ground) - shown, axis=1).max())


COARSE = pytest.param((2.0, 20.0), marks=pytest.mark.endurance)


@pytest.mark.parametrize("gsds_m", [COARSE, (2.0,)])
def test_a_scene_kilometres_off_is_found(gsds_m: tuple[float, ...]) -> None:
    east, north = (4900.0 * DIRECTION).tolist()
    points, chips = wide_points(10_000.0, 500.0, gsds_m)
    registration = register_scene(wide_scene(*SCENE, (east, north)), points, chips)
    first = registration.search_stages[0]
    assert first.search_radius_m >= 5000.0
    assert not first.limited
    assert first.name == ("coarse" if 20.0 in gsds_m else "far")
    assert largest_error_px(registration, SCENE) < FINAL_PX


def test_a_mirrored_scene_hundreds_of_metres_off_is_refused_as_mirrored() -> None:
    points, chips = wide_points(2_500.0, 220.0, (2.0,))
    scene = replace(wide_scene(*CROP, (1_000.0, -700.0)), sigma_m=500.0)
    mirrored = ArrayImage(scene.image.read(Window(0, 0, *scene.image.shape))[:, ::-1])
    stages: list[SearchStage] = []
    with pytest.raises(NoConsensus, match=r"the image is mirrored.*by \d\d points that agree then"):
        register_scene(replace(scene, image=mirrored), points, chips, stages=stages)
    assert [stage.name for stage in stages] == ["far"]
