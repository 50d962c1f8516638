"""Which views of a point look most like a scene."""

from dataclasses import dataclass

import numpy as np

from services.matching.predict import rank_in_group
from services.types import Acquisition, Array, ControlPoints, IntArray, Views

DAYS_OF_A_YEAR = 365.25


@dataclass(frozen=True)
class ViewDistanceScales:
    """Differences between a view and a scene that count as much as each other.

    A view's distance from a scene is the sum of the squares of its differences in these units. What is
    not known of one of both counts as one unit. Views and scene show the same ground, so a day of
    the year is the same season for both, on either hemisphere.

    Attributes:
        direction_deg: angle between the lines of sight.
        season_days: round the year.
        sun_elevation_deg, sun_azimuth_deg: of the light.
        sensor: distance of another sensor.
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
    """Views of n points; those of point i are `row[start[i]:start[i + 1]]`, most alike first.

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
    likeness: ViewDistanceScales = ViewDistanceScales(),
) -> SelectedViews:
    """The views of every point, at one ground sampling, that look most like a scene.

    Args:
        points: all of them.
        gsd_m: ground sampling of the chips wanted.
        scene: how it was taken.
        count: how many views of a point at most.
        likeness: what makes a difference.
    """
    views = points.views
    owner = np.repeat(np.arange(len(points)), np.diff(views.start))
    rows = np.flatnonzero(np.isclose(views.gsd_m, gsd_m))
    distance = distances(views, scene, likeness)[rows]
    kept = rank_in_group(owner[rows], -distance) < count if len(rows) else np.zeros(0, dtype=bool)
    rows, distance = rows[kept], distance[kept]
    rows = rows[np.lexsort((distance, owner[rows]))]
    start = np.searchsorted(owner[rows], np.arange(len(points) + 1))
    return SelectedViews(rows, start.astype(np.int64))


def distances(
    views: Views, scene: Acquisition, likeness: ViewDistanceScales = ViewDistanceScales()
) -> Array:
    """How far views (m,) are from looking like a scene; 0 for one taken in the same way."""
    direction = _unit(views.incidence_deg, views.azimuth_deg) @ _unit(
        np.array([scene.incidence_deg]), np.array([scene.azimuth_deg])
    ).reshape(3)
    angle = np.degrees(np.arccos(np.clip(direction, -1.0, 1.0)))
    health = (1.0 - views.health) / likeness.health
    of_images = np.array([_of_image(image, scene, likeness) for image in views.images])
    return np.asarray(_square(angle / likeness.direction_deg) + health**2 + of_images[views.image])


def _of_image(image: Acquisition, scene: Acquisition, likeness: ViewDistanceScales) -> float:
    """The part of the distance that all the views cut from one image share."""
    season = _day(image) - _day(scene)
    turn = image.sun_azimuth_deg - scene.sun_azimuth_deg
    differences = np.array(
        [
            _round(season, DAYS_OF_A_YEAR) / likeness.season_days,
            (image.sun_elevation_deg - scene.sun_elevation_deg) / likeness.sun_elevation_deg,
            _round(turn, 360.0) / likeness.sun_azimuth_deg,
            likeness.sensor if image.sensor != scene.sensor else 0.0,
        ]
    )
    return float(_square(differences).sum())


def _day(image: Acquisition) -> float:
    """Day of the year; NaN when unknown."""
    return float("nan") if image.acquired_at is None else float(image.acquired_at.timetuple().tm_yday)


def _round(difference: float, circle: float) -> float:
    """A difference on a circle, the short way."""
    return (difference + circle / 2.0) % circle - circle / 2.0


def _square(differences: Array) -> Array:
    """Squares; what is unknown counts as one unit."""
    return np.nan_to_num(differences**2, nan=1.0)


def _unit(incidence_deg: Array, azimuth_deg: Array) -> Array:
    """Unit vectors (n, 3) east, north, up."""
    incidence, azimuth = np.radians(incidence_deg), np.radians(azimuth_deg)
    return np.column_stack(
        [np.sin(incidence) * np.sin(azimuth), np.sin(incidence) * np.cos(azimuth), np.cos(incidence)]
    )
