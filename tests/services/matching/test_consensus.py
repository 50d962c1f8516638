"""Consistent measures are separated from outliers, and random agreement is not significant."""

import cv2
import numpy as np
import pytest

from amers.services.matching.consensus import (
    Consensus,
    Voters,
    _scatter_px,
    a_contrario_consensus,
    affine_inliers,
    robust_affine_inliers,
)
from amers.services.types import Array, FloatImage

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
    assert np.mean(stated < 1e-3) < 0.004
    assert np.mean(stated < 0.01) < 0.01 + a_fiftieth / 2.0
    assert np.mean(stated < 0.1) < 0.1 + a_fiftieth


@pytest.mark.parametrize("agreeing", [2, 3, 4])
def test_false_alarms_are_the_number_of_such_sets_in_random_displacements(agreeing: int) -> None:
    """From both sides: on a torus no window cuts a set off, and the statement is exact."""
    tolerance_m, count = 15.0, 6
    rng = np.random.default_rng(agreeing)
    random = rng.uniform(-REACH_M, REACH_M, (40_000, count, 2))
    apart = random[:, :, None] - random[:, None]
    apart -= 2.0 * REACH_M * np.round(apart / (2.0 * REACH_M))
    members = (np.hypot(apart[..., 0], apart[..., 1]) <= tolerance_m).sum(axis=2)
    simulated = (members >= agreeing).sum() / len(random)
    corners = np.array([[-50, -50], [-50, 50], [50, -50], [50, 50], [0, -50], [-50, 0]], dtype=float)
    displacement = corners.copy()
    displacement[:agreeing] = corners[0] + rng.uniform(-1.0, 1.0, (agreeing, 2))
    consensus = a_contrario_consensus(displacement, tolerance_m, REACH_M)
    assert consensus.inliers.sum() == agreeing
    assert consensus.false_alarms == pytest.approx(simulated, rel=0.1)


def test_a_search_given_by_its_limits_is_the_search_given_by_its_half_side() -> None:
    rng = np.random.default_rng(4)
    displacement = random_displacements(rng, 30)
    displacement[:8] = [10.0, -20.0] + rng.normal(0.0, NOISE_M, (8, 2))
    limits = np.broadcast_to(np.array([[-REACH_M] * 2, [REACH_M] * 2]), (30, 2, 2)).copy()
    by_side, by_limits = (
        a_contrario_consensus(displacement, TOLERANCE_M, search) for search in (REACH_M, limits)
    )
    assert by_limits.false_alarms == pytest.approx(by_side.false_alarms, rel=1e-9)


@pytest.mark.parametrize("apart_m", [None, 80.0])
def test_no_choice_of_axes_order_or_unit_changes_a_consensus(apart_m: float | None) -> None:
    rng = np.random.default_rng(5)
    displacement = random_displacements(rng, 24)
    displacement[:9] = [10.0, -20.0] + rng.normal(0.0, NOISE_M, (9, 2))
    limits = np.stack([np.full((24, 2), -REACH_M), np.column_stack([np.full(24, 30.0)] * 2)], axis=1)
    limits[:, 1, 1] = 70.0
    place = rng.uniform(0.0, 2000.0, (24, 2))
    order = rng.permutation(24)

    def false_alarms(shown: Array, search: Array, at: Array, unit: float) -> float:
        voters = None if apart_m is None else Voters(at * unit, apart_m * unit)
        return a_contrario_consensus(
            shown * unit, TOLERANCE_M * unit, search * unit, voters
        ).false_alarms

    plain = false_alarms(displacement, limits, place, 1.0)
    swapped = false_alarms(displacement[:, ::-1], limits[:, :, ::-1], place[:, ::-1], 1.0)
    mirrored = false_alarms(-displacement, -limits[:, ::-1], place, 1.0)
    moved = false_alarms(displacement + 1000.0, limits + 1000.0, place, 1.0)
    in_feet = false_alarms(displacement, limits, place, 3.28)
    permuted = false_alarms(displacement[order], limits[order], place[order], 1.0)
    np.testing.assert_allclose([swapped, mirrored, moved, in_feet, permuted], plain, rtol=1e-6)


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
    assert 1.0 <= consensus.false_alarms < np.inf


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


