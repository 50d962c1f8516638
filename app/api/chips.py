"""The chips of many points at once, for clients that match by themselves."""

from collections.abc import Iterator
from itertools import chain
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import StreamingResponse
from pydantic import BeforeValidator, ConfigDict, Field

from amers.app.api.deps import ChipsDep, DatabaseDep, PointsReader
from amers.app.api.features import parameter_names
from amers.app.api.negotiation import FILE_HEADER, NPZ, TIFF, refuse_unknown
from amers.app.api.routes import CallerRoute
from amers.app.errors import DamagedFile, InvalidParameter
from amers.app.storage import StoredChips
from amers.app.usecases.damage import report_damage
from amers.app.usecases.features import points
from amers.app.usecases.features.points import MOST_POINTS_WITH_CHIPS, StackFormat
from amers.app.usecases.features.query import FeatureFilter
from amers.services.types import ControlPoints

router = APIRouter(tags=["points"], route_class=CallerRoute)

MEDIA_TYPES: dict[StackFormat, str] = {"npz": NPZ, "tif": TIFF}
LIMIT_TEXT = f"A reply has the chips of at most {MOST_POINTS_WITH_CHIPS:,} points."
ARCHIVE: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "npz: a NumPy archive. `chips` is (n, 101, 101) of raw values, 0 is nodata; all"
        " other arrays have a row for each chip: `point_id`, `view`, `lon_lat_h` of the point, `gsd_m`,"
        " `incidence_deg`, `azimuth_deg`, `image_id`, `sensor`, `acquired_at`, `sun_elevation_deg`,"
        " `sun_azimuth_deg`. tif: a GeoTIFF with a page for each chip and the same values in its JSON"
        " description. Points are in the order of their ids; the chips of a point are contiguous.",
        "content": {NPZ: {}, TIFF: {}},
        "headers": FILE_HEADER,
    }
}


def _parsed_ids(value: Any) -> Any:
    """Whole numbers of the texts of a query; other values are left to the check of the type."""
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        return value
    parts = [part.strip() for text in value for part in text.split(",")]
    if not all(part.isdecimal() and len(part) < 20 for part in parts):
        text = ",".join(value)
        raise InvalidParameter(f"ids: {text!r:.60} found, whole numbers separated by commas expected")
    return [int(part) for part in parts]


class ChipsQuery(FeatureFilter):
    """Which points: by their ids, or by a filter."""

    ids: Annotated[tuple[int, ...] | None, BeforeValidator(_parsed_ids)] = Field(
        default=None, min_length=1, description="Ids of points, separated by commas in a URL."
    )
    f: StackFormat = Field(default="npz", description="npz: a NumPy archive; tif: a GeoTIFF of pages.")


class ChipsSearch(ChipsQuery):
    """Which points, in the body of a POST."""

    model_config = ConfigDict(extra="forbid")


@router.get(
    "/collections/points/chips",
    response_class=StreamingResponse,
    responses=ARCHIVE,
    description=f"Return the chips of points, chosen by ids, or by box, filter and time. {LIMIT_TEXT}",
)
def chips_of_points(
    *,
    request: Request,
    database: DatabaseDep,
    stored: ChipsDep,
    caller: PointsReader,
    query: Annotated[ChipsQuery, Query()],
) -> StreamingResponse:
    refuse_unknown(request, parameter_names(ChipsQuery))
    return _archive_reply(database, stored, query)


@router.post(
    "/collections/points/chips",
    response_class=StreamingResponse,
    responses=ARCHIVE,
    description=f"Return the chips of points by POST, for many ids or a long polygon. {LIMIT_TEXT}",
)
def search_chips(
    *,
    request: Request,
    database: DatabaseDep,
    stored: ChipsDep,
    caller: PointsReader,
    body: ChipsSearch,
) -> StreamingResponse:
    refuse_unknown(request, set())
    return _archive_reply(database, stored, body)


def _archive_reply(database: DatabaseDep, stored: StoredChips, query: ChipsQuery) -> StreamingResponse:
    """The archive; the first piece is read before the reply begins: missing chips are then an error."""
    pieces = _reporting(database, points.stream_chips(_points(database, query), stored, query.f))
    first = next(pieces)
    disposition = {"Content-Disposition": f'attachment; filename="chips.{query.f}"'}
    return StreamingResponse(
        chain((first,), pieces), media_type=MEDIA_TYPES[query.f], headers=disposition
    )


def _reporting(database: DatabaseDep, pieces: Iterator[bytes]) -> Iterator[bytes]:
    """The same pieces; damage found once the reply has begun breaks it off and is reported too."""
    first = next(pieces)
    yield first
    try:
        yield from pieces
    except DamagedFile as damage:
        report_damage(database, damage)
        raise


def _points(database: DatabaseDep, query: ChipsQuery) -> ControlPoints:
    is_filtered = any(getattr(query, name) is not None for name in FeatureFilter.model_fields)
    if (query.ids is None) != is_filtered:
        raise InvalidParameter("ids: either ids or one of bbox, filter, intersects, datetime expected")
    with database.reading() as connection:
        if query.ids is not None:
            return points.points_of_ids(connection, query.ids)
        return points.points_of_filter(connection, query)
