"""The two accuracies that every place states, against true errors of frames seen by oblique models."""

import numpy as np
import pytest

from services.quality.accuracy_statement import points_accuracy, scene_accuracy
from services.quality.frames import frame_in_image
from services.quality.normal_law import normal_ce90
from services.types import UNKNOWN_FRAME, Frame

a_percent = 0.01
TILTED = Frame(np.array([[1.8, 0.3, 0.9], [0.3, 1.7, -2.0], [0.9, -2.0, 25.0]]))
MEDIAN_M2 = np.diag([0.2, 0.2, 0.5]) ** 2
OBLIQUE = np.array([[[0.1, -1.9, 0.3], [2.0, 0.2, -1.1]]])
"""Pixels per metre east, north, up, of a view 30 degrees off the vertical."""


def test_an_error_of_the_frame_moves_the_ground_as_its_covariance_says():
    """Monte Carlo: where an oblique model registered in a wrong frame puts ground of known height."""
    error = np.random.default_rng(1).multivariate_normal(np.zeros(3), TILTED.covariance_m2, 400_000)
    moved_px = error @ OBLIQUE[0].T
    moved_m = np.linalg.solve(OBLIQUE[0, :, :2], moved_px.T).T
    to_ground = np.linalg.inv(OBLIQUE[0, :, :2])
    expected = to_ground @ frame_in_image(TILTED, OBLIQUE, 0.0)[0] @ to_ground.T
    np.testing.assert_allclose(np.cov(moved_m.T), expected, rtol=a_percent, atol=a_percent)
    ce90_m = np.quantile(np.linalg.norm(moved_m, axis=1), 0.9)
    assert normal_ce90(expected[None])[0] == pytest.approx(ce90_m, rel=a_percent)


def test_an_unknown_height_of_the_frame_matters_only_where_heights_move_the_image():
    frame = Frame.from_sigmas(2.0, np.nan)
    vertical = OBLIQUE.copy()
    vertical[:, :, 2] = 0.0
    horizontal = vertical[0, :, :2]
    expected = 4.0 * horizontal @ horizontal.T
    np.testing.assert_allclose(frame_in_image(frame, vertical, 0.0)[0], expected, atol=1e-12)
    assert np.isnan(frame_in_image(frame, OBLIQUE, 0.0)).all()
    assert np.isnan(frame_in_image(UNKNOWN_FRAME, vertical, 0.0)).all()


def test_what_blocks_differ_by_is_not_counted_as_common_to_them_again():
    stated = frame_in_image(TILTED, OBLIQUE, 0.0)
    variance = np.trace(stated[0]) / 2.0
    np.testing.assert_allclose(frame_in_image(TILTED, OBLIQUE, np.sqrt(0.25 * variance)), 0.75 * stated)
    assert not frame_in_image(TILTED, OBLIQUE, np.sqrt(2.0 * variance)).any()


def test_the_words_state_both_accuracies_in_their_order():
    assert scene_accuracy(0.114, 3.2, Frame.from_sigmas(1.5, 5.0)).lines == (
        "Relative to the control points: CE90 0.11 m (worst place of the image)",
        "On the Earth: CE90 3.20 m (worst place of the image), LE90 of the control points' frame 8.22 m",
    )
    assert points_accuracy(MEDIAN_M2, Frame.from_sigmas(1.5, 5.0), "median of the points").lines == (
        "Relative to the control points: CE90 0.43 m, LE90 0.82 m (median of the points)",
        "On the Earth: CE90 3.25 m, LE90 8.27 m (median of the points)",
    )


def test_the_words_say_what_is_unknown_and_why():
    nothing = scene_accuracy(0.11, np.nan, UNKNOWN_FRAME).lines[1]
    assert nothing == (
        "On the Earth: CE90 unknown (worst place of the image), LE90 of the control points' frame "
        "unknown: nobody stated the frame of the control points"
    )
    no_height = scene_accuracy(0.11, np.nan, Frame.from_sigmas(1.5, np.nan)).lines[1]
    assert no_height.endswith("unknown: nobody stated the height of the control points' frame")
    block = points_accuracy(MEDIAN_M2, Frame.from_sigmas(1.5, np.nan), "median of the points")
    assert block.lines[1] == (
        "On the Earth: CE90 3.25 m, LE90 unknown (median of the points): nobody stated the height of "
        "the control points' frame"
    )
    assert np.isnan(block.on_the_earth.le90_m)
