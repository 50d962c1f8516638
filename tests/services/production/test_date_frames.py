"""Frames of dates: injected errors come back, and the stated accuracy is that of the truth."""

import numpy as np
import pytest

from amers.services.imagery.archives import SENTINEL_2, StatedAccuracy
from amers.services.production.date_frames import (
    MEASURED_SIGMA_M,
    DateFrames,
    DateShifts,
    date_frames,
)
from amers.services.types import Array

OLD, NEW = SENTINEL_2.accuracy
a_millimetre = 1e-3


def shifts_of(error_m: Array, rng: np.random.Generator | None = None) -> DateShifts:
    """The shifts of all dates against the first, with the noise of their measurement."""
    others = np.arange(1, len(error_m))
    shift_m = error_m[1:] - error_m[0]
    if rng is not None:
        shift_m = shift_m + rng.normal(0.0, MEASURED_SIGMA_M, shift_m.shape)
    return DateShifts(np.zeros(len(others), dtype=np.int64), others, shift_m)


def drawn(stated: list[StatedAccuracy], rng: np.random.Generator) -> Array:
    """Errors of dates as the producer states them."""
    common = {one: rng.normal(0.0, one.common_m, 2) for one in dict.fromkeys(stated)}
    return np.array([rng.normal(0.0, one.own_m, 2) + common[one] for one in stated])


def frames_of(stated: list[StatedAccuracy], error_m: Array, orbits: list[str]) -> DateFrames:
    return date_frames(stated, orbits, shifts_of(error_m))


@pytest.mark.monte_carlo
@pytest.mark.parametrize(
    "stated",
    [[NEW] * 8, [OLD] * 3 + [NEW] * 6, [OLD] + [NEW] * 5],
    ids=["refined", "both baselines", "mostly refined"],
)
def test_the_circular_error_is_within_a_fifth_of_what_is_stated(stated: list[StatedAccuracy]) -> None:
    rng = np.random.default_rng(1)
    orbits = ["22", "65"] * 5
    left, sigma = [], []
    for _ in range(1500):
        error_m = drawn(stated, rng)
        frames = date_frames(stated, orbits[: len(stated)], shifts_of(error_m, rng))
        left.append(error_m[-1] - frames.error_m[-1])
        sigma.append(frames.sigma_m)
    true_ce90_m = np.quantile(np.linalg.norm(left, axis=1), 0.9)
    stated_ce90_m = 2.1460 * np.sqrt(np.mean(np.square(sigma)))
    print(f"CE90 {true_ce90_m:.2f} m true, {stated_ce90_m:.2f} m stated")
    assert true_ce90_m / stated_ce90_m == pytest.approx(1.0, abs=0.2)


def test_dates_that_disagree_by_more_than_stated_raise_the_accuracy() -> None:
    error_m = np.array([[0.0, 0.0], [12.0, 0.0], [-9.0, 14.0], [3.0, -16.0], [8.0, 8.0]])
    frames = frames_of([NEW] * 5, error_m, ["22", "65", "22", "65", "22"])
    assert frames.factor > 5.0
    assert frames.sigma_m > 1.5 * frames.stated_m
    assert frames.apart_m == pytest.approx(np.linalg.norm([12.0, -30.0]) * 0.99, rel=0.05)


def test_orbits_that_disagree_raise_the_accuracy_although_their_dates_agree() -> None:
    rng = np.random.default_rng(2)
    orbits = ["22", "65"] * 5
    offset_m = np.array([[6.0, 0.0] if orbit == "22" else [-6.0, 0.0] for orbit in orbits])
    apart = frames_of([OLD] * 10, offset_m + rng.normal(0.0, 0.5, (10, 2)), orbits)
    assert apart.orbits_apart_m == pytest.approx(12.0, abs=1.0)
    sure = [StatedAccuracy(1.0)] * 10
    raised = frames_of(sure, offset_m + rng.normal(0.0, 0.5, (10, 2)), orbits)
    assert raised.sigma_m > 3.0 * raised.stated_m


def test_one_orbit_or_unknown_ones_are_no_better_than_one_date() -> None:
    error_m = np.array([[9.0, 9.0], [-9.0, -9.0], [9.0, -9.0], [-9.0, 9.0]])
    for orbits in (["22"] * 4, [""] * 4):
        frames = frames_of([OLD] * 4, error_m, orbits)
        assert frames.sigma_m >= frames.factor * OLD.own_m
    assert frames_of([OLD] * 4, error_m * 0.1, ["22", "65"] * 2).sigma_m >= OLD.total_m


def test_two_dates_of_berlin_are_no_better_than_half_their_distance() -> None:
    error_m = np.array([[0.0, 0.0], [6.4, 18.3]])
    frames = frames_of([OLD] * 2, error_m, ["", ""])
    assert frames.apart_m == pytest.approx(19.39, abs=0.1)
    np.testing.assert_allclose(frames.error_m.mean(axis=0), 0.0, atol=a_millimetre)
    assert frames.sigma_m == pytest.approx(19.39 / 2.0, abs=0.01)


def test_one_date_is_as_it_is_stated() -> None:
    none = DateShifts(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)))
    frames = date_frames([NEW], ["22"], none)
    assert frames.sigma_m == pytest.approx(NEW.total_m)
    np.testing.assert_array_equal(frames.error_m, np.zeros((1, 2)))
    assert (frames.factor, frames.apart_m, frames.orbits) == (1.0, 0.0, 1)
