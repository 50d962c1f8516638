"""The two accuracies that every place states, against true errors of frames seen by oblique models."""

import numpy as np
import pytest

from amers.services.quality.accuracy_statement import (
    accuracy_document,
    no_accuracy,
    points_accuracy,
    scene_accuracy,
    vertices_accuracy,
)
from amers.services.quality.frames import frame_in_image
from amers.services.quality.normal_law import normal_ce90
from amers.services.types import UNKNOWN_FRAME, Frame

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
    assert scene_accuracy(0.114, 3.2, Frame.from_sigmas(1.5, 5.0), 100.0).lines == (
        "Relative to the control points: CE90 0.11 m (worst place of the image)",
        "On the Earth: CE90 3.20 m (worst place of the image), "
        "LE90 of the control points' common error 8.22 m",
    )
    assert points_accuracy(MEDIAN_M2, Frame.from_sigmas(1.5, 5.0), "median of the points").lines == (
        "Relative to the control points: CE90 0.43 m, LE90 0.82 m (median of the points)",
        "On the Earth: CE90 3.25 m, LE90 8.27 m (median of the points)",
    )


@pytest.mark.parametrize(
    ("share", "words"), [(87.6, "88 %"), (99.9, "99 %"), (0.2, "1 %"), (0.0, "0 %")]
)
def test_the_words_say_of_what_part_of_the_image_they_speak(share: float, words: str) -> None:
    stated = scene_accuracy(0.3, 3.2, Frame.from_sigmas(1.5, 5.0), share)
    for line in stated.lines:
        assert f"(worst place of the {words} of the image that points support)" in line


def test_the_words_on_the_earth_say_what_was_assumed():
    frame = Frame(np.eye(3), assumed="the accuracy of the models is not stated; give --sigma-m")
    stated = scene_accuracy(1.0, 3.0, frame, 100.0)
    assert "assumed" not in stated.relative_to_control_points.words
    assert stated.on_the_earth.words.endswith(f": assumed: {frame.assumed}")
    points = points_accuracy(np.eye(3), frame, "median")
    assert points.on_the_earth.words.endswith(f": assumed: {frame.assumed}")


def test_the_words_say_what_is_unknown_and_why():
    nothing = scene_accuracy(0.11, np.nan, UNKNOWN_FRAME, 100.0).lines[1]
    assert nothing == (
        "On the Earth: CE90 unknown (worst place of the image), LE90 of the control points' common "
        "error unknown: the sigma of the control points' common error is not stated"
    )
    no_height = scene_accuracy(0.11, np.nan, Frame.from_sigmas(1.5, np.nan), 100.0).lines[1]
    assert no_height.endswith(
        "unknown: the height sigma of the control points' common error is not stated"
    )
    block = points_accuracy(MEDIAN_M2, Frame.from_sigmas(1.5, np.nan), "median of the points")
    assert block.lines[1] == (
        "On the Earth: CE90 3.25 m, LE90 unknown (median of the points): the height sigma of the "
        "control points' common error is not stated"
    )
    assert np.isnan(block.on_the_earth.le90_m)


def test_vertices_are_stated_by_the_worst_and_the_median_of_those_that_are_known() -> None:
    relative_m, earth_m = np.array([1.0, 2.0, np.nan, 4.0]), np.array([3.0, 5.0, np.nan, 9.0])
    stated = vertices_accuracy(relative_m, earth_m, TILTED)
    assert (stated.relative_to_control_points.ce90_m, stated.on_the_earth.ce90_m) == (4.0, 9.0)
    unknown = (
        "unknown for 1 of 4 vertices, beyond the area of the image that control points support, or "
        "where a line of sight grazes the ground"
    )
    assert stated.lines == (
        f"Relative to the control points: CE90 4.00 m (worst vertex), 2.00 m (median vertex); {unknown}",
        f"On the Earth: CE90 9.00 m (worst vertex), 5.00 m (median vertex); {unknown}",
    )


def test_vertices_of_a_scene_that_is_not_registered_have_the_accuracy_of_its_model_alone() -> None:
    unknown = np.full(2, np.nan)
    stated = vertices_accuracy(unknown, np.array([20.0, 30.0]), None)
    assert stated.words == {
        "Relative to the control points": "none: the scene is not registered",
        "On the Earth": "CE90 30.00 m (worst vertex), 25.00 m (median vertex)",
    }
    assert (
        "the accuracy of its model is not stated" in vertices_accuracy(unknown, unknown, None).lines[1]
    )
    in_no_frame = vertices_accuracy(np.array([1.0]), unknown[:1], UNKNOWN_FRAME).lines[1]
    assert (
        in_no_frame
        == "On the Earth: CE90 unknown: the sigma of the control points' common error is not stated"
    )


def test_a_figure_that_is_unknown_is_null_in_a_document() -> None:
    document = accuracy_document(scene_accuracy(1.0, np.nan, UNKNOWN_FRAME, 100.0))
    assert document["relative_to_control_points"]["ce90_m"] == 1.0
    assert document["on_the_earth"]["ce90_m"] is None
    assert document["on_the_earth"]["le90_m"] is None
    assert "common error is not stated" in str(document["on_the_earth"]["words"])
    failed = accuracy_document(no_accuracy("no point was found"))
    assert {one["words"] for one in failed.values()} == {"none: no point was found"}