@pytest.mark.parametrize("offset_px", [0.0, 2.0, 10.0])
@pytest.mark.parametrize("sizes", [(40, 40), (60, 20), (20, 60)])
def test_blocks_apart_by_metres_both_keep_their_points(sizes: tuple[int, int], offset_px: float) -> None:
    """At 0.5 m a pixel these are 1 and 5 m: block frames differ so much, points of a block do not."""
    declared_px, block = 0.15, np.repeat([7, 3], sizes)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        position, measured, right = field(rng, 80, 80)
        wrong = rng.random(80) < 0.1
        measured[block == 3] += offset_px * np.array([np.cos(seed), np.sin(seed)])
        measured[wrong] += rng.uniform(3.0, 20.0, (wrong.sum(), 2))
        inliers, scale = robust_affine_inliers(
            position, measured, np.ones(80, dtype=bool), declared_px, block
        )
        assert inliers[right & ~wrong].mean() > 0.95
        assert not inliers[wrong].any()
        assert scale == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("count", [16, 20])
def test_few_points_worse_than_declared_are_kept(count: int) -> None:
    """Three times worse: an affine field that passes through some of them does not cut the rest off."""
    kept = []
    for seed in range(30):
        rng = np.random.default_rng([seed, count])
        position = rng.uniform(0.0, 2000.0, (count, 2))
        displacement = rng.normal(0.0, 3.0 * 2.0, (count, 2))
        inliers, _ = robust_affine_inliers(position, displacement, np.ones(count, dtype=bool), 2.0)
        kept.append(inliers.mean())
    assert np.mean(kept) > 0.8


def test_points_as_good_as_declared_have_a_scale_of_one() -> None:
    rng = np.random.default_rng(2)
    position = rng.uniform(0.0, 700.0, (80, 2))
    for _ in range(20):
        measured = rng.normal(0.0, 1.0, (80, 2))
        _, scale = robust_affine_inliers(position, measured, np.ones(80, dtype=bool), 1.0)
        assert scale == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("count", [8, 20])
def test_the_scatter_of_few_points_is_that_which_they_were_drawn_with(count: int) -> None:
    """An affine field of so few passes nearer to them than the true one."""
    rng, all_of_them = np.random.default_rng(count), np.ones(count, dtype=bool)
    drawn = rng.uniform(0.0, 700.0, (300, count, 2)), rng.normal(0.0, 6.0, (300, count, 2))
    found = [_scatter_px(at, off, all_of_them, all_of_them, 1e9) for at, off in zip(*drawn, strict=True)]
    assert np.mean(found) == pytest.approx(6.0, rel=0.08)


def test_inliers_are_candidates() -> None:
    position, measured, _ = field(np.random.default_rng(0), 60, 60)
    candidates = np.arange(60) % 2 == 0
    measured[~candidates] = np.nan
    inliers = affine_inliers(position, measured, candidates, tolerance=1.0)
    assert inliers.sum() >= 28
    assert not (inliers & ~candidates).any()


@pytest.mark.parametrize("agreeing", [12, 11])
def test_a_block_has_an_offset_when_half_of_its_points_agree_on_it(agreeing: int) -> None:
    """Half of 24 points lie 10 px off the other block, the rest elsewhere; 11 of them are too few."""
    rng = np.random.default_rng(9)
    position = rng.uniform(0.0, 700.0, (64, 2))
    measured = rng.normal(0.0, 0.1, (64, 2))
    measured[40:] += [10.0, 0.0]
    scattered = slice(40 + agreeing, 64)
    direction = np.linspace(0.0, 2.0 * np.pi, 64 - 40 - agreeing, endpoint=False)
    measured[scattered] += 9.0 * np.column_stack([np.cos(direction), np.sin(direction)])
    block = np.repeat([0, 1], [40, 24])
    inliers, _ = robust_affine_inliers(position, measured, np.ones(64, dtype=bool), 0.1, block)
    assert inliers[:40].all()
    assert inliers[40 : 40 + agreeing].mean() == (agreeing == 12)


def test_of_six_candidates_a_wrong_one_is_told_from_the_others() -> None:
    position = np.array([[0, 0], [0, 500], [500, 0], [500, 500], [250, 250], [100, 400]], dtype=float)
    measured = np.zeros((6, 2))
    measured[4] = [30.0, -20.0]
    inliers = affine_inliers(position, measured, np.ones(6, dtype=bool), 1.0)
    assert inliers.tolist() == [True, True, True, True, False, True]


def test_five_candidates_are_returned_unchanged() -> None:
    position, measured, _ = field(np.random.default_rng(0), 10, 0)
    candidates = np.arange(10) < 5
    np.testing.assert_array_equal(affine_inliers(position, measured, candidates, 1.0), candidates)


CHIP_PX, RADIUS_PX = 25, 40


