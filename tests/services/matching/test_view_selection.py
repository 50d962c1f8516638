"""The views of a point that look most like the scene are selected first."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from amers.services.matching.view_selection import ViewDistanceScales, select_views, view_distances
from amers.services.types import UNKNOWN_FRAME, Acquisition, ControlPoints, IntArray, Views

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
    return ControlPoints(
        id=np.arange(2),
        lon_lat_h=np.zeros((2, 3)),
        covariance_m2=np.zeros((2, 3, 3)),
        block=np.zeros(2, dtype=np.int64),
        frames=(UNKNOWN_FRAME,),
        saliency=np.ones(2),
        health=np.ones(2),
        views=Views(
            start=np.array([0, 1, 1 + m]),
            gsd_m=np.array([gsd_m[0], *gsd_m]),
            image=np.zeros(1 + m, dtype=np.int64),
            incidence_deg=np.array([0.0, *incidence_deg]),
            azimuth_deg=np.array([0.0, *azimuth_deg]),
            health=np.ones(1 + m),
            images=(image,),
        ),
        chip_file=np.zeros(2, dtype=np.int64),
        chip_row=np.array([0, 1]),
        chip_files=("chips",),
    )


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


def distance_of(image: Acquisition, health: float = 1.0) -> float:
    points = point_with_views([1.0], [SCENE.incidence_deg], [SCENE.azimuth_deg], image)
    views = replace(points.views, health=np.array([1.0, health]))
    return float(view_distances(views, SCENE, ViewDistanceScales())[1])


def test_a_view_taken_in_the_same_way_has_no_distance() -> None:
    assert distance_of(SCENE) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("near", "far"),
    [
        (
            {"acquired_at": datetime(2023, 1, 5, tzinfo=UTC)},
            {"acquired_at": datetime(2024, 9, 1, tzinfo=UTC)},
        ),
        ({"sun_elevation_deg": 33.0}, {"sun_elevation_deg": 60.0}),
        ({"sun_azimuth_deg": 8.0}, {"sun_azimuth_deg": 300.0}),
        ({"sensor": "PHR 1A"}, {"sensor": "SPOT 6"}),
        ({"sun_azimuth_deg": 8.0}, {"sun_azimuth_deg": float("nan")}),
        ({}, {"acquired_at": None}),
    ],
)
def test_season_light_and_sensor_add_distance_and_angles_wrap_around(near: dict, far: dict) -> None:
    assert distance_of(replace(SCENE, **near)) < distance_of(replace(SCENE, **far))


def test_a_view_that_often_failed_has_a_larger_distance() -> None:
    assert distance_of(SCENE, 0.5) > distance_of(replace(SCENE, sensor="SPOT 6"))


def test_no_points_have_no_selected_views() -> None:
    points = point_with_views([1.0], [0.0], [0.0]).take(np.array([], dtype=np.int64))
    selected = select_views(points, 1.0, SCENE, 2, ViewDistanceScales())
    assert len(selected.row) == 0
    np.testing.assert_array_equal(selected.start, [0])


def test_twice_the_loss_of_health_is_four_times_as_far() -> None:
    views = point_with_views([2.0] * 3, [20.0] * 3, [10.0] * 3, SCENE).views
    worse = replace(views, health=np.array([1.0, 1.0, 0.8, 0.6]))
    far = view_distances(worse, SCENE, ViewDistanceScales()) - view_distances(
        views, SCENE, ViewDistanceScales()
    )
    assert far[1] == pytest.approx(0.0)
    assert far[3] == pytest.approx(4.0 * far[2])
    assert far[2] > 0.0


@pytest.mark.parametrize(
    ("difference", "expected"),
    [
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
