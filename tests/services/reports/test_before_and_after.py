"""The points of a report before and after: the raw scene is displaced, the registered one is not."""

from functools import cache

import cv2
import numpy as np
import pytest

from amers.services.registration.on_points import register_scene
from amers.services.reports.figure_data import ChipComparison, FigureData, figure_data
from amers.services.types import Array, ChipArray
from tests.services.registration.test_on_points import frame_m
from tests.services.simulated import block, spoiled_view

pytestmark = pytest.mark.long

ERROR_M = np.array([5.0, -4.0])
"""Of the delivered model on the ground, east and north; pixels of chips are of one metre."""
SIGMA_M = 15.0
half_a_pixel, a_pixel = 0.5, 1.0


@cache
def drawn() -> FigureData:
    """What the report of a scene draws whose model is off by a known distance, without skew."""
    scene = spoiled_view((float(ERROR_M[0]), float(ERROR_M[1])), skew_px=0.0, seed=13).as_scene(SIGMA_M)
    return figure_data(scene, *block(), register_scene(scene, *block()))


def displacement_px(reference: ChipArray, image: ChipArray) -> Array:
    """East and north displacement of an image against another, by phase correlation."""
    window = cv2.createHanningWindow(reference.shape[::-1], cv2.CV_64F)
    east, south = cv2.phaseCorrelate(
        *(np.nan_to_num(one).astype(float) for one in (reference, image)), window
    )[0]
    return np.array([east, -south])


def active() -> list[ChipComparison]:
    return [one for one in drawn().gallery if one.status == "active"]


def test_the_raw_scene_is_displaced_by_the_error_of_the_delivered_model() -> None:
    moved_px = np.array([displacement_px(one.registered, one.raw) for one in active()])
    # The ground of the block is not quite the true one: the correction of both errors is what is seen.
    corrected_m = ERROR_M + frame_m()[:2]
    np.testing.assert_allclose(np.median(moved_px, axis=0), -corrected_m, atol=a_pixel)
    assert np.hypot(*np.median(moved_px, axis=0)) > 4.0


def test_the_registered_scene_shows_the_chip_in_its_place() -> None:
    off_px = np.array([displacement_px(one.chip, one.registered) for one in active()])
    assert np.hypot(*np.median(off_px, axis=0)) < half_a_pixel
