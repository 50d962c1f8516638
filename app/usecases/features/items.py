"""Features of every collection: pages of them, one by one."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime

import psycopg

from app.db.density import DENSITY
from app.db.engine import Connection
from app.db.features import counts, pages, serialization
from app.db.features.collection import Collection, Viewer
from app.db.features.counts import Count
from app.db.features.crs import Crs
from app.db.features.outlines import BLOCKS, SCENES
from app.db.features.pages import Reading
from app.db.features.query import Key, Selection
from app.db.history import HISTORY
from app.db.points import POINTS
from app.errors import InvalidParameter, NotFound
from app.usecases.features.page_tokens import format_token
from app.usecases.features.query import FeatureFilter, ResolvedQuery, condition_of, crs_of
from services.formats.vector.feature_files import Column, FeatureTable, read_feature_csv

COLLECTIONS: Mapping[str, Collection] = {
    collection.id: collection for collection in (POINTS, BLOCKS, DENSITY, HISTORY, SCENES)
}
LARGEST_TEXT = 2_000
"""Features that are made into one text; more are streamed."""


@dataclass(frozen=True)
class Answer:
    """A page.

    Attributes:
        body: without what stands around features.
        returned: how many.
        matched: how many there are on all pages.
        next_token: where the next page begins, None on the last one.
    """

    body: bytes
    returned: int
    matched: Count
    next_token: str | None


def find_collection(name: str) -> Collection:
    """The collection of a name.

    Raises:
        NotFound: there is none.
    """
    found = COLLECTIONS.get(name)
    if found is None:
        raise NotFound(f"no collection {name:.100}: there are {', '.join(COLLECTIONS)}")
    return found


def page(connection: Connection, asked: ResolvedQuery, kind: pages.Text, secret: bytes) -> Answer:
    """A page in a format that the database makes.

    Raises:
        InvalidParameter: a value of the filter cannot be calculated with.
    """
    try:
        found = pages.page(connection, asked.selection, kind, asked.after, asked.limit)
        matched = _matched(connection, asked, found.last, found.returned)
    except psycopg.DataError as error:
        raise _unusable(error) from error
    return Answer(found.body, found.returned, matched, _next(asked, found.last, matched, secret))


def table(connection: Connection, asked: ResolvedQuery, secret: bytes) -> tuple[FeatureTable, Answer]:
    """A page as columns, for the formats that hold columns."""
    selection = asked.selection
    try:
        text = pages.copy_csv(connection, selection, asked.after, asked.limit)
    except psycopg.DataError as error:
        raise _unusable(error) from error
    columns = [
        Column(item.name, "text" if item.is_time else item.type)
        for item in (selection.collection.key, *selection.properties)
    ]
    read, last_keys = read_feature_csv(
        text, columns, selection.collection.geometry_type, selection.crs.srid, asked.limit
    )
    last = None if last_keys is None else tuple(json.loads(last_keys))
    matched = _matched(connection, asked, last, len(read))
    return read, Answer(b"", len(read), matched, _next(asked, last, matched, secret))


def stream(connection: Connection, asked: ResolvedQuery, secret: bytes) -> Iterator[bytes | Answer]:
    """The features of a large page as GeoJSON, in pieces; the last thing is the answer about them."""
    reading = Reading()
    yield from pages.stream_geojson(connection, asked.selection, asked.after, asked.limit, reading)
    matched = _matched(connection, asked, reading.last, reading.returned)
    yield Answer(b"", reading.returned, matched, _next(asked, reading.last, matched, secret))


def find_feature(
    connection: Connection, collection: Collection, viewer: Viewer, reference: str, crs: str | None
) -> tuple[str, Crs]:
    """One feature as GeoJSON text, and its reference system.

    Raises:
        NotFound: there is no such feature, or not for this caller.
    """
    chosen = crs_of("crs", crs, collection) if crs else collection.storage_crs
    selection = Selection(collection, viewer, chosen, collection.properties)
    found = None if "\0" in reference else pages.find(connection, selection, reference)
    if found is None:
        raise NotFound(f"no feature {reference:.100} in {collection.id}")
    return found, chosen


def extent(connection: Connection, collection: Collection, viewer: Viewer) -> tuple[float, ...] | None:
    """West, south, east, north of what the viewer may see of a collection, None without any."""
    # Points lie in the outlines of their blocks, which are fewer; so do cells, to a tenth of a degree.
    whose = BLOCKS if collection in (POINTS, DENSITY, HISTORY) else collection
    return counts.extent(connection, whose, viewer if whose is collection else Viewer())


def period(
    connection: Connection, collection: Collection, viewer: Viewer
) -> tuple[datetime | None, datetime | None]:
    """The first and the last time of what the viewer may see of scenes; unknown for the others."""
    if collection is not SCENES:
        return None, None
    return counts.period(connection, collection, viewer)


def everything_in(collection: Collection, bbox: str | None = None) -> Selection:
    """All features in a box, as anybody sees them.

    Raises:
        InvalidParameter: the box cannot be used.
    """
    condition = condition_of(collection, FeatureFilter(bbox=bbox))
    return Selection(collection, Viewer(), collection.storage_crs, collection.properties, condition)


def _matched(connection: Connection, asked: ResolvedQuery, last: Key | None, returned: int) -> Count:
    """How many match; a first page that holds them all has counted them already."""
    if asked.matched is not None:
        return asked.matched
    if last is None and asked.after is None:
        return Count(returned, exact=True)
    return counts.count(connection, asked.selection)


def _next(asked: ResolvedQuery, last: Key | None, matched: Count, secret: bytes) -> str | None:
    return None if last is None else format_token(last, matched, asked.fingerprint, secret)


def _unusable(error: psycopg.DataError) -> InvalidParameter:
    said = error.diag.message_primary or str(error)
    return InvalidParameter(f"filter: {said:.200}")


def page_secret(connection: Connection) -> bytes:
    """What the installation signs the links to further pages with."""
    return pages.page_secret(connection)


def csv_header(selection: Selection) -> str:
    """The names of the columns of CSV."""
    return serialization.csv_header(selection)
