"""A scene that lies beside its model by much of its size is found by small chips in a map of it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from amers.services.conventions import CHIP_SIZE
from amers.services.errors import NoConsensus
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage, Window
from amers.services.registration.context import Prediction, RegistrationContext, SearchStage
from amers.services.registration.far import _contrast, _standardised, search_far
from amers.services.types import Array
from tests.services.registration.small_ground import (
    GSD_M,
    POINT_SIGMA_M,
    context_of,
    many_points,
    predicted,
    scene,
)
from tests.services.simulated import MemoryChips

SIGMA_M = 100.0
OFF_M = np.array([265.0, -205.0])
"""Nearly as far as three standard deviations in one direction."""


def found(of: Scene, **coarse: float) -> tuple[Prediction, SearchStage]:
    """The prediction after the search, and its summary."""
    context: RegistrationContext = context_of(of, **coarse)
    points, chips = many_points()
    prediction = search_far(context, points, chips, predicted(of, points), GSD_M)
    (stage,) = context.stages
    return prediction, stage


def error_px(prediction: Prediction, of: Scene, off_m: Array) -> float:
    """Largest distance between the predicted and the true positions of the points."""
    points, _ = many_points()
    true = of.model.project(points.lon_lat_h) + np.array([-off_m[1], off_m[0]]) / GSD_M
    return float(np.hypot(*(prediction.model.project(points.lon_lat_h) - true).T).max())


@pytest.mark.parametrize("off_m", [OFF_M, [-205.0, 265.0]])
@pytest.mark.parametrize("lines", [300, 400])
def test_a_scene_is_found_nearly_three_sigmas_away(off_m: Array, lines: int) -> None:
    of = scene(np.array(off_m), SIGMA_M, lines)
    prediction, stage = found(of)
    assert error_px(prediction, of, np.array(off_m)) < 0.3
    assert stage.name == "far"
    assert stage.needed_radius_m == pytest.approx(3.0 * np.hypot(SIGMA_M, POINT_SIGMA_M))
    assert stage.needed_radius_m < stage.search_radius_m < stage.needed_radius_m + 4.0 * GSD_M
    assert stage.matched == stage.inliers > 20
    (group,) = stage.candidates
    assert group.points == stage.inliers
    np.testing.assert_allclose([group.east_m, group.north_m], off_m, atol=GSD_M)
    assert stage.displacement_rms_m == pytest.approx(np.hypot(*off_m), abs=GSD_M)
    assert np.isnan(stage.middle_m)


def test_a_position_is_as_uncertain_as_shifts_agree_and_as_its_point() -> None:
    """Shifts agree within three pixels of the chips, and half of that is a standard deviation."""
    uncertainty_m = found(scene(OFF_M, SIGMA_M))[0].uncertainty_m
    np.testing.assert_allclose(uncertainty_m, np.hypot(POINT_SIGMA_M, 1.5 * GSD_M))


def test_a_scene_farther_off_than_it_states_is_not_found() -> None:
    for off_m in (np.array([350.0, 0.0]), np.array([0.0, -350.0])):
        with pytest.raises(NoConsensus, match="far search does not agree"):
            found(scene(off_m, SIGMA_M))


def test_an_image_of_the_other_contrast_is_found_by_its_gradients() -> None:
    of = scene(OFF_M, SIGMA_M)
    negative = replace(of, image=ArrayImage(1000.0 - of.image.read(Window(0, 0, 400, 400))))
    assert error_px(found(negative)[0], negative, OFF_M) < 0.5


def test_a_search_that_finds_nothing_is_refused_though_some_points_have_no_chip() -> None:
    """The second try, by gradients, has no gradients of a chip that is missing."""
    of = scene(OFF_M, SIGMA_M)
    noise = np.random.default_rng(4).normal(500.0, 50.0, (400, 400)).astype(np.float32)
    points, chips = many_points()
    without = chips.chips.copy()
    without[::2] = 0
    other = replace(of, image=ArrayImage(noise))
    context = context_of(other)
    with pytest.raises(NoConsensus, match="far search does not agree"):
        search_far(context, points, MemoryChips(without), predicted(other, points), GSD_M)


def test_missing_pixels_hide_their_points_alone() -> None:
    of = scene(OFF_M, SIGMA_M)
    pixels = of.image.read(Window(0, 0, 400, 400))
    pixels[:, 250:] = np.nan
    prediction, stage = found(replace(of, image=ArrayImage(pixels)))
    assert error_px(prediction, of, OFF_M) < 0.6
    assert 5 < stage.inliers < 25


@pytest.mark.parametrize(("share", "reduction"), [(1.1, 1), (0.9, 2), (0.5, 2), (0.27, 2), (0.2, 3)])
def test_chips_and_map_are_reduced_until_the_work_is_bounded(
    monkeypatch: pytest.MonkeyPatch, share: float, reduction: int
) -> None:
    """The work are the pixels under all chips, wherever they are searched."""
    of = scene(np.array([150.0, -160.0]), 80.0)
    points = 60
    _, stage = found(of, points=points)
    pixels = stage.tried * (2.0 * stage.needed_radius_m / GSD_M + CHIP_SIZE) ** 2
    monkeypatch.setattr("amers.services.registration.far.MAX_CORRELATED_PX", share * pixels / points)
    prediction, reduced = found(of, points=points)
    assert reduced.chip_gsd_m == reduction * GSD_M
    assert error_px(prediction, of, np.array([150.0, -160.0])) < 0.5 * reduction


def test_chips_are_reduced_until_the_map_holds_the_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    """From its first to its last pixel a scene of 400 pixels has 399 of them: 798 m."""
    of = scene(OFF_M, SIGMA_M)
    monkeypatch.setattr("amers.services.registration.far.MAX_MAP_SIDE", 201)
    prediction, stage = found(of)
    assert stage.chip_gsd_m == 4.0
    assert np.isnan(stage.middle_m)
    assert error_px(prediction, of, OFF_M) < 0.5


def test_of_a_scene_that_is_too_large_for_the_map_the_middle_is_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    of = scene(np.array([40.0, -60.0]), 30.0)
    monkeypatch.setattr("amers.services.registration.far.MAX_MAP_SIDE", 301)
    prediction, stage = found(of, max_reduction=1)
    assert stage.middle_m == 301 * GSD_M
    assert error_px(prediction, of, np.array([40.0, -60.0])) < 0.3


def test_chips_with_lost_pixels_are_searched_as_well() -> None:
    """Three of each on average, as impulses leave them."""
    of, (points, chips) = scene(OFF_M, SIGMA_M), many_points()
    pitted = chips.chips.copy()
    pitted[np.random.default_rng(2).random(pitted.shape) < 300e-6] = 0
    prediction = search_far(context_of(of), points, MemoryChips(pitted), predicted(of, points), GSD_M)
    assert error_px(prediction, of, OFF_M) < 0.3


def test_contrast_makes_covariances_normalised_correlations() -> None:
    rng = np.random.default_rng(17)
    pixels = (100.0 + 20.0 * rng.normal(size=(60, 60))).astype(np.float32)
    chip = rng.normal(size=(11, 11)).astype(np.float32)
    found = cv2.matchTemplate(pixels, _standardised(chip), cv2.TM_CCORR) / _contrast(pixels, 11)
    np.testing.assert_allclose(found, cv2.matchTemplate(pixels, chip, cv2.TM_CCOEFF_NORMED), atol=1e-4)
