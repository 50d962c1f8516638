"""What several blocks know together about their place on the Earth."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from amers.services.quality.frames import frame_in_image, shared_frame, weighted_frame
from amers.services.types import UNKNOWN_FRAME, Frame
from tests.factories import control_points

a_tenth_of_a_percent = 1e-3


def random_frame(rng: np.random.Generator) -> Frame:
    factor = rng.normal(size=(3, 3))
    return Frame(factor @ factor.T)


def test_a_single_frame_stays_as_it_is():
    frame = random_frame(np.random.default_rng(1))
    assert_allclose(weighted_frame([frame], np.array([7.0])).covariance_m2, frame.covariance_m2)


def test_a_frame_of_several_is_assumed_where_one_of_those_that_count_is():
    stated, assumed = Frame(np.eye(3)), Frame(4.0 * np.eye(3), assumed="50 m")
    assert weighted_frame((stated, assumed), np.array([1.0, 0.1])).assumed == "50 m"
    assert weighted_frame((stated, assumed), np.array([1.0, 0.0])).assumed == ""


@pytest.mark.parametrize("correlation", [-1.0, 0.0, 0.7, 1.0])
def test_frames_are_never_known_worse_than_stated_whatever_their_correlation(correlation):
    rng = np.random.default_rng(2)
    factors = [rng.normal(size=(3, 3)) for _ in range(2)]
    frames = [Frame(factor @ factor.T) for factor in factors]
    weights = np.array([0.3, 0.7])
    first, second = (weight * factor for weight, factor in zip(weights, factors, strict=True))
    cross = correlation * first @ second.T
    true_covariance = first @ first.T + second @ second.T + cross + cross.T
    stated = weighted_frame(frames, weights).covariance_m2
    assert np.linalg.eigvalsh(stated - true_covariance).min() > -a_tenth_of_a_percent


def test_only_the_blocks_of_active_points_count():
    points = control_points(4, np.random.default_rng(3))
    known = random_frame(np.random.default_rng(4))
    from_two = replace(points, block=np.array([0, 0, 1, 1]), frames=(known, UNKNOWN_FRAME))
    first_block = np.array([True, True, False, False])
    assert_allclose(shared_frame(from_two, first_block).covariance_m2, known.covariance_m2)
    assert np.isnan(shared_frame(from_two, ~first_block).covariance_m2).all()
    assert np.isnan(shared_frame(from_two, np.array([True, True, True, False])).covariance_m2).all()
    assert np.isnan(shared_frame(from_two, np.zeros(4, dtype=bool)).covariance_m2).all()


@pytest.mark.parametrize(("apart_px", "left"), [(0.0, 1.0), (1.5, 0.75), (3.0, 0.0), (9.0, 0.0)])
def test_what_blocks_are_seen_to_be_apart_is_no_error_that_they_share(apart_px, left):
    """The frame moves the image by 3 px a coordinate: what is seen of it counts as a square."""
    derivative = np.array([[[0.0, -2.0, 0.3], [2.0, 0.0, -0.4]]])
    moved = frame_in_image(Frame(np.diag([2.25, 2.25, 0.0])), derivative, apart_px)
    assert_allclose(moved, left * 9.0 * np.eye(2)[None], atol=1e-12)


def test_a_frame_of_sigmas_is_unknown_in_what_nobody_stated():
    assert_array_equal(Frame.from_sigmas(2.0, 3.0).covariance_m2, np.diag([4.0, 4.0, 9.0]))
    nan = np.nan
    assert_array_equal(
        Frame.from_sigmas(2.0, nan).covariance_m2, [[4.0, 0.0, nan], [0.0, 4.0, nan], [nan, nan, nan]]
    )
    assert np.isnan(Frame.from_sigmas(nan, nan).covariance_m2).all()
