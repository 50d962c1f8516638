"""Models of features that are made one by one: a point with its views, scenes as STAC items.

Pages of features are built in the database; `amers.app.api.json_schemas` describes them.
"""

from datetime import date, datetime
from typing import Annotated, Literal

from pydantic import Field, WithJsonSchema

from amers.app.api.models.base import Count, JsonObject, Link, Missing, Reply, StatedAccuracy

PointGeometry = Annotated[
    JsonObject,
    WithJsonSchema(
        {
            "type": "object",
            "format": "geometry-point",
            "required": ["type", "coordinates"],
            "properties": {
                "type": {"const": "Point"},
                "coordinates": {"type": "array", "items": {"type": "number"}},
            },
        }
    ),
]
AnyGeometry = Annotated[JsonObject, WithJsonSchema({"type": "object", "format": "geometry-any"})]


class PointViewProperties(Reply):
    """A view of a point: its chip, and the image that the chip was cut from; null where unknown."""

    view: int
    gsd_m: float
    incidence_deg: float | None
    azimuth_deg: float | None
    image_id: str
    sensor: str
    acquired_at: datetime | None
    sun_elevation_deg: float | None
    sun_azimuth_deg: float | None


class PointHistoryProperties(Reply):
    """How a point fared in the scenes that tried to match it."""

    state: Literal["served", "proposed", "suspended"]
    attempts: Count
    successes: Count
    expected: float
    health: float
    last_attempt: datetime | None
    last_success: datetime | None
    mean_residual_px: float | None
    mean_east_m: float | None
    mean_north_m: float | None
    suspended_at: datetime | None
    suspended_because: str | None


class PointHistoryRecord(PointHistoryProperties):
    """How one point fared in the scenes that tried to match it."""

    id: int


class PointProperties(PointHistoryProperties):
    """A control point: its accuracy, its views, its history."""

    sigma_east_m: float
    sigma_north_m: float
    sigma_up_m: float
    corr_east_north: float
    corr_east_up: float
    corr_north_up: float
    relative_to_control_points: StatedAccuracy
    on_the_earth: StatedAccuracy
    n_views: Count
    saliency: float
    typology: str | None
    first_view: date | None
    last_view: date | None
    surface_height_m: float | None
    surface_sigma_m: float | None
    block: str
    block_version: str
    views: list[PointViewProperties]


class PointWithViews(Reply):
    """A control point with its views, a GeoJSON feature."""

    type: Literal["Feature"]
    id: int
    geometry: PointGeometry
    properties: PointProperties
    links: list[Link]


class Asset(Reply):
    """A file of a STAC item."""

    href: str
    type: str
    title: str
    roles: list[str]


class StacItem(Reply):
    """A scene as a STAC item."""

    type: Literal["Feature"]
    stac_version: str
    stac_extensions: list[str]
    id: str
    geometry: AnyGeometry | None
    bbox: list[float] | None = Missing
    properties: JsonObject
    collection: str
    assets: dict[str, Asset]
    links: list[Link]


class StacItems(Reply):
    """A page of scenes as STAC items."""

    type: Literal["FeatureCollection"]
    features: list[StacItem]
    number_matched: Count = Field(serialization_alias="numberMatched")
    number_returned: Count = Field(serialization_alias="numberReturned")
    links: list[Link]
