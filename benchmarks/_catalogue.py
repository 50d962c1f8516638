"""A simulated catalogue: passes of three satellites over a part of Africa, with clouds; its files."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from amers.services.imagery.catalogue import ImageCatalogue
from amers.services.types import Array

SCENE_KM = 60.0
KM_PER_DEGREE = 111.2
SECONDS_PER_SCENE = 8.7
FIRST_DAY = np.datetime64("2022-01-01")
DAYS = 4 * 365
PLATFORMS = ("alpha-1", "alpha-2", "alpha-3")
CENTRE_LON_LAT = np.array([15.0, 0.0])
HEADING_DEG = 190.0
"""Direction of flight of a descending pass."""


@dataclass(frozen=True)
class Climate:
    """How cloudy the ground is, 0 to 1, by place and day."""

    cloudiness: float = 0.3

    def mean_cover(self, lon_lat: Array, day: Array) -> Array:
        """Mean cloud cover (n,) at places (n, 2) on days (n,) of the year."""
        season = np.cos(2.0 * np.pi * (day - 200.0) / 365.0)
        belt = np.exp(-(((lon_lat[:, 1] - 5.0 * season) / 7.0) ** 2))
        coast = 0.25 * np.exp(-(((lon_lat[:, 0] - 10.0) / 4.0) ** 2))
        return np.clip(self.cloudiness * (0.35 + 1.2 * belt) + coast, 0.03, 0.97)


def simulate_catalogue(
    images: int, side_km: float, rng: np.random.Generator, climate: Climate = Climate()
) -> ImageCatalogue:
    """Images of passes over a square around 15 E, 0 N."""
    half = side_km / 2.0 / KM_PER_DEGREE
    centre = CENTRE_LON_LAT
    heading = np.radians(HEADING_DEG)
    along = np.array([np.sin(heading), np.cos(heading)])
    across = np.array([along[1], -along[0]])
    rows = []
    number = 0
    while len(rows) < images:
        number += 1
        platform = int(rng.integers(3))
        day = float(rng.uniform(0.0, DAYS))
        offset = rng.uniform(-1.15, 1.15) * half
        length = int(rng.integers(5, 30))
        begin = rng.uniform(-1.15 * half, 1.15 * half)
        roll = rng.normal(0.0, 15.0)
        pitch = rng.choice([0.0, 0.0, 0.0, 18.0, -18.0])
        weather = rng.normal(0.0, 1.0)
        field = 0.0
        for k in range(length):
            middle = centre + across * offset + along * (begin + k * SCENE_KM * 0.96 / KM_PER_DEGREE)
            field = 0.8 * field + 0.6 * rng.normal()
            if np.abs(middle - centre).max() > half:
                continue
            rows.append(
                (
                    number,
                    platform,
                    day + k * SECONDS_PER_SCENE / 86400.0,
                    *middle,
                    roll,
                    pitch,
                    weather + field,
                )
            )
    table = np.array(rows[:images])
    lon_lat = table[:, 3:5]
    n = len(table)
    size = SCENE_KM / 2.0 / KM_PER_DEGREE * (1.0 + 0.03 * rng.normal(size=n))
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    offsets = corner[:, :1] * across + corner[:, 1:] * along
    ring = lon_lat[:, None, :] + size[:, None, None] * offsets
    footprint = shapely.polygons(ring)
    mean = climate.mean_cover(lon_lat, table[:, 2] % 365.0)
    cover = 1.0 / (1.0 + np.exp(-(np.log(mean / (1.0 - mean)) * 1.0 + 1.3 * table[:, 7])))
    cover[rng.random(n) < 0.15] *= 0.05
    mask = np.empty(n, dtype=object)
    for i in range(n):
        mask[i] = clouds(footprint[i], float(cover[i]), float(size[i]), rng)
    cover = shapely.area(mask) / shapely.area(footprint)
    stated = np.round(100.0 * np.clip(cover + 0.01 * rng.normal(size=n), 0.0, 1.0))
    stated[rng.random(n) < 0.03] = np.nan
    mask[rng.random(n) < 0.05] = None
    roll, pitch = table[:, 5], table[:, 6]
    tilt = np.degrees(np.arccos(np.cos(np.radians(roll)) * np.cos(np.radians(pitch))))
    east = np.sin(np.radians(roll)) * across[0] + np.sin(np.radians(pitch)) * along[0]
    north = np.sin(np.radians(roll)) * across[1] + np.sin(np.radians(pitch)) * along[1]
    snow = np.where(rng.random(n) < 0.02, rng.uniform(2.0, 60.0, n), 0.0)
    return ImageCatalogue(
        id=np.array([f"S{int(r[0]):05d}-{k:05d}" for k, r in enumerate(table)], dtype=object),
        footprint=footprint,
        mask=mask,
        acquired=FIRST_DAY.astype("datetime64[ms]")
        + (table[:, 2] * 86_400_000.0).astype("timedelta64[ms]"),
        cloud_percent=stated,
        snow_percent=snow,
        incidence_deg=tilt,
        azimuth_deg=np.degrees(np.arctan2(east, north)) % 360.0,
        sun_elevation_deg=np.full(n, 55.0),
        sun_azimuth_deg=np.full(n, 90.0),
        platform=np.array(PLATFORMS, dtype=object)[table[:, 1].astype(int)],
        orbit=table[:, 0].astype(np.int64),
    )


def clouds(
    footprint: shapely.Geometry, cover: float, half_deg: float, rng: np.random.Generator
) -> shapely.Geometry:
    """Discs that cover about a share of a footprint."""
    count = int(rng.integers(3, 12))
    west, south, east, north = footprint.bounds
    places = np.column_stack([rng.uniform(west, east, count), rng.uniform(south, north, count)])
    total = -np.log1p(-min(cover, 0.98)) * footprint.area
    share = rng.dirichlet(np.full(count, 1.5))
    discs = shapely.buffer(shapely.points(places), np.sqrt(total * share / np.pi), quad_segs=3)
    return shapely.multipolygons([disc for disc in discs if disc.area > 0.0])


def write_catalogue(catalogue: ImageCatalogue, folder: Path) -> Path:
    """Write a line of STAC for each image, and its GeoJSON mask; returns the file of the lines."""
    (folder / "masks").mkdir(parents=True, exist_ok=True)
    path = folder / "items.ndjson"
    with path.open("w", encoding="utf-8") as out:
        for row in range(len(catalogue)):
            out.write(json.dumps(_item(catalogue, row)) + "\n")
            if catalogue.mask[row] is not None:
                document = {
                    "type": "Feature",
                    "properties": {},
                    "geometry": _geojson(catalogue.mask[row]),
                }
                (folder / _mask_name(catalogue, row)).write_text(json.dumps(document), encoding="utf-8")
    return path


def _item(catalogue: ImageCatalogue, row: int) -> dict[str, Any]:
    numbers = {
        "eo:cloud_cover": catalogue.cloud_percent[row],
        "eo:snow_cover": catalogue.snow_percent[row],
        "view:incidence_angle": catalogue.incidence_deg[row],
        "view:azimuth": (catalogue.azimuth_deg[row] + 180.0) % 360.0,
        "view:sun_elevation": catalogue.sun_elevation_deg[row],
        "view:sun_azimuth": catalogue.sun_azimuth_deg[row],
    }
    assets: dict[str, Any] = {"image": {"href": f"images/{catalogue.id[row]}.tif", "roles": ["data"]}}
    if catalogue.mask[row] is not None:
        assets["clouds"] = {
            "href": _mask_name(catalogue, row),
            "type": "application/geo+json",
            "roles": ["cloud"],
        }
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "id": str(catalogue.id[row]),
        "geometry": _geojson(catalogue.footprint[row]),
        "properties": {
            "datetime": f"{catalogue.acquired[row]}Z",
            "platform": str(catalogue.platform[row]),
            "sat:absolute_orbit": int(catalogue.orbit[row]),
            **{name: float(value) for name, value in numbers.items() if not math.isnan(value)},
        },
        "assets": assets,
        "links": [],
    }


def _geojson(shape: shapely.Geometry) -> Any:
    return json.loads(shapely.to_geojson(shape))


def _mask_name(catalogue: ImageCatalogue, row: int) -> str:
    return f"masks/{catalogue.id[row]}.geojson"
