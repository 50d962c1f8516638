"""Selection of the views of a point that are most similar to a scene."""

from dataclasses import dataclass

import numpy as np

from amers.services.matching.predict import rank_in_group
from amers.services.types import Acquisition, Array, ControlPoints, IntArray, Views

DAYS_OF_A_YEAR = 365.25


@dataclass(frozen=True)
class ViewDistanceScales:
    """Differences between a view and a scene that have equal weight.

    The distance of a view from a scene is the sum of the squares of its differences, each divided by its
    scale. A difference counts as one scale where one of the values is unknown. View and scene show the
    same ground, so a day of the year is the same season for both, on either hemisphere.

    Attributes:
        direction_deg: angle between the lines of sight.
        season_days: difference of the days of the year.
        sun_elevation_deg, sun_azimuth_deg: differences of the direction of the sun.
        sensor: distance of a view by another sensor.
        health: loss of health; see `types.health`.
    """

    direction_deg: float = 15.0
    season_days: float = 60.0
    sun_elevation_deg: float = 15.0
    sun_azimuth_deg: float = 40.0
    sensor: float = 0.5
    health: float = 0.25


@dataclass(frozen=True)
class SelectedViews:
    """Views of n points; those of point i are `row[start[i]:start[i + 1]]`, the nearest first.

    Attributes:
        row: (k,) int64, rows of `Views`.
        start: (n + 1,) int64.
    """

    row: IntArray
    start: IntArray


def select_views(
    points: ControlPoints,
    gsd_m: float,
    scene: Acquisition,
    count: int,
    scales: ViewDistanceScales,
) -> SelectedViews:
    """The views of every point, at one ground sampling, that look most like a scene.

    Args:
        points: all of them.
        gsd_m: ground sampling of the chips wanted, metres.
        scene: how it was taken.
        count: largest number of views of a point.
        scales: of the differences.
    """
    views = points.views
    owner = np.repeat(np.arange(len(points)), np.diff(views.start))
    rows = np.flatnonzero(np.isclose(views.gsd_m, gsd_m))
    distance = view_distances(views, scene, scales)[rows]
    selected = rank_in_group(owner[rows], -distance) < count if len(rows) else np.zeros(0, dtype=bool)
    rows, distance = rows[selected], distance[selected]
    rows = rows[np.lexsort((distance, owner[rows]))]
    start = np.searchsorted(owner[rows], np.arange(len(points) + 1))
    return SelectedViews(rows, start.astype(np.int64))


def view_distances(views: Views, scene: Acquisition, scales: ViewDistanceScales) -> Array:
    """Distances (m,) of views from a scene, without unit; 0 for a view taken in the same way."""
    cosine = _unit_vectors(views.incidence_deg, views.azimuth_deg) @ _unit_vectors(
        np.array([scene.incidence_deg]), np.array([scene.azimuth_deg])
    ).reshape(3)
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    health = (1.0 - views.health) / scales.health
    of_images = np.array([_image_distance(image, scene, scales) for image in views.images])
    return np.asarray(_square(angle_deg / scales.direction_deg) + health**2 + of_images[views.image])


def _image_distance(image: Acquisition, scene: Acquisition, scales: ViewDistanceScales) -> float:
    """The part of the distance that all views cut from one image share."""
    days = _day_of_year(image) - _day_of_year(scene)
    turn_deg = image.sun_azimuth_deg - scene.sun_azimuth_deg
    differences = np.array(
        [
            _on_circle(days, DAYS_OF_A_YEAR) / scales.season_days,
            (image.sun_elevation_deg - scene.sun_elevation_deg) / scales.sun_elevation_deg,
            _on_circle(turn_deg, 360.0) / scales.sun_azimuth_deg,
            scales.sensor if image.sensor != scene.sensor else 0.0,
        ]
    )
    return float(_square(differences).sum())


def _day_of_year(image: Acquisition) -> float:
    """Day of the year; NaN when unknown."""
    return float("nan") if image.acquired_at is None else float(image.acquired_at.timetuple().tm_yday)


def _on_circle(difference: float, circle: float) -> float:
    """A difference of two positions on a circle, along the shorter arc."""
    return (difference + circle / 2.0) % circle - circle / 2.0


def _square(differences: Array) -> Array:
    """Squares; 1 where a difference is unknown."""
    return np.nan_to_num(differences**2, nan=1.0)


def _unit_vectors(incidence_deg: Array, azimuth_deg: Array) -> Array:
    """Unit vectors (n, 3) east, north, up."""
    incidence, azimuth = np.radians(incidence_deg), np.radians(azimuth_deg)
    return np.column_stack(
        [np.sin(incidence) * np.sin(azimuth), np.sin(incidence) * np.cos(azimuth), np.cos(incidence)]
    )
