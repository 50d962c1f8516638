"""A block follows known ground as far as it states, and wrong ground leaves by name."""

import numpy as np
import pytest

from amers.services.adjustment.frame_fit import FrameFit, fit_frame
from amers.services.errors import NoConsensus
from amers.services.geodesy import move_metres
from amers.services.types import Array, Frame
from tests.services.adjustment.grounds import ground_of

BEFORE = Frame(np.diag([5.0, 4.0, 8.0]) ** 2)
SOURCE = Frame.from_sigmas(0.3, 0.5)
KNOWN_M = np.array([0.2, 0.2, 0.4])
FOUND_M = np.array([0.3, 0.3, 0.6])
TRIALS = 300


def drawn(
    rng: np.random.Generator, count: int = 12, wrong: int = 0, known: tuple[bool, ...] = (True,) * 3
) -> tuple[FrameFit, Array]:
    """A fit to drawn control, and the error of the frame that was drawn: true minus block."""
    ground = np.array([5.4, 43.6, 120.0]) + rng.uniform(-0.02, 0.02, (count, 3)) * [1.0, 1.0, 1000.0]
    frame_m = rng.multivariate_normal(np.zeros(3), BEFORE.covariance_m2)
    source_m = rng.multivariate_normal(np.zeros(3), SOURCE.covariance_m2)
    found = move_metres(ground, rng.normal(0.0, FOUND_M, (count, 3)) - frame_m)
    error_m = rng.normal(0.0, KNOWN_M, (count, 3)) + source_m
    error_m[:wrong] += rng.choice([-1.0, 1.0], (wrong, 3)) * rng.uniform(6.0, 30.0, (wrong, 3))
    own_m2 = np.where(np.eye(3) > 0, np.where(known, KNOWN_M**2, np.inf), 0.0)
    control = ground_of(np.arange(count), move_metres(ground, error_m), own_m2, SOURCE, name="survey:")
    own = np.tile(np.diag(FOUND_M**2), (count, 1, 1))
    return fit_frame(BEFORE, control, found, own), frame_m


@pytest.mark.thorough
@pytest.mark.monte_carlo
@pytest.mark.parametrize("wrong", [pytest.param(0, marks=pytest.mark.endurance), 3])
def test_the_frame_is_as_accurate_as_it_states_and_wrong_ground_leaves(wrong: int) -> None:
    rng = np.random.default_rng(3)
    squares, left, lost = [], 0, 0
    for _ in range(TRIALS):
        fit, truth = drawn(rng, wrong=wrong)
        error = fit.translation_m - truth
        squares.append(float(error @ np.linalg.solve(fit.frame.covariance_m2, error)) / 3.0)
        left += int((~fit.active[:wrong]).sum())
        lost += int((~fit.active[wrong:]).sum())
    # Mean of 300 chi-squared of three: a standard deviation of 0.047.
    assert 0.86 < np.mean(squares) < 1.14
    assert left == wrong * TRIALS
    assert lost <= 0.002 * TRIALS * 12
    assert fit.frame.sigma_m < 0.4


def test_positions_alone_leave_the_height_as_it_was() -> None:
    fit, _ = drawn(np.random.default_rng(5), known=(True, True, False))
    assert fit.frame.sigma_m < 0.4
    assert fit.frame.sigma_up_m == pytest.approx(BEFORE.sigma_up_m, rel=1e-3)
    assert fit.translation_m[2] == pytest.approx(0.0, abs=1e-6)
    assert np.isnan(fit.misfit_m[:, 2]).all()


def test_what_nobody_stated_and_nothing_tells_stays_unknown() -> None:
    rng = np.random.default_rng(6)
    ground = np.array([5.4, 43.6, 100.0]) + np.zeros((6, 3))
    known = move_metres(ground, [3.0, -2.0, 0.0] + rng.normal(0, 0.1, (6, 3)))
    control = ground_of(np.arange(6), known, np.diag([0.01, 0.01, np.inf]), SOURCE)
    unknown = Frame(np.full((3, 3), np.nan))
    fit = fit_frame(unknown, control, ground, np.tile(0.01 * np.eye(3), (6, 1, 1)))
    assert fit.translation_m == pytest.approx([3.0, -2.0, 0.0], abs=0.2)
    assert np.isnan(fit.frame.sigma_up_m)
    assert fit.frame.sigma_m < 0.4


def test_what_neighbours_share_stays_in_the_frame() -> None:
    shared = Frame(BEFORE.covariance_m2, np.diag([0.5, 0.5, 2.0]))
    known = np.tile([5.4, 43.6, 100.0], (50, 1))
    control = ground_of(np.arange(50), known, 1e-4 * np.eye(3), Frame.from_sigmas(0.01, 0.01))
    fit = fit_frame(shared, control, control.lon_lat_h, np.tile(np.eye(3), (50, 1, 1)))
    assert fit.frame.covariance_m2[0, 0] > 0.25
    assert fit.frame.shared_m2[2, 2] == 2.0


def test_control_that_disagrees_with_itself_is_refused_by_name() -> None:
    with pytest.raises(NoConsensus, match=r"of 12 control points disagree.*survey:"):
        drawn(np.random.default_rng(8), wrong=9)


@pytest.mark.parametrize("seed", range(3))
def test_known_ground_counts_where_more_than_half_of_it_agrees(seed: int) -> None:
    fit, _ = drawn(np.random.default_rng([9, seed]), wrong=5)
    assert fit.active.tolist() == [False] * 5 + [True] * 7
    with pytest.raises(NoConsensus, match="6 of 12 control points disagree"):
        drawn(np.random.default_rng([9, seed]), wrong=6)
