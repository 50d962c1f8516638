"""A scene kilometres off is found to its final accuracy, or refused with how far was searched."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from amers.services.errors import NoConsensus
from amers.services.imagery.source import ArrayImage, Window
from amers.services.registration.context import SearchStage
from amers.services.registration.far import _contrast, _standardised
from amers.services.registration.on_points import Registration, register_scene
from amers.services.types import ChipArray, ChipSource
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


@pytest.mark.parametrize(
    ("gsds_m", "error_km"),
    [
        pytest.param((2.0, 20.0), 4.9, marks=pytest.mark.endurance),
        pytest.param((2.0,), 1.0, marks=pytest.mark.endurance),
        ((2.0,), 4.9),
    ],
)
def test_a_scene_kilometres_off_is_found(gsds_m: tuple[float, ...], error_km: float) -> None:
    east, north = (1000.0 * error_km * DIRECTION).tolist()
    points, chips = wide_points(10_000.0, 500.0, gsds_m)
    registration = register_scene(wide_scene(*SCENE, (east, north)), points, chips)
    first = registration.search_stages[0]
    assert first.search_radius_m >= 5000.0
    assert not first.limited
    assert first.name == ("coarse" if 20.0 in gsds_m else "far")
    assert largest_error_px(registration, SCENE) < FINAL_PX


@dataclass(frozen=True)
class PittedChips:
    """Chips of which a few pixels are lost: 3 on average, in 95 % of them at least one."""

    whole: ChipSource

    def read(self, file: str, row: int, count: int) -> ChipArray:
        chips = self.whole.read(file, row, count).copy()
        chips[np.random.default_rng(row).random(chips.shape) < 300e-6] = 0
        return chips


@pytest.mark.endurance
def test_a_small_crop_kilometres_off_is_found_also_by_chips_with_lost_pixels() -> None:
    east, north = (4900.0 * DIRECTION).tolist()
    points, chips = wide_points(6_500.0, 220.0, (2.0, 20.0))
    scene = wide_scene(*CROP, (east, north))
    registration = register_scene(scene, points, PittedChips(chips))
    assert registration.search_stages[0].name == "far"
    assert registration.search_stages[0].search_radius_m >= 5000.0
    assert largest_error_px(registration, CROP) < 4.0 * FINAL_PX


def test_a_mirrored_scene_hundreds_of_metres_off_is_refused_as_mirrored() -> None:
    points, chips = wide_points(2_500.0, 220.0, (2.0,))
    scene = replace(wide_scene(*CROP, (1_000.0, -700.0)), sigma_m=500.0)
    mirrored = ArrayImage(scene.image.read(Window(0, 0, *scene.image.shape))[:, ::-1])
    stages: list[SearchStage] = []
    with pytest.raises(NoConsensus, match=r"the image is mirrored.*by \d\d points that agree then"):
        register_scene(replace(scene, image=mirrored), points, chips, stages=stages)
    assert [stage.name for stage in stages] == ["far"]


@pytest.mark.endurance
def test_a_refusal_of_a_scene_too_large_for_the_map_names_the_middle_that_was_searched() -> None:
    # 44 km, of which chips of 2 m, reduced four times, let the middle 20 km be searched.
    points, chips = wide_points(4_000.0, 1_400.0, (2.0,))
    scene = wide_scene(44_000.0, 16.0, 2_750, (0.0, 0.0), seed=1)
    stages: list[SearchStage] = []
    with pytest.raises(NoConsensus, match=r"in the middle 20\.0 km of the scene only") as refused:
        register_scene(scene, points, chips, stages=stages)
    assert "give points with coarser chips, so that all of the scene is searched" in str(refused.value)
    assert stages[0].middle_m == pytest.approx(20_008.0)


@pytest.mark.endurance
def test_a_crop_of_other_ground_is_refused_with_how_far_was_searched() -> None:
    points, chips = wide_points(6_500.0, 440.0, (2.0,))
    with pytest.raises(NoConsensus, match=r"far search .* tried within 50\d\d m") as refused:
        register_scene(wide_scene(*CROP, (0.0, 0.0), seed=1), points, chips)
    assert "inf" not in str(refused.value)
    assert "nan" not in str(refused.value)


def test_contrast_makes_covariances_normalised_correlations() -> None:
    rng = np.random.default_rng(17)
    pixels = (100.0 + 20.0 * rng.normal(size=(60, 60))).astype(np.float32)
    chip = rng.normal(size=(11, 11)).astype(np.float32)
    found = cv2.matchTemplate(pixels, _standardised(chip), cv2.TM_CCORR) / _contrast(pixels, 11)
    np.testing.assert_allclose(found, cv2.matchTemplate(pixels, chip, cv2.TM_CCOEFF_NORMED), atol=1e-4)
