"""90 % regions of a block hold the truth: a few cells of `python -m benchmarks.block_coverage`."""

from dataclasses import replace

import numpy as np
import pytest

from amers.services.adjustment.bundle import adjust_block
from amers.services.errors import DisconnectedBlock
from benchmarks.block_coverage import Case, draw, measure

pytestmark = pytest.mark.thorough

TRIALS = 20
lowest, highest = 0.85, 0.97
by_chance = 1.65
"""Standard deviations of the draw by which an honest cell misses in one of twenty repetitions."""


@pytest.mark.monte_carlo
@pytest.mark.parametrize(
    "case",
    [
        Case("ring", 0.0, 0.0),
        Case("ring", 1.0, 0.3),
        Case("pair", 0.3, 0.1),
        Case("pair", 1.0, 0.0),
        Case("star", 1.0, 0.1),
    ],
    ids=lambda case: f"{case.layout}, drift {case.drift_px} px, {case.blunders:.0%} blunders",
)
def test_regions_of_points_hold_the_truth_relative_and_on_the_earth(case: Case) -> None:
    coverage = measure(case, TRIALS, seed=1)
    assert lowest <= coverage.relative + by_chance * coverage.chance
    assert coverage.relative - by_chance * coverage.chance <= highest
    # Errors on the Earth are those of 20 frames: few.
    assert coverage.on_earth >= 0.75
    assert np.min(coverage.frame) >= 0.7
    # Five places of 20 scenes; without what the points share: 0.3 in rings.
    assert coverage.scene_relative >= 0.8
    assert coverage.scene_on_earth >= 0.75
    assert coverage.refused <= 2


@pytest.mark.monte_carlo
def test_a_strip_that_drifts_by_a_pixel_states_what_its_points_share() -> None:
    coverage = measure(Case("strip", 1.0, 0.1), 4, seed=1)
    assert lowest <= coverage.relative <= 1.0
    assert coverage.refused == 0


def test_errors_that_follow_relief_do_not_skew_the_ground() -> None:
    truth, images, observations = draw(Case("pair", 0.0, 0.0), np.random.default_rng(3))
    height_m = truth[observations.point, 2]
    relief = (height_m - height_m.mean()) / height_m.std()
    spoiled = observations.line_sample.copy()
    spoiled[:, 0] += 0.2 * relief * np.where(observations.image == 0, 1.0, -1.0)
    block = adjust_block(images, replace(observations, line_sample=spoiled))
    slopes_px = block.values.reshape(2, 2, 3)[:, :, 1:]
    # Without the linear deformations in the gauge: 0.06 px.
    assert np.abs(slopes_px.mean(axis=0)).max() < 0.01


def test_groups_that_nothing_ties_together_are_refused_by_name() -> None:
    _, images, observations = draw(Case("groups", 0.3, 0.1), np.random.default_rng(1))
    words = r"2 groups .*image 1, image 2, image 3 \| image 4, image 5, image 6"
    with pytest.raises(DisconnectedBlock, match=words):
        adjust_block(images, observations)
