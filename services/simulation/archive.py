"""An archive of simulated images: passes over years, clouds, seasons, errors of the models.

Everything follows from the seed of the archive: each image draws from seeds of its own.
"""

import math
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta

import numpy as np

from amers.services.geodesy import metres_per_degree
from amers.services.simulation.conditions import Conditions
from amers.services.simulation.render import Radiometry
from amers.services.simulation.view import ViewGeometry, ViewPlan, plan_geometry
from amers.services.simulation.world import World
from amers.services.types import Array

CENTRE_LON_LAT = (5.4, 43.6)
PASS_SIGMA_M, IMAGE_SIGMA_M = 5.0, 1.0
"""Standard deviations, a coordinate, of the location error of a pass and of its images about it."""
LATER_ERROR_M = (3.0, 20.0)
"""Range of the location errors of later images."""
DRIFT_SIGMA_PX = 0.2
"""Standard deviation of drifts and skews of a delivered model at the edges of its image."""
JITTER_PX = 0.2
GSD_M = 2.5
"""Ground sampling of a vertical view."""
OLDER_GSD_M = 2.0
DARKEST_SEASON = 0.5
"""Distance of the vegetation in January from that in July."""
FIRST_DAY, LAST_DAY = date(2018, 5, 1), date(2026, 6, 30)
PLATFORMS = ("alpha-1", "alpha-2")

_SECONDS_APART = 9.0
_BEYOND = 0.055
"""How far images reach beyond the area, sides of the area: its corners are cut off by their turn."""
_DIRECTIONS = (
    (7.0, 102.0),
    (25.0, 98.0),
    (19.0, 283.0),
    (27.0, 279.0),
    (14.0, 13.0),
    (21.0, 195.0),
)
"""Incidence and azimuth of the passes."""
_DAYS = (
    date(2021, 6, 14),
    date(2022, 8, 29),
    date(2022, 3, 21),
    date(2021, 10, 7),
    date(2023, 5, 2),
    date(2024, 1, 18),
)
_CLOUDS = (0.03, 0.12, 0.01, 0.20, 0.07, 0.14)
"""Mean cloud cover of the passes."""
_OLDER = (
    (9.0, 100.0, date(2018, 6, 25)),
    (13.0, 285.0, date(2018, 10, 12)),
    (16.0, 195.0, date(2019, 2, 20)),
    (12.0, 15.0, date(2019, 8, 3)),
)
"""Incidence, azimuth and day of the views that the older base was made from."""


@dataclass(frozen=True)
class ArchiveSize:
    """How large a simulated archive is.

    Attributes:
        world_m: side of the world, beyond which it repeats.
        posting_m: distance of its nodes.
        relief_m: difference between its lowest and its highest ground.
        region_m: size of its forests and towns.
        area_m: side of the square in its middle that the archive is about.
        images: number of images of each pass.
        lines: of an image, and its samples.
        later: number of images of later years.
        later_lines: of one of these, and its samples.
    """

    world_m: float
    posting_m: float
    relief_m: float
    region_m: float
    area_m: float
    images: tuple[int, ...]
    lines: int
    later: int
    later_lines: int


CONTINENT = ArchiveSize(22_000.0, 2.0, 420.0, 3_000.0, 20_000.0, (7, 7, 6, 7, 7, 6), 4400, 20, 2800)
SMALL = ArchiveSize(4_096.0, 2.0, 120.0, 1_200.0, 3_400.0, (3, 3, 2), 1200, 2, 1000)


