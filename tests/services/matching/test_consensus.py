"""The right measures are told from false ones, and chance is not taken for agreement."""

import numpy as np
import pytest

from services.matching.consensus import (
    Consensus,
    a_contrario_consensus,
    affine_inliers,
    robust_affine_inliers,
)
from services.types import Array

REACH_M = 60.0
TOLERANCE_M = 3.0
NOISE_M = 0.8
CALIBRATION_TRIALS = 800
a_metre = 1.0
a_fiftieth = 0.02


def everywhere(rng: np.random.Generator, count: int) -> Array:
    return np.asarray(rng.uniform(-REACH_M, REACH_M, (count, 2)))


def chance(count: int, seed: int = 0) -> Array:
    """False alarms stated for many sets of displacements that mean nothing."""
    rng = np.random.default_rng(seed)
    trials = (
        a_contrario_consensus(everywhere(rng, count), TOLERANCE_M, REACH_M)
        for _ in range(CALIBRATION_TRIALS)
    )
    return np.array([trial.false_alarms for trial in trials])


@pytest.mark.parametrize("seed", range(20))
def test_the_vote_finds_the_right_two_fifths(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-40.0, 40.0, 2)
    displacement = everywhere(rng, 40)
    displacement[:16] = truth + rng.normal(0.0, NOISE_M, (16, 2))
    found = a_contrario_consensus(displacement, TOLERANCE_M, REACH_M)
    assert found.inliers[:16].sum() >= 15
    assert found.inliers[16:].sum() <= 2
    assert np.hypot(*(found.displacement - truth)) < a_metre
    assert found.false_alarms < 1e-12


def test_displacements_that_mean_nothing_are_not_believed() -> None:
    for seed in range(200):
        rng = np.random.default_rng(seed)
        assert a_contrario_consensus(everywhere(rng, 60), TOLERANCE_M, REACH_M).false_alarms > 1e-4


@pytest.mark.parametrize("count", [5, 10, 20, 40, 60])
def test_false_alarms_are_no_rarer_than_they_are_said_to_be(count: int) -> None:
    stated = chance(count)
    assert np.mean(stated < 0.01) < 0.01 + a_fiftieth / 2.0
    assert np.mean(stated < 0.1) < 0.1 + a_fiftieth


def test_more_voters_that_agree_are_believed_more() -> None:
    rng = np.random.default_rng(0)
    noise = everywhere(rng, 30)
    stated = []
    for right in (0, 4, 8, 16):
        displacement = noise.copy()
        displacement[:right] = [10.0, -20.0] + rng.normal(0.0, NOISE_M, (right, 2))
        stated.append(a_contrario_consensus(displacement, TOLERANCE_M, REACH_M).false_alarms)
    assert stated[0] > 0.1
    assert np.all(np.diff(stated) < 0.0)


def test_what_was_not_found_does_not_vote() -> None:
    rng = np.random.default_rng(0)
    displacement = everywhere(rng, 30)
    displacement[:12] = [10.0, -20.0] + rng.normal(0.0, NOISE_M, (12, 2))
    padded = np.concatenate([np.full((25, 2), np.nan), displacement])
    alone, among = (
        a_contrario_consensus(displacement, TOLERANCE_M, REACH_M),
        a_contrario_consensus(padded, TOLERANCE_M, REACH_M),
    )
    assert among.false_alarms == alone.false_alarms
    np.testing.assert_array_equal(among.inliers[25:], alone.inliers)
    assert not among.inliers[:25].any()


@pytest.mark.parametrize("count", [0, 1])
def test_nobody_and_one_alone_do_not_agree(count: int) -> None:
    found: Consensus = a_contrario_consensus(np.full((3, 2), np.nan), TOLERANCE_M, REACH_M)
    if count:
        found = a_contrario_consensus(np.array([[1.0, 2.0], [np.nan, np.nan]]), TOLERANCE_M, REACH_M)
    assert found.inliers.sum() == count
    assert found.false_alarms >= 1.0


def field(rng: np.random.Generator, count: int, right: int) -> tuple[Array, Array, Array]:
    """Positions, measured displacements and which of them are right."""
    position = rng.uniform(0.0, 700.0, (count, 2))
    affine = position @ rng.normal(0.0, 0.003, (2, 2)).T + rng.uniform(-3.0, 3.0, 2)
    measured = affine + rng.normal(0.0, 0.15, (count, 2))
    measured[right:] = affine[right:] + rng.uniform(-8.0, 8.0, (count - right, 2))
    return position, measured, np.hypot(*(measured - affine).T) < 0.6


@pytest.mark.parametrize("seed", range(20))
def test_magsac_finds_the_right_two_fifths_of_an_affine_field(seed: int) -> None:
    position, measured, right = field(np.random.default_rng(seed), 60, 24)
    agreeing = affine_inliers(position, measured, np.ones(60, dtype=bool), tolerance=1.0)
    assert (agreeing & right).sum() >= 0.9 * right.sum()
    assert (agreeing & ~right).sum() <= 3


def test_points_worse_than_declared_are_kept_and_told() -> None:
    """Declared three times too good: cut at three declared sigmas they would seem to be as declared."""
    rng = np.random.default_rng(1)
    declared_px, shares, scales = 1.0, [], []
    for _ in range(20):
        position = rng.uniform(0.0, 700.0, (80, 2))
        measured = rng.normal(0.0, 3.0 * declared_px, (80, 2)) + position @ [[0.0, 0.004], [-0.003, 0.0]]
        measured[:16] += rng.uniform(50.0, 200.0, (16, 2))
        agreeing, scale = robust_affine_inliers(position, measured, np.ones(80, dtype=bool), declared_px)
        assert not agreeing[:16].any()
        shares.append(agreeing[16:].mean())
        scales.append(scale)
    assert np.mean(shares) > 0.95
    assert np.mean(scales) == pytest.approx(3.0, rel=0.15)


def test_points_as_good_as_declared_leave_the_scale_at_one() -> None:
    rng = np.random.default_rng(2)
    position = rng.uniform(0.0, 700.0, (80, 2))
    for _ in range(20):
        measured = rng.normal(0.0, 1.0, (80, 2))
        _, scale = robust_affine_inliers(position, measured, np.ones(80, dtype=bool), 1.0)
        assert scale == pytest.approx(1.0, abs=0.3)


def test_only_candidates_agree() -> None:
    position, measured, _ = field(np.random.default_rng(0), 60, 60)
    candidates = np.arange(60) % 2 == 0
    measured[~candidates] = np.nan
    agreeing = affine_inliers(position, measured, candidates, tolerance=1.0)
    assert agreeing.sum() >= 28
    assert not (agreeing & ~candidates).any()


def test_five_are_too_few_to_choose_among() -> None:
    position, measured, _ = field(np.random.default_rng(0), 10, 0)
    candidates = np.arange(10) < 5
    np.testing.assert_array_equal(affine_inliers(position, measured, candidates, 1.0), candidates)
