"""Consistent measures are separated from outliers, and random agreement is not significant."""

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


def random_displacements(rng: np.random.Generator, count: int) -> Array:
    return np.asarray(rng.uniform(-REACH_M, REACH_M, (count, 2)))


def stated_false_alarms(count: int, seed: int = 0) -> Array:
    """Stated false alarms of many sets of random displacements."""
    rng = np.random.default_rng(seed)
    trials = (
        a_contrario_consensus(random_displacements(rng, count), TOLERANCE_M, REACH_M)
        for _ in range(CALIBRATION_TRIALS)
    )
    return np.array([trial.false_alarms for trial in trials])


@pytest.mark.parametrize("seed", range(20))
def test_a_consensus_of_two_fifths_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(-40.0, 40.0, 2)
    displacement = random_displacements(rng, 40)
    displacement[:16] = truth + rng.normal(0.0, NOISE_M, (16, 2))
    consensus = a_contrario_consensus(displacement, TOLERANCE_M, REACH_M)
    assert consensus.inliers[:16].sum() >= 15
    assert consensus.inliers[16:].sum() <= 2
    assert np.hypot(*(consensus.displacement - truth)) < a_metre
    assert consensus.false_alarms < 1e-12


def test_random_displacements_are_not_significant() -> None:
    for seed in range(200):
        rng = np.random.default_rng(seed)
        assert (
            a_contrario_consensus(random_displacements(rng, 60), TOLERANCE_M, REACH_M).false_alarms
            > 1e-4
        )


@pytest.mark.parametrize("count", [5, 10, 20, 40, 60])
def test_the_stated_false_alarms_are_not_too_small(count: int) -> None:
    stated = stated_false_alarms(count)
    assert np.mean(stated < 0.01) < 0.01 + a_fiftieth / 2.0
    assert np.mean(stated < 0.1) < 0.1 + a_fiftieth


def test_a_larger_consensus_is_more_significant() -> None:
    rng = np.random.default_rng(0)
    noise = random_displacements(rng, 30)
    stated = []
    for right in (0, 4, 8, 16):
        displacement = noise.copy()
        displacement[:right] = [10.0, -20.0] + rng.normal(0.0, NOISE_M, (right, 2))
        stated.append(a_contrario_consensus(displacement, TOLERANCE_M, REACH_M).false_alarms)
    assert stated[0] > 0.1
    assert np.all(np.diff(stated) < 0.0)


def test_missing_displacements_do_not_take_part() -> None:
    rng = np.random.default_rng(0)
    displacement = random_displacements(rng, 30)
    displacement[:12] = [10.0, -20.0] + rng.normal(0.0, NOISE_M, (12, 2))
    padded = np.concatenate([np.full((25, 2), np.nan), displacement])
    alone, padded_consensus = (
        a_contrario_consensus(displacement, TOLERANCE_M, REACH_M),
        a_contrario_consensus(padded, TOLERANCE_M, REACH_M),
    )
    assert padded_consensus.false_alarms == alone.false_alarms
    np.testing.assert_array_equal(padded_consensus.inliers[25:], alone.inliers)
    assert not padded_consensus.inliers[:25].any()


@pytest.mark.parametrize("count", [0, 1])
def test_no_displacement_and_a_single_one_are_not_significant(count: int) -> None:
    consensus: Consensus = a_contrario_consensus(np.full((3, 2), np.nan), TOLERANCE_M, REACH_M)
    if count:
        consensus = a_contrario_consensus(np.array([[1.0, 2.0], [np.nan, np.nan]]), TOLERANCE_M, REACH_M)
    assert consensus.inliers.sum() == count
    assert consensus.false_alarms >= 1.0


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
    inliers = affine_inliers(position, measured, np.ones(60, dtype=bool), tolerance=1.0)
    assert (inliers & right).sum() >= 0.9 * right.sum()
    assert (inliers & ~right).sum() <= 3


def test_points_worse_than_declared_are_kept_with_their_scatter() -> None:
    """With sigmas three times too small, a cut at three sigmas would hide the true scatter."""
    rng = np.random.default_rng(1)
    declared_px, shares, scales = 1.0, [], []
    for _ in range(20):
        position = rng.uniform(0.0, 700.0, (80, 2))
        measured = rng.normal(0.0, 3.0 * declared_px, (80, 2)) + position @ [[0.0, 0.004], [-0.003, 0.0]]
        measured[:16] += rng.uniform(50.0, 200.0, (16, 2))
        inliers, scale = robust_affine_inliers(position, measured, np.ones(80, dtype=bool), declared_px)
        assert not inliers[:16].any()
        shares.append(inliers[16:].mean())
        scales.append(scale)
    assert np.mean(shares) > 0.95
    assert np.mean(scales) == pytest.approx(3.0, rel=0.15)


def test_points_as_good_as_declared_have_a_scale_of_one() -> None:
    rng = np.random.default_rng(2)
    position = rng.uniform(0.0, 700.0, (80, 2))
    for _ in range(20):
        measured = rng.normal(0.0, 1.0, (80, 2))
        _, scale = robust_affine_inliers(position, measured, np.ones(80, dtype=bool), 1.0)
        assert scale == pytest.approx(1.0, abs=0.3)


def test_inliers_are_candidates() -> None:
    position, measured, _ = field(np.random.default_rng(0), 60, 60)
    candidates = np.arange(60) % 2 == 0
    measured[~candidates] = np.nan
    inliers = affine_inliers(position, measured, candidates, tolerance=1.0)
    assert inliers.sum() >= 28
    assert not (inliers & ~candidates).any()


def test_five_candidates_are_returned_unchanged() -> None:
    position, measured, _ = field(np.random.default_rng(0), 10, 0)
    candidates = np.arange(10) < 5
    np.testing.assert_array_equal(affine_inliers(position, measured, candidates, 1.0), candidates)