@dataclass(frozen=True)
class ArchiveView:
    """One image of an archive: what is known of it, and the truth about its errors.

    Attributes:
        plan: of the image.
        platform, orbit: its pass.
        conditions: haze, clouds, season.
        error_m: east and north, of the delivered model at the centre of the image.
        drift_px: (2, 3) additional error of the delivered model, see `ImageCorrection`.
        pass_error_m: the part of `error_m` that all images of the pass share.
        stated_m: standard deviations that the producer states: of a pass, and of an image about it.
        border_px: width of the border without data on the left, at the first and at the last line.
        seed: of clouds, noise and jitter.
    """

    plan: ViewPlan
    platform: str
    orbit: int
    conditions: Conditions
    error_m: tuple[float, float]
    drift_px: Array
    pass_error_m: tuple[float, float]
    stated_m: tuple[float, float]
    border_px: tuple[int, int]
    seed: int

    @property
    def name(self) -> str:
        """Name of the image."""
        return self.plan.image_id

    @property
    def day(self) -> date:
        """Day of the image."""
        return self.plan.acquired_at.date()


def archive_views(size: ArchiveSize, seed: int) -> list[ArchiveView]:
    """The images that a base is produced from: passes of several images over three years."""
    views = []
    for number, count in enumerate(size.images):
        rng = np.random.default_rng([seed, 1, number])
        incidence_deg, azimuth_deg = _DIRECTIONS[number]
        start = datetime.combine(_DAYS[number], datetime.min.time(), UTC)
        start += timedelta(hours=10, minutes=float(rng.uniform(25.0, 55.0)))
        shared_m = rng.normal(0.0, PASS_SIGMA_M, 2)
        radiometry = Radiometry(gain=float(rng.uniform(4300.0, 5600.0)))
        haze = float(rng.uniform(0.0, 0.15))
        for k, place_m in enumerate(_places_m(size, count, rng)):
            error_m = shared_m + rng.normal(0.0, IMAGE_SIGMA_M, 2)
            # Agile satellites look forward and backward within a pass.
            ahead_deg = float(rng.uniform(-3.0, 3.0))
            incidence = max(2.0, incidence_deg + float(rng.uniform(-1.5, 1.5)))
            moment = start + timedelta(seconds=_SECONDS_APART * k)
            plan = ViewPlan(
                f"{PLATFORMS[number % 2]}_{moment:%Y%m%dT%H%M%S}",
                _lon_lat(place_m),
                (size.lines, size.lines),
                GSD_M / math.cos(math.radians(incidence)),
                incidence,
                (azimuth_deg + ahead_deg * 20.0 / incidence) % 360.0,
                moment,
                JITTER_PX,
                radiometry,
            )
            cover = min(0.6, _CLOUDS[number] * float(rng.exponential()))
            views.append(
                ArchiveView(
                    plan,
                    PLATFORMS[number % 2],
                    10_000 + 700 * number,
                    Conditions(haze=haze, cloud_cover=cover, season=season_of(plan.acquired_at.date())),
                    _pair(error_m),
                    _drift_px(rng),
                    _pair(shared_m),
                    (PASS_SIGMA_M, IMAGE_SIGMA_M),
                    (int(rng.integers(4, 40)), int(rng.integers(4, 40))),
                    int(rng.integers(2**31)),
                )
            )
    return views


def later_views(size: ArchiveSize, seed: int) -> list[ArchiveView]:
    """Images of the two years after the archive, each of a pass of its own, with larger errors."""
    views = []
    for number in range(size.later):
        rng = np.random.default_rng([seed, 2, number])
        start = datetime(2024, 3, 1, 10, 20, tzinfo=UTC)
        moment = start + timedelta(days=int(rng.integers(0, 840)), minutes=float(rng.uniform(0.0, 40.0)))
        length_m, towards = rng.uniform(*LATER_ERROR_M), rng.uniform(0.0, 2.0 * np.pi)
        error_m = length_m * np.array([np.sin(towards), np.cos(towards)])
        incidence = float(rng.uniform(3.0, 29.0))
        reach_m = max(0.0, (size.area_m - size.later_lines * GSD_M) / 2.0)
        plan = ViewPlan(
            f"beta-1_{moment:%Y%m%dT%H%M%S}",
            _lon_lat(rng.uniform(-reach_m, reach_m, 2)),
            (size.later_lines, size.later_lines),
            GSD_M / math.cos(math.radians(incidence)),
            incidence,
            float(rng.uniform(0.0, 360.0)),
            moment,
            JITTER_PX,
            Radiometry(gain=float(rng.uniform(4300.0, 5600.0))),
        )
        conditions = Conditions(
            haze=float(rng.uniform(0.0, 0.15)),
            cloud_cover=min(0.3, 0.06 * float(rng.exponential())),
            season=season_of(moment.date()),
        )
        sigma_m = LATER_ERROR_M[1] / 2.0
        views.append(
            ArchiveView(
                plan,
                "beta-1",
                20_000 + number,
                conditions,
                _pair(error_m),
                _drift_px(rng),
                _pair(error_m),
                (sigma_m, 0.0),
                (int(rng.integers(4, 40)), int(rng.integers(4, 40))),
                int(rng.integers(2**31)),
            )
        )
    return views


