"""Pages of features of every collection, and single features."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import datetime

import psycopg

from amers.app.db.density import DENSITY
from amers.app.db.engine import Connection
from amers.app.db.features import counts, pages, serialization
from amers.app.db.features.collection import Collection, Viewer
from amers.app.db.features.counts import Count
from amers.app.db.features.crs import Crs
from amers.app.db.features.outlines import BLOCKS, SCENES
from amers.app.db.features.pages import Reading
from amers.app.db.features.query import Key, Selection
from amers.app.db.history import HISTORY
from amers.app.db.points import POINTS
from amers.app.errors import InvalidParameter, NotFound
from amers.app.usecases.features.page_tokens import format_token
from amers.app.usecases.features.query import FeatureFilter, ResolvedQuery, condition_of, crs_of
from amers.services.formats.vector.feature_files import Column, FeatureTable, read_feature_csv

COLLECTIONS: Mapping[str, Collection] = {
    collection.id: collection for collection in (POINTS, BLOCKS, DENSITY, HISTORY, SCENES)
}
LARGEST_TEXT = 2_000
"""Largest page that is built as one text; larger pages are streamed."""


@dataclass(frozen=True)
class FeaturePage:
    """A page of features.

    Attributes:
        body: the features, without the document around them; empty for tables and streams.
        returned: number of features on this page.
        matched: number of features on all pages.
        next_token: of the next page; None on the last page.
    """

    body: bytes
    returned: int
    matched: Count
    next_token: str | None


def find_collection(name: str) -> Collection:
    """The collection of this name.

    Raises:
        NotFound: there is none.
    """
    collection = COLLECTIONS.get(name)
    if collection is None:
        raise NotFound(f"no collection {name:.100}: expected one of {', '.join(COLLECTIONS)}")
    return collection


def page(
    connection: Connection, query: ResolvedQuery, form: pages.TextFormat, secret: bytes
) -> FeaturePage:
    """A page in a text format that the database builds.

    Raises:
        InvalidParameter: the database cannot evaluate the filter, such as a division by zero.
    """
    try:
        text = pages.page(connection, query.selection, form, query.after, query.limit)
        matched = _matched(connection, query, text.last, text.returned)
    except psycopg.DataError as error:
        raise _invalid_filter(error) from error
    return FeaturePage(text.body, text.returned, matched, _next(query, text.last, matched, secret))


def table(
    connection: Connection, query: ResolvedQuery, secret: bytes
) -> tuple[FeatureTable, FeaturePage]:
    """A page as columns, for column formats.

    Raises:
        InvalidParameter: the database cannot evaluate the filter.
    """
    selection = query.selection
    try:
        text = pages.copy_csv(connection, selection, query.after, query.limit)
    except psycopg.DataError as error:
        raise _invalid_filter(error) from error
    columns = [
        Column(item.name, item.type) for item in (selection.collection.key, *selection.properties)
    ]
    features, last_keys = read_feature_csv(
        text, columns, selection.collection.geometry_type, selection.crs.srid, query.limit
    )
    last = None if last_keys is None else tuple(json.loads(last_keys))
    matched = _matched(connection, query, last, len(features))
    next_token = _next(query, last, matched, secret)
    table = replace(features, is_sorted=bool(selection.order))
    return table, FeaturePage(b"", len(features), matched, next_token)


def stream(connection: Connection, query: ResolvedQuery, secret: bytes) -> Iterator[bytes | FeaturePage]:
    """The features of a large page as GeoJSON, in pieces; the last item is the `FeaturePage`."""
    reading = Reading()
    yield from pages.stream_geojson(connection, query.selection, query.after, query.limit, reading)
    matched = _matched(connection, query, reading.last, reading.returned)
    next_token = _next(query, reading.last, matched, secret)
    yield FeaturePage(b"", reading.returned, matched, next_token)


def find_feature(
    connection: Connection, collection: Collection, viewer: Viewer, reference: str, crs: str | None
) -> tuple[str, Crs]:
    """One feature as GeoJSON text, and its coordinate reference system.

    Raises:
        NotFound: there is no such feature, or the viewer may not see it.
    """
    chosen_crs = crs_of("crs", crs, collection) if crs else collection.storage_crs
    selection = Selection(collection, viewer, chosen_crs, collection.properties)
    feature = None if "\0" in reference else pages.find(connection, selection, reference)
    if feature is None:
        raise NotFound(f"no feature {reference:.100} in {collection.id}")
    return feature, chosen_crs


def extent(connection: Connection, collection: Collection, viewer: Viewer) -> tuple[float, ...] | None:
    """West, south, east, north of the features that the viewer may see; None if there are none."""
    # Points and cells lie in the outlines of their blocks, which are fewer: cells to 0.1 degrees.
    bounding = BLOCKS if collection in (POINTS, DENSITY, HISTORY) else collection
    return counts.extent(connection, bounding, viewer if bounding is collection else Viewer())


def period(
    connection: Connection, collection: Collection, viewer: Viewer
) -> tuple[datetime | None, datetime | None]:
    """The first and the last time of the scenes that the viewer may see; None for other collections."""
    if collection is not SCENES:
        return None, None
    return counts.period(connection, collection, viewer)


def everything_in(collection: Collection, bbox: str | None = None) -> Selection:
    """All features in a box that a caller without a token may see.

    Raises:
        InvalidParameter: the box cannot be used.
    """
    condition = condition_of(collection, FeatureFilter(bbox=bbox))
    return Selection(collection, Viewer(), collection.storage_crs, collection.properties, condition)


def page_secret(connection: Connection) -> bytes:
    """The secret that signs page tokens."""
    return pages.page_secret(connection)


def csv_header(selection: Selection) -> str:
    """The header line of CSV."""
    return serialization.csv_header(selection)


def _matched(connection: Connection, query: ResolvedQuery, last: Key | None, returned: int) -> Count:
    """The number of matching features; taken from the token or from a first page that has them all."""
    if query.matched is not None:
        return query.matched
    if last is None and query.after is None:
        return Count(returned, exact=True)
    return counts.count(connection, query.selection, returned + (last is not None))


def _next(query: ResolvedQuery, last: Key | None, matched: Count, secret: bytes) -> str | None:
    return None if last is None else format_token(last, matched, query.fingerprint, secret)


def _invalid_filter(error: psycopg.DataError) -> InvalidParameter:
    message = error.diag.message_primary or str(error)
    return InvalidParameter(f"filter: the database cannot evaluate it: {message:.200}")
