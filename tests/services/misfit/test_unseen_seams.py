"""Seams between detectors where no point lies: the accuracy grows there as seams between points tell."""

import numpy as np
import pytest

from amers.services.misfit.displacement_components import Component
from amers.services.misfit.unseen_seams import unseen_seams
from tests.services.misfit.test_displacement_components import SHAPE, WRONG, Motion, both, seam, trial

SAMPLES = 3000
POINTS = np.linspace(100.0, 1900.0, 60)
SQUARE_PX2 = np.array([4.0, 9.0])


def step(at: float, width: float = 40.0, along: str = "samples") -> Component:
    return Component("step", width, at, SQUARE_PX2, along=along)  # type: ignore[arg-type]


def test_the_variance_grows_by_the_seams_and_squares_of_each_sample_that_points_show() -> None:
    before, behind = unseen_seams([step(400.0), step(900.0), step(1500.0)], POINTS, SAMPLES)
    a_pixel = 3 / 1800.0 * SQUARE_PX2
    np.testing.assert_allclose(before.variance_px2, 100.0 * a_pixel)
    np.testing.assert_allclose(behind.variance_px2, 1099.0 * a_pixel)
    half_way = np.array([[0.0, 1900.0 + 1099.0 / 2.0]])
    np.testing.assert_allclose(behind.covariance(half_way, half_way)[:, 0, 0], 549.5 * a_pixel)
    assert not behind.share(np.column_stack([POINTS, POINTS])).any()


@pytest.mark.parametrize(
    "shown",
    [
        [],
        [step(400.0)],
        [step(400.0), step(430.0), step(440.0)],  # one seam, whose place is uncertain
        [step(400.0), step(900.0, along="lines")],
    ],
)
def test_less_than_two_seams_are_no_rate(shown: list[Component]) -> None:
    assert unseen_seams(shown, POINTS, SAMPLES) == ()


def test_points_up_to_the_borders_leave_no_seams_unseen() -> None:
    everywhere = np.array([0.0, 1000.0, SAMPLES - 1.0])
    assert unseen_seams([step(400.0), step(900.0)], everywhere, SAMPLES) == ()


def detectors(seed: int) -> Motion:
    """Three seams at the points, and one beyond them."""
    towards = np.random.default_rng([9, seed]).uniform(0.0, 2.0 * np.pi, 4)
    return both(
        *(
            seam(share * SHAPE[1], (7.0 * np.cos(angle), 7.0 * np.sin(angle)))
            for share, angle in zip((0.15, 0.33, 0.5, 0.8), towards.tolist(), strict=True)
        )
    )


@pytest.mark.monte_carlo
def test_detectors_beyond_the_points_are_within_what_is_stated() -> None:
    trials = [trial(detectors(seed), seed, count=90, reach=(1.0, 0.65)) for seed in range(12)]
    shown = [one for one in trials if any(part.is_seam for part in one.adjustment.left_open)]
    assert len(shown) >= 8
    assert sum(one.ratio > WRONG for one in shown) <= 1
    assert 0.3 < np.mean([one.normalised for one in shown]) < 2.0