def texture(rng: np.random.Generator, size: int) -> FloatImage:
    """A random image whose amplitudes fall with frequency as those of land do."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.fftfreq(size)[None, :])
    frequency[0, 0] = np.inf
    spectrum = np.fft.fft2(rng.standard_normal((size, size))) / frequency**1.5
    return np.asarray(np.fft.ifft2(spectrum).real, dtype=np.float32)


def correlated(ground: FloatImage, scene: FloatImage, step_px: int, a_side: int) -> tuple[Array, Array]:
    """Positions and displacements of a square grid of chips of the ground, as found in a scene."""
    position, displacement = [], []
    for row, col in np.ndindex(a_side, a_side):
        top, left = RADIUS_PX + step_px * row, RADIUS_PX + step_px * col
        chip = ground[top : top + CHIP_PX, left : left + CHIP_PX]
        reach = CHIP_PX + 2 * RADIUS_PX
        patch = scene[top - RADIUS_PX :, left - RADIUS_PX :][:reach, :reach]
        scores = cv2.matchTemplate(patch.copy(), chip.copy(), cv2.TM_CCOEFF_NORMED)
        best = np.unravel_index(int(scores.argmax()), scores.shape)
        position.append([top, left])
        displacement.append(np.array(best) - RADIUS_PX if scores.max() >= 0.5 else [np.nan, np.nan])
    return np.array(position, dtype=np.float64), np.array(displacement, dtype=np.float64)


@pytest.mark.monte_carlo
@pytest.mark.parametrize("step_px", [4, 12, 18, 25])
def test_overlapping_chips_of_unrelated_ground_are_not_significant(step_px: int) -> None:
    """Counted singly, 64 chips 4 px apart are "significant" in nearly every pair of textures."""
    rng, singly, apart = np.random.default_rng(step_px), [], []
    for _ in range(40):
        ground, scene = texture(rng, 288), texture(rng, 288)
        position, displacement = correlated(ground, scene, step_px, 8)
        voters = Voters(position, float(CHIP_PX))
        singly.append(a_contrario_consensus(displacement, 3.0, float(RADIUS_PX)).false_alarms)
        apart.append(a_contrario_consensus(displacement, 3.0, float(RADIUS_PX), voters).false_alarms)
    assert np.mean(np.array(apart) < 0.1) <= 0.1
    assert np.mean(np.array(apart) < 1e-2) <= 0.025
    assert min(apart) > 1e-4
    if step_px == 4:
        assert np.mean(np.array(singly) < 1e-4) > 0.5


@pytest.mark.monte_carlo
@pytest.mark.parametrize(("step_px", "in_common"), [(12, 0.5), (18, 0.5), (25, 0.4)])
def test_overlapping_chips_of_the_same_ground_are_significant(step_px: int, in_common: float) -> None:
    rng, accepted = np.random.default_rng(step_px), []
    for _ in range(20):
        ground, other = texture(rng, 288), texture(rng, 288)
        scene = (in_common * ground + (1.0 - in_common) * other).astype(np.float32)
        position, displacement = correlated(ground, scene, step_px, 8)
        voters = Voters(position, float(CHIP_PX))
        consensus = a_contrario_consensus(displacement, 3.0, float(RADIUS_PX), voters)
        accepted.append(consensus.false_alarms < 1e-4 and np.hypot(*consensus.displacement) < 3.0)
    assert np.mean(accepted) >= 0.9


@pytest.mark.parametrize("seed", range(10))
def test_chips_that_nearly_all_agree_in_a_small_scene_are_significant(seed: int) -> None:
    """A scene of 2.5 chips a side holds few chips side by side, but six of their area."""
    rng = np.random.default_rng(seed)
    displacement = rng.uniform(-80.0, 80.0, (28, 2))
    displacement[:26] = [30.0, -40.0] + rng.normal(0.0, 1.0, (26, 2))
    voters = Voters(rng.uniform(0.0, 150.0, (28, 2)), 100.0)
    assert a_contrario_consensus(displacement, 6.0, 80.0, voters).false_alarms < 1e-4


def test_displacements_that_a_search_could_not_reach_do_not_weigh_against_a_consensus() -> None:
    """A small scene shows few of the chips tried; the others cannot agree with those."""
    rng = np.random.default_rng(3)
    predicted = rng.uniform(-5000.0, 5000.0, (2000, 2))
    low, high = -predicted, 1000.0 - predicted
    displacement = rng.uniform(low, high)
    truth = np.array([1800.0, -2400.0])
    shown = ((truth > low) & (truth < high)).all(axis=1)
    displacement[np.flatnonzero(shown)[::2]] = truth
    search = np.stack([low, high], axis=1)
    consensus = a_contrario_consensus(displacement, 24.0, search)
    np.testing.assert_allclose(consensus.displacement, truth, atol=24.0)
    assert consensus.false_alarms < 1e-6
    random = a_contrario_consensus(rng.uniform(low, high), 24.0, search)
    assert random.false_alarms > 1e-3
