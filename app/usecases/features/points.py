"""Control points of published blocks: those of a box, single points, and their chips."""

import math
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from amers.app.db import point_detail, points
from amers.app.db.engine import Connection
from amers.app.db.features import counts, pages
from amers.app.db.features.collection import Viewer
from amers.app.db.features.counts import Count
from amers.app.db.features.pages import Reading
from amers.app.db.features.query import Selection
from amers.app.db.features.serialization import csv_header
from amers.app.db.point_detail import PointDetail, PointView
from amers.app.db.points import POINTS
from amers.app.errors import InvalidParameter, NotFound
from amers.app.usecases.features.items import everything_in
from amers.app.usecases.features.query import MOST_FEATURES, FeatureFilter, condition_of
from amers.services.formats.block.tables import covariance_from_sigmas
from amers.services.formats.chips.images import LabelledChips
from amers.services.formats.chips.stacks import stream_chips_npz
from amers.services.formats.chips.tiff_pages import stream_chips_tiff
from amers.services.quality.accuracy_statement import AccuracyStatement, points_accuracy
from amers.services.types import Acquisition, ChipSource, ControlPoints

StackFormat = Literal["npz", "tif"]
ALL = 2**40
MOST_POINTS_WITH_CHIPS = 1_000
"""Largest number of points in one reply with chips: with 8 views of 16 bits each it has 163 MB."""


def count_points(connection: Connection, bbox: str) -> Count:
    """The number of published points in a box: exact up to 10,000, an estimate beyond."""
    return counts.count(connection, everything_in(POINTS, bbox))


def geojson(connection: Connection, bbox: str) -> Iterator[bytes]:
    """All published points of a box as one FeatureCollection, in pieces."""
    yield b'{"type":"FeatureCollection","features":[\n'
    yield from pages.stream_geojson(connection, everything_in(POINTS, bbox), None, ALL, Reading())
    yield b"\n]}\n"


def csv(connection: Connection, bbox: str) -> Iterator[bytes]:
    """All published points of a box as CSV with a header, in pieces."""
    selection, after = everything_in(POINTS, bbox), None
    yield csv_header(selection).encode() + b"\r\n"
    while True:
        page = pages.page(connection, selection, "csv", after, MOST_FEATURES)
        if page.body:
            yield page.body + b"\r\n"
        if page.last is None:
            return
        after = page.last


def points_of_ids(connection: Connection, ids: Sequence[int]) -> ControlPoints:
    """The published points with these ids, with their views.

    Raises:
        InvalidParameter: there are too many ids.
        NotFound: some points do not exist; the message names the first ten of them.
    """
    requested = sorted(set(ids))
    if len(requested) > MOST_POINTS_WITH_CHIPS:
        raise InvalidParameter(
            f"ids: {len(requested)} points found, at most {MOST_POINTS_WITH_CHIPS} expected"
        )
    published = points.points_of_ids(connection, [id_ for id_ in requested if abs(id_) < 2**63]).points
    missing = sorted(set(requested) - set(published.id.tolist()))
    if missing:
        raise NotFound(f"no point {', '.join(map(str, missing[:10]))}{' …' * (len(missing) > 10)}")
    return published


def points_of_filter(connection: Connection, query: FeatureFilter) -> ControlPoints:
    """The published points that meet a filter, with their views.

    Raises:
        InvalidParameter: a parameter cannot be used, or too many points meet the filter.
    """
    condition = condition_of(POINTS, query)
    selection = Selection(POINTS, Viewer(), POINTS.storage_crs, (), condition)
    ids = pages.keys(connection, selection, MOST_POINTS_WITH_CHIPS)
    if len(ids) > MOST_POINTS_WITH_CHIPS:
        raise InvalidParameter(
            f"bbox, filter: more than {MOST_POINTS_WITH_CHIPS} points meet them; ask for a smaller area"
        )
    return points.points_of_ids(connection, ids).points


def stream_chips(points: ControlPoints, chips: ChipSource, form: StackFormat) -> Iterator[bytes]:
    """All chips of points with their metadata, in pieces: a NumPy archive, or a GeoTIFF of many pages.

    Raises:
        NotFound: there are no points, and a GeoTIFF has at least one page.
    """
    if form == "npz":
        return stream_chips_npz(points, chips)
    if not len(points.id):
        raise NotFound("no points match, and a GeoTIFF needs at least one page; request f=npz instead")
    return stream_chips_tiff(points, chips)


def find_point(connection: Connection, point_id: int) -> PointDetail:
    """One published point with its views.

    Raises:
        NotFound: there is no such point, or its block is not published.
    """
    point = point_detail.find_point(connection, point_id) if abs(point_id) < 2**63 else None
    if point is None:
        raise NotFound(f"no point {point_id}")
    return point


def point_accuracy(point: PointDetail) -> AccuracyStatement:
    """The accuracy of one point, in the frame of its block and on the Earth."""
    sigma_m = np.array([[point.sigma_east_m, point.sigma_north_m, point.sigma_up_m]])
    correlation = np.array([[point.corr_east_north, point.corr_east_up, point.corr_north_up]])
    return points_accuracy(covariance_from_sigmas(sigma_m, correlation)[0], point.frame, "this point")


def read_chips(chips: ChipSource, point: PointDetail) -> LabelledChips:
    """The chips of a point with their metadata."""
    return _labelled(chips, point, point.views)


def read_chip(chips: ChipSource, point: PointDetail, view: int) -> LabelledChips:
    """One chip of a point with its metadata.

    Raises:
        NotFound: the point has no such view.
    """
    if not 0 <= view < len(point.views):
        raise NotFound(f"point {point.id} has no view {view}: expected 0 to {len(point.views) - 1}")
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
