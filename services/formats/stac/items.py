"""The facts of one STAC item that a selection of images needs.

Source: STAC 1.0 and 1.1 with the extensions eo, view and sat. Only geometry and time are required.

| field | read as |
|---|---|
| `geometry` | footprint: Polygon or MultiPolygon, GeoJSON (RFC 7946) |
| `datetime`, else `start_datetime` | UTC; a time without offset is UTC |
| `eo:cloud_cover`, `eo:snow_cover` | percent of the valid area; absent or null is unknown, not 0 |
| `view:incidence_angle`, else `view:off_nadir` | incidence on the ground; from an orbit of 700 km |
| `view:azimuth` | from the sub-satellite point to the scene; + 180 degrees from the ground |
| `view:sun_elevation`, `view:sun_azimuth` | of the sun |
| `platform`, `sat:absolute_orbit` | the pass |
| assets with the role cloud, cloud-shadow or snow-ice | masks, where they are GeoJSON |
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
import shapely

from amers.services.errors import FormatError
from amers.services.imagery.footprints import footprint_on_ground

MASK_ROLES = frozenset({"cloud", "cloud-shadow", "snow-ice"})
"""Roles of assets that show what hides the ground (STAC best practices, asset roles)."""
GEOJSON_TYPES = ("application/geo+json", "application/json")
_EARTH_KM, _ORBIT_KM = 6371.0, 700.0
_LONGEST_VALUE = 80
_FURTHEST_LONGITUDE_DEG = 360.0

Json = Mapping[str, Any]


@dataclass(frozen=True)
class StacImage:
    """What an item states of its image; see `amers.services.imagery.catalogue.ImageCatalogue`.

    Attributes:
        key: collection and id, which identify the item.
        footprint: on the ground.
        acquired: UTC.
        cloud_percent, snow_percent, incidence_deg, azimuth_deg, sun_elevation_deg, sun_azimuth_deg: NaN
            when unknown.
        platform: "" when unknown.
        orbit: absolute orbit, -1 when unknown.
        masks: addresses of the masks in GeoJSON, as written.
        other_masks: number of masks in other formats, which are not read.
    """

    key: tuple[str, str]
    footprint: shapely.Geometry
    acquired: datetime
    cloud_percent: float
    snow_percent: float
    incidence_deg: float
    azimuth_deg: float
    sun_elevation_deg: float
    sun_azimuth_deg: float
    platform: str
    orbit: int
    masks: tuple[str, ...]
    other_masks: int


def parse_item(item: Any, source: str) -> StacImage:
    """What an item states of its image.

    Args:
        item: JSON of a STAC item.
        source: where it stands, for messages.

    Raises:
        FormatError: a field is missing or wrong; the message states field, value and expectation.
    """
    if not isinstance(item, dict) or item.get("type") != "Feature":
        raise _wrong(source, "type", item.get("type") if isinstance(item, dict) else item, "Feature")
    name = item.get("id")
    if not isinstance(name, str) or not name:
        raise _wrong(source, "id", name, "a text")
    source = f"{source}: item {name!r:.{_LONGEST_VALUE}}"
    properties = item.get("properties")
    if not isinstance(properties, dict):
        raise _wrong(source, "properties", properties, "an object")
    fields = _Fields(properties, source)
    masks, other_masks = _masks(item.get("assets"), source)
    azimuth_deg = fields.number("view:azimuth", -360.0, 360.0)
    platform = properties.get("platform")
    return StacImage(
        key=(str(item.get("collection") or ""), name),
        footprint=parse_footprint(item.get("geometry"), source),
        acquired=fields.time(),
        cloud_percent=fields.number("eo:cloud_cover", 0.0, 100.0),
        snow_percent=fields.number("eo:snow_cover", 0.0, 100.0),
        incidence_deg=_incidence_deg(fields),
        azimuth_deg=(azimuth_deg + 180.0) % 360.0,
        sun_elevation_deg=fields.number("view:sun_elevation", -90.0, 90.0),
        sun_azimuth_deg=fields.number("view:sun_azimuth", -360.0, 360.0),
        platform=platform if isinstance(platform, str) else "",
        orbit=fields.orbit(),
        masks=masks,
        other_masks=other_masks,
    )


def parse_footprint(geometry: Any, source: str) -> shapely.Geometry:
    """The footprint on the ground of a GeoJSON geometry.

    Raises:
        FormatError: it is no polygon with an area, or its coordinates are not longitude and latitude.
    """
    shape = parse_polygons(geometry, f"{source}: geometry")
    if shape.is_empty:
        raise FormatError(f"{source}: geometry: nothing found, a polygon with an area expected")
    footprint = footprint_on_ground(shape)
    if not shapely.is_valid(footprint) or not shapely.area(footprint) > 0.0:
        reason = shapely.is_valid_reason(footprint)
        raise FormatError(f"{source}: geometry: {reason} found, a polygon with an area expected")
    return footprint


def parse_polygons(geometry: Any, source: str) -> shapely.Geometry:
    """The polygons of a GeoJSON geometry, in two dimensions.

    Raises:
        FormatError: it has another type, or its coordinates are not longitude and latitude.
    """
    kind = geometry.get("type") if isinstance(geometry, dict) else geometry
    if kind not in ("Polygon", "MultiPolygon"):
        raise FormatError(
            f"{source}: type {kind!r:.{_LONGEST_VALUE}} found, Polygon or MultiPolygon expected"
        )
    try:
        shape = shapely.force_2d(shapely.geometry.shape(geometry))
    except (
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        AttributeError,
        shapely.errors.GEOSException,
    ) as error:
        raise FormatError(f"{source}: coordinates of a {kind} expected: {error}") from None
    lon_lat = shapely.get_coordinates(shape)
    limit = np.array([_FURTHEST_LONGITUDE_DEG, 90.0])
    wrong = ~(np.abs(lon_lat) <= limit).all(axis=1)
    if wrong.any():
        first = ", ".join(f"{value:g}" for value in lon_lat[wrong][0].tolist())
        raise FormatError(
            f"{source}: position {first} found, longitude and latitude in degrees expected"
        )
    return shape


class _Fields:
    """Checked values of the properties of an item."""

    def __init__(self, properties: Json, source: str) -> None:
        self._properties = properties
        self._source = source

    def number(self, name: str, low: float, high: float) -> float:
        """A number within limits; NaN when absent or null."""
        value = self._properties.get(name)
        if value is None:
            return math.nan
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not low <= value <= high:
            raise _wrong(self._source, name, value, f"a number from {low:g} to {high:g}")
        return float(value)

    def time(self) -> datetime:
        """Time of the acquisition, UTC."""
        name = "datetime" if self._properties.get("datetime") is not None else "start_datetime"
        value = self._properties.get(name)
        if value is None:
            raise _wrong(self._source, "datetime", value, "a time such as 2024-05-01T10:00:00Z")
        try:
            moment = datetime.fromisoformat(value)
            moment = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment
            return moment.astimezone(UTC)
        except (ValueError, TypeError, OverflowError):
            raise _wrong(self._source, name, value, "a time such as 2024-05-01T10:00:00Z") from None

    def orbit(self) -> int:
        """Absolute orbit; -1 when absent."""
        value = self._properties.get("sat:absolute_orbit")
        if value is None:
            return -1
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**62:
            raise _wrong(self._source, "sat:absolute_orbit", value, "a number of an orbit from 0")
        return value


def _incidence_deg(fields: _Fields) -> float:
    incidence_deg = fields.number("view:incidence_angle", 0.0, 90.0)
    off_nadir_deg = fields.number("view:off_nadir", 0.0, 90.0)
    if not math.isnan(incidence_deg) or math.isnan(off_nadir_deg):
        return incidence_deg
    ratio = (_EARTH_KM + _ORBIT_KM) / _EARTH_KM
    return math.degrees(math.asin(min(1.0, ratio * math.sin(math.radians(off_nadir_deg)))))


def _masks(assets: Any, source: str) -> tuple[tuple[str, ...], int]:
    """Addresses of the masks in GeoJSON, and the number of other masks."""
    if assets is None:
        return (), 0
    if not isinstance(assets, dict):
        raise _wrong(source, "assets", assets, "an object")
    found, others = [], 0
    for name, asset in assets.items():
        roles = asset.get("roles") if isinstance(asset, dict) else None
        if not isinstance(roles, list) or not MASK_ROLES & {
            role for role in roles if isinstance(role, str)
        }:
            continue
        address = asset.get("href")
        if not isinstance(address, str) or not address:
            raise _wrong(source, f"assets.{name}.href", address, "an address")
        kind = str(asset.get("type") or "").split(";")[0].strip()
        if kind in GEOJSON_TYPES or (not kind and address.lower().endswith((".geojson", ".json"))):
            found.append(address)
        else:
            others += 1
    return tuple(found), others


def _wrong(source: str, field: str, value: Any, expected: str) -> FormatError:
    found = "nothing" if value is None else f"{value!r:.{_LONGEST_VALUE}}"
    return FormatError(f"{source}: {field}: {found} found, {expected} expected")