def older_views(size: ArchiveSize, seed: int) -> list[ArchiveView]:
    """Images without errors of their models that the older base was made from: other years, noisier."""
    views = []
    for number, (incidence_deg, azimuth_deg, day) in enumerate(_OLDER):
        rng = np.random.default_rng([seed, 3, number])
        lines = round((size.area_m + 800.0) / OLDER_GSD_M)
        plan = ViewPlan(
            f"gamma-1_{day:%Y%m%d}",
            CENTRE_LON_LAT,
            (lines, lines),
            OLDER_GSD_M,
            incidence_deg,
            azimuth_deg,
            datetime.combine(day, datetime.min.time(), UTC) + timedelta(hours=10, minutes=30),
        )
        conditions = Conditions(season=season_of(day), noise=25.0)
        zero = (0.0, 0.0)
        views.append(
            ArchiveView(
                plan,
                "gamma-1",
                1_000 + number,
                conditions,
                zero,
                np.zeros((2, 3)),
                zero,
                zero,
                (0, 0),
                int(rng.integers(2**31)),
            )
        )
    return views


def view_geometry(world: World, view: ArchiveView) -> ViewGeometry:
    """The true geometry of an image and the model that is delivered with it."""
    rng = np.random.default_rng([view.seed, 1])
    return plan_geometry(world, view.plan, rng, view.error_m, view.drift_px)


def season_of(day: date) -> float:
    """Distance of the vegetation of a day from that of July, as `Conditions.season`."""
    since_july = 2.0 * math.pi * (day.timetuple().tm_yday - 196) / 365.25
    return DARKEST_SEASON * (1.0 - math.cos(since_july)) / 2.0


def _places_m(size: ArchiveSize, count: int, rng: np.random.Generator) -> Array:
    """Centres (n, 2), east and north, of the images of a pass: two strips and what lies between."""
    side_m = size.lines * GSD_M
    reach_m = np.maximum(0.0, size.area_m / 2.0 - side_m / 2.0 + _BEYOND * size.area_m)
    per_strip = max(1, count // 2)
    east = reach_m * np.repeat([-1.0, 1.0], per_strip)
    north = reach_m * np.tile(np.linspace(1.0, -1.0, per_strip) if per_strip > 1 else [0.0], 2)
    places = np.column_stack([east, north])
    more = rng.uniform(-reach_m, reach_m, (count - len(places), 2))
    return np.concatenate([places + rng.uniform(-250.0, 250.0, places.shape), more])


def _lon_lat(place_m: Array) -> tuple[float, float]:
    east_m, north_m = metres_per_degree(CENTRE_LON_LAT[1], 300.0)
    east, north = place_m.tolist()
    return CENTRE_LON_LAT[0] + east / east_m, CENTRE_LON_LAT[1] + north / north_m


def _drift_px(rng: np.random.Generator) -> Array:
    parameters = np.zeros((2, 3))
    parameters[:, 1:] = rng.normal(0.0, DRIFT_SIGMA_PX, (2, 2))
    return parameters


def _pair(values: Array) -> tuple[float, float]:
    first, second = values.tolist()
    return first, second
