"""Asking for control points: pages of a box, one point, its chips."""

import base64
import hashlib
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from app.db import points
from app.db.engine import Connection
from app.db.points import Box, Count, FeaturePage, PointDetail, PointView
from app.errors import InputError, NotFound
from services.formats.chip_images import LabelledChips
from services.types import Acquisition, ChipSource

DEFAULT_LIMIT = 100
MOST_POINTS = 10_000
_TOKEN = struct.Struct(">qq8s")


@dataclass(frozen=True)
class PointPage:
    """Points as GeoJSON features.

    Attributes:
        features: separated by commas, without brackets.
        returned: how many.
        matched: how many there are on all pages.
        next_token: where the next page begins, None on the last one.
    """

    features: str
    returned: int
    matched: Count
    next_token: str | None


def parse_bbox(text: str) -> Box:
    """A box out of `W,S,E,N` in degrees; west greater than east crosses the antimeridian.

    Raises:
        InputError: naming the value that cannot be used.
    """
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 4 or not all(math.isfinite(value) for value in values):
        raise InputError(f"bbox: {text!r:.100} found, four numbers W,S,E,N in degrees expected")
    box = Box(*values)
    for name, value, limit in (
        ("west", box.west, 180.0),
        ("south", box.south, 90.0),
        ("east", box.east, 180.0),
        ("north", box.north, 90.0),
    ):
        if abs(value) > limit:
            raise InputError(f"bbox: {name} {value:g} found, {-limit:g} to {limit:g} expected")
    if box.south > box.north:
        raise InputError(f"bbox: south {box.south:g} is above north {box.north:g}")
    return box


def query_points(
    connection: Connection, box: Box | None, limit: int = DEFAULT_LIMIT, token: str | None = None
) -> PointPage:
    """A page of published points.

    Args:
        box: where; None for everywhere.
        limit: most points on the page; more than 10,000 are never given at once.
        token: `next_token` of the page before.

    Raises:
        InputError: the limit is below 1, or the token is not one of this query.
    """
    if limit < 1:
        raise InputError(f"limit: {limit} found, 1 to {MOST_POINTS} expected")
    after, known = (-1, None) if token is None else _parse_token(token, box)
    page = points.point_features(connection, box, after, min(limit, MOST_POINTS))
    matched = known or _matched(connection, box, page)
    next_token = None if page.last_id is None else _format_token(page.last_id, matched, box)
    return PointPage(page.features, page.returned, matched, next_token)


def count_points(connection: Connection, box: Box) -> Count:
    """How many published points a box holds: exact up to 10,000, an estimate beyond."""
    return points.count_points(connection, box)


def geojson(connection: Connection, box: Box) -> Iterator[bytes]:
    """All published points of a box as one FeatureCollection, in pieces."""
    yield b'{"type":"FeatureCollection","features":[\n'
    after: int | None = -1
    while after is not None:
        page = points.point_features(connection, box, after, MOST_POINTS)
        yield page.features.encode()
        after = page.last_id
        if after is not None:
            yield b",\n"
    yield b"\n]}\n"


def csv(connection: Connection, box: Box) -> Iterator[bytes]:
    """All published points of a box as CSV with a header, in pieces."""
    return points.points_csv(connection, box)


def find_point(connection: Connection, point_id: int) -> PointDetail:
    """One published point with its views.

    Raises:
        NotFound: there is no such point, or its block is not published.
    """
    found = points.find_point(connection, point_id) if abs(point_id) < 2**63 else None
    if found is None:
        raise NotFound(f"no point {point_id}")
    return found


def read_chips(chips: ChipSource, point: PointDetail) -> LabelledChips:
    """The chips of a point with what they show."""
    return _labelled(chips, point, point.views)


def read_chip(chips: ChipSource, point: PointDetail, view: int) -> LabelledChips:
    """One chip of a point with what it shows.

    Raises:
        NotFound: the point has no such view.
    """
    if not 0 <= view < len(point.views):
        raise NotFound(f"point {point.id} has views 0 to {len(point.views) - 1}, not {view}")
    return _labelled(chips, point, point.views[view : view + 1])


def _labelled(chips: ChipSource, point: PointDetail, views: tuple[PointView, ...]) -> LabelledChips:
    return LabelledChips(
        lon_lat_h=np.array([point.lon_deg, point.lat_deg, point.height_m]),
        chips=chips.read(point.chip_key, point.chip_row + views[0].view, len(views)),
        gsd_m=np.array([view.gsd_m for view in views]),
        incidence_deg=np.array([_or_nan(view.incidence_deg) for view in views]),
        azimuth_deg=np.array([_or_nan(view.azimuth_deg) for view in views]),
        images=tuple(
            Acquisition(
                image_id=view.image_id,
                sensor=view.sensor,
                acquired_at=view.acquired_at,
                sun_elevation_deg=_or_nan(view.sun_elevation_deg),
                sun_azimuth_deg=_or_nan(view.sun_azimuth_deg),
            )
            for view in views
        ),
    )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _matched(connection: Connection, box: Box | None, page: FeaturePage) -> Count:
    """How many match; a first page that holds them all has counted them already."""
    if page.last_id is None:
        return Count(page.returned, exact=True)
    return points.count_points(connection, box)


def _format_token(after: int, matched: Count, box: Box | None) -> str:
    number = matched.number if matched.exact else -matched.number
    packed = _TOKEN.pack(after, number, _seal(after, number, box))
    return base64.urlsafe_b64encode(packed).decode()


def _parse_token(token: str, box: Box | None) -> tuple[int, Count]:
    try:
        after, number, seal = _TOKEN.unpack(base64.b64decode(token, altchars=b"-_", validate=True))
    except (ValueError, struct.error):
        after, number, seal = 0, 0, b""
    if seal != _seal(after, number, box):
        raise InputError(f"token: {token!r:.100} is not of this query; follow the link `next`")
    return after, Count(abs(number), exact=number >= 0)


def _seal(after: int, number: int, box: Box | None) -> bytes:
    """Ties a token to its query, against mistakes only: it allows nothing that the query does not."""
    return hashlib.sha256(repr((after, number, box)).encode()).digest()[:8]
