"""Selected points and observations are the requested rows, in the requested order."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from amers.services.types import (
    UNKNOWN_FRAME,
    Acquisition,
    ControlPoints,
    Frame,
    IntArray,
    Observations,
    Views,
    health,
    part_of,
)

OF_POINTS = ("id", "lon_lat_h", "covariance_m2", "block", "saliency", "health", "chip_file", "chip_row")
view_counts = st.lists(st.integers(0, 4), min_size=1, max_size=8)


def points_with(counts: list[int]) -> ControlPoints:
    """Points with given numbers of views; each value identifies its row."""
    n, m = len(counts), sum(counts)
    return ControlPoints(
        id=100 + np.arange(n),
        lon_lat_h=np.arange(3.0 * n).reshape(n, 3),
        covariance_m2=np.arange(9.0 * n).reshape(n, 3, 3),
        block=np.arange(n) % 2,
        frames=(Frame(np.eye(3)), UNKNOWN_FRAME),
        saliency=np.arange(float(n)) / n,
        health=1.0 - np.arange(n) / 100.0,
        views=Views(
            start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            gsd_m=1.0 + np.arange(m),
            image=np.arange(m) % 2,
            incidence_deg=10.0 + np.arange(m),
            azimuth_deg=20.0 + np.arange(m),
            health=1.0 - np.arange(m) / 100.0,
            images=(Acquisition("a"), Acquisition("b")),
        ),
        chip_file=np.arange(n) % 3,
        chip_row=7 * np.arange(n),
        chip_files=("x", "y", "z"),
    )


def rows_of(data: st.DataObject, n: int) -> IntArray:
    return np.array(data.draw(st.lists(st.integers(0, n - 1), max_size=12)), dtype=np.int64)


@given(view_counts, st.data())
def test_selected_points_keep_all_their_attributes(counts: list[int], data: st.DataObject) -> None:
    points = points_with(counts)
    rows = rows_of(data, len(counts))
    taken = points.take(rows)
    assert len(taken) == len(rows)
    assert taken.chip_files == points.chip_files
    assert taken.frames is points.frames
    assert taken.views.images == points.views.images
    assert taken.views.start[0] == 0
    assert taken.views.start[-1] == len(taken.views.gsd_m) == len(taken.views.image)
    for new, old in enumerate(rows):
        for name in OF_POINTS:
            np.testing.assert_array_equal(getattr(taken, name)[new], getattr(points, name)[old])
        mine = slice(*taken.views.start[new : new + 2])
        theirs = slice(*points.views.start[old : old + 2])
        for name in ("gsd_m", "image", "incidence_deg", "azimuth_deg", "health"):
            np.testing.assert_array_equal(
                getattr(taken.views, name)[mine], getattr(points.views, name)[theirs]
            )


def test_a_part_of_some_work_moves_its_own_share_of_the_progress() -> None:
    told: list[tuple[float, str]] = []
    part_of(part_of(lambda *done: told.append(done), 0.2, 0.5), 0.5, 0.25)(0.4, "half")
    assert told == [(pytest.approx(0.2 + 0.5 * (0.5 + 0.25 * 0.4)), "half")]


def test_health_is_one_without_a_history_and_falls_with_each_failure() -> None:
    """And it never exceeds that: of five scenes that are expected to show a point, ten may."""
    tried = np.array([0, 1, 5, 5, 100, 5])
    found = health(tried, np.array([0, 0, 0, 5, 0, 10]))
    np.testing.assert_allclose(found, [1, 5 / 6, 0.5, 1, 5 / 105, 1])


@given(st.integers(1, 20), st.data())
def test_selected_observations_are_the_requested_rows(m: int, data: st.DataObject) -> None:
    numbers = np.arange(m)
    observations = Observations(
        numbers // 2, numbers % 2, np.column_stack([numbers, -numbers]) * 1.0, 1.0 + numbers
    )
    rows = rows_of(data, m)
    mask = np.array(data.draw(st.lists(st.booleans(), min_size=m, max_size=m)), dtype=bool)
    for chosen, expected in ((rows, rows), (mask, np.flatnonzero(mask))):
        taken = observations.take(chosen)
        assert len(taken) == len(expected)
        np.testing.assert_array_equal(taken.point, expected // 2)
        np.testing.assert_array_equal(taken.image, expected % 2)
        np.testing.assert_array_equal(taken.line_sample, np.column_stack([expected, -expected]))
        np.testing.assert_array_equal(taken.sigma_px, 1.0 + expected)
