"""The views of a point that look most like the scene are selected first."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from amers.services.matching.view_selection import ViewDistanceScales, select_views, view_distances
from amers.services.types import Acquisition, ControlPoints, IntArray, Views
from tests.services.simulated import points_with

SCENE = Acquisition(
    "scene",
    sensor="PHR 1A",
    acquired_at=datetime(2024, 12, 28, tzinfo=UTC),
    incidence_deg=20.0,
    azimuth_deg=10.0,
    sun_elevation_deg=30.0,
    sun_azimuth_deg=350.0,
)
UNKNOWN = Acquisition("unknown")


def point_with_views(
    gsd_m: list[float],
    incidence_deg: list[float],
    azimuth_deg: list[float],
    image: Acquisition = UNKNOWN,
) -> ControlPoints:
    """One point, with a point of one view before it."""
    m = len(gsd_m)
    views = Views(
        start=np.array([0, 1, 1 + m]),
        gsd_m=np.array([gsd_m[0], *gsd_m]),
        image=np.zeros(1 + m, dtype=np.int64),
        incidence_deg=np.array([0.0, *incidence_deg]),
        azimuth_deg=np.array([0.0, *azimuth_deg]),
        health=np.ones(1 + m),
        images=(image,),
    )
    return points_with(np.zeros((2, 3)), views, 0.0)


def numbers(points: ControlPoints, gsd_m: float, scene: Acquisition, count: int) -> IntArray:
    """Views of the second point, numbered within it."""
    selected = select_views(points, gsd_m, scene, count, ViewDistanceScales())
    return selected.row[selected.start[1] : selected.start[2]] - points.views.start[1]


def test_the_views_most_like_the_scene_are_selected_at_the_requested_sampling() -> None:
    points = point_with_views([1.0, 1.0, 1.0, 4.0], [20.0, 20.0, 5.0, 20.0], [180.0, 350.0, 90.0, 10.0])
    np.testing.assert_array_equal(numbers(points, 1.0, SCENE, 2), [1, 2])
    np.testing.assert_array_equal(numbers(points, 4.0, SCENE, 2), [3])
    assert len(numbers(points, 2.0, SCENE, 2)) == 0


def test_azimuth_does_not_matter_to_vertical_views() -> None:
    points = point_with_views([1.0, 1.0], [0.0, 8.0], [0.0, 200.0])
    scene = replace(SCENE, incidence_deg=1.0, azimuth_deg=200.0)
    assert numbers(points, 1.0, scene, 1)[0] == 0


def test_views_are_selected_even_where_directions_are_unknown() -> None:
    points = point_with_views([1.0, 1.0], [np.nan, 8.0], [np.nan, 200.0])
    seen = replace(SCENE, incidence_deg=8.0, azimuth_deg=200.0)
    np.testing.assert_array_equal(numbers(points, 1.0, seen, 2), [1, 0])
    assert len(numbers(points, 1.0, UNKNOWN, 2)) == 2


def test_no_points_have_no_selected_views() -> None:
    points = point_with_views([1.0], [0.0], [0.0]).take(np.array([], dtype=np.int64))
    selected = select_views(points, 1.0, SCENE, 2, ViewDistanceScales())
    assert len(selected.row) == 0
    np.testing.assert_array_equal(selected.start, [0])


@pytest.mark.parametrize(
    ("difference", "expected"),
    [
        ({}, 0.0),
        ({"incidence_deg": SCENE.incidence_deg + 15.0}, 1.0),
        ({"acquired_at": datetime(2025, 2, 27, tzinfo=UTC)}, 1.0),
        ({"acquired_at": datetime(2023, 10, 30, tzinfo=UTC)}, 1.0),
        ({"sun_elevation_deg": 45.0}, 1.0),
        ({"sun_azimuth_deg": 30.0}, 1.0),
        ({"sun_azimuth_deg": 310.0}, 1.0),
        ({"sensor": "SPOT 6"}, 0.25),
        ({"health": 0.75}, 1.0),
        ({"health": 0.5}, 4.0),
        ({"sun_elevation_deg": 60.0, "sensor": "SPOT 6"}, 4.25),
        ({"sun_elevation_deg": float("nan"), "sun_azimuth_deg": float("nan")}, 2.0),
        ({"acquired_at": None, "sun_elevation_deg": 45.0}, 2.0),
    ],
)
def test_differences_of_one_documented_unit_weigh_alike_and_add_as_squares(
    difference: dict[str, object], expected: float
) -> None:
    """The units of docs/methods/matching.md; an unknown value counts as one of them."""
    health = difference.get("health", 1.0)
    of_image = {name: value for name, value in difference.items() if name != "health"}
    image = replace(SCENE, **of_image)  # type: ignore[arg-type]
    views = point_with_views([1.0], [image.incidence_deg], [SCENE.azimuth_deg], image).views
    views = replace(views, health=np.array([1.0, health]))
    distance = view_distances(views, SCENE, ViewDistanceScales())[1]
    assert distance == pytest.approx(expected, abs=1e-2)
