"""Passes: the groups that pairs of images make when each pair is looked at."""

from datetime import UTC, datetime, timedelta
from itertools import combinations

import numpy as np
import pytest

from amers.services.production.image_passes import dates_of_points, image_passes
from amers.services.types import Acquisition, Observations

START = datetime(2024, 5, 1, 10, tzinfo=UTC)


def acquisition(sensor: str, minutes: float | None) -> Acquisition:
    moment = None if minutes is None else START + timedelta(minutes=minutes)
    return Acquisition(f"{sensor}-{minutes}", sensor=sensor, acquired_at=moment)


def groups(acquisitions: list[Acquisition]) -> set[frozenset[int]]:
    return {frozenset(np.flatnonzero(mask).tolist()) for mask in image_passes(acquisitions)}


def groups_by_pairs(acquisitions: list[Acquisition]) -> set[frozenset[int]]:
    """The same from every pair, joined until nothing changes."""
    joined = [{i} for i in range(len(acquisitions))]
    for i, j in combinations(range(len(acquisitions)), 2):
        one, other = acquisitions[i], acquisitions[j]
        sensors = not one.sensor or not other.sensor or one.sensor == other.sensor
        known = one.acquired_at is not None and other.acquired_at is not None
        apart = known and abs(one.acquired_at - other.acquired_at) > timedelta(minutes=20)
        if sensors and not apart and joined[i] is not joined[j]:
            joined[i] |= joined[j]
            for k in joined[i]:
                joined[k] = joined[i]
    return {frozenset(group) for group in joined if len(group) > 1}


@pytest.mark.parametrize("seed", range(30))
def test_groups_are_those_of_all_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    names = ["a", "b", "c", ""] if seed % 2 else ["a", "b"]
    count = int(rng.integers(2, 40))
    minutes = rng.uniform(0.0, 40.0 * count, count).round(1).tolist()
    drawn = [
        acquisition(str(rng.choice(names)), None if seed % 3 == 0 and rng.random() < 0.05 else moment)
        for moment in minutes
    ]
    assert groups(drawn) == groups_by_pairs(drawn)


def test_images_of_one_pass_are_joined_over_their_neighbours() -> None:
    strip = [acquisition("a", 15.0 * i) for i in range(4)]
    assert groups([*strip, acquisition("b", 5.0), acquisition("a", 200.0)]) == {frozenset(range(4))}


def test_one_image_is_no_pass() -> None:
    assert image_passes([acquisition("a", 0.0)]) == []
    assert image_passes([]) == []


def test_points_of_more_dates_count_more() -> None:
    shown = Observations(
        point=np.array([0, 0, 0, 1, 1, 1]),
        image=np.array([0, 1, 2, 0, 2, 3]),
        line_sample=np.zeros((6, 2)),
        sigma_px=np.ones(6),
    )
    # Images 0, 1 and 2 are of one pass.
    assert dates_of_points(shown, [np.array([True, True, True, False])], 3).tolist() == [1, 2, 0]
