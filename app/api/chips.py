"""The chips of many points at once, for clients that match by themselves."""

from itertools import chain
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Field

from app.api.deps import ChipsDep, DatabaseDep, PointsReader
from app.api.negotiation import NPZ, TIFF, refuse_unknown
from app.errors import InvalidParameter
from app.storage import StoredChips
from app.usecases.features import points
from app.usecases.features.points import MOST_POINTS_WITH_CHIPS, StackFormat
from app.usecases.features.query import FeatureQuery
from services.types import ControlPoints

router = APIRouter(tags=["points"])

PARAMETERS = {"ids", "bbox", "filter", "datetime", "f"}
TYPES: dict[StackFormat, str] = {"npz": NPZ, "tif": TIFF}
MEANS = f"Chips of at most {MOST_POINTS_WITH_CHIPS:,} points are given at once."
ARCHIVE: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "npz: a NumPy archive. `chips` is (n, 101, 101) of raw values, 0 is nodata; all"
        " other arrays have a row for each chip: `point_id`, `view`, `lon_lat_h` of the point, `gsd_m`,"
        " `incidence_deg`, `azimuth_deg`, `image_id`, `sensor`, `acquired_at`, `sun_elevation_deg`,"
        " `sun_azimuth_deg`. tif: a GeoTIFF with a page for each chip, described by the same in JSON."
        " Chips of a point follow each other, points are in the order of their ids.",
        "content": {NPZ: {}, TIFF: {}},
    }
}


class ChipsAsked(BaseModel):
    """Which points: by their ids, or by what `items` is asked with and a polygon."""

    model_config = ConfigDict(extra="forbid")

    ids: list[int] | None = Field(None, min_length=1)
    intersects: dict[str, Any] | None = Field(
        None, description="GeoJSON geometry, longitude and latitude: a footprint."
    )
    bbox: str | None = None
    filter: str | dict[str, Any] | None = None
    datetime: str | None = None
    f: StackFormat = "npz"


@router.get(
    "/collections/points/chips",
    response_class=StreamingResponse,
    responses=ARCHIVE,
    description=f"The chips of points named by their ids, or by box, filter and time. {MEANS}",
)
def chips_of_points(
    request: Request,
    database: DatabaseDep,
    stored: ChipsDep,
    caller: PointsReader,
    ids: Annotated[str | None, Query(description="Ids, separated by commas.")] = None,
    bbox: Annotated[str | None, Query(description="W,S,E,N, as for items.")] = None,
    filter: Annotated[str | None, Query(description="CQL2 text.")] = None,
    datetime: Annotated[str | None, Query(description="A time, or FROM/TO.")] = None,
    f: Annotated[StackFormat, Query(description="tif: a page for each chip.")] = "npz",
) -> StreamingResponse:
    refuse_unknown(request, PARAMETERS)
    asked = ChipsAsked(
        ids=_parse_ids(ids), bbox=bbox, filter=filter, datetime=datetime, intersects=None, f=f
    )
    return _archive(database, stored, asked)


@router.post(
    "/collections/points/chips",
    response_class=StreamingResponse,
    responses=ARCHIVE,
    description=f"The same by POST: for many ids, and for a polygon. {MEANS}",
)
def search_chips(
    request: Request, database: DatabaseDep, stored: ChipsDep, caller: PointsReader, body: ChipsAsked
) -> StreamingResponse:
    refuse_unknown(request, set())
    return _archive(database, stored, body)


def _archive(database: DatabaseDep, stored: StoredChips, asked: ChipsAsked) -> StreamingResponse:
    """The first piece is read before the reply begins, so that chips that are not there are an error."""
    pieces = points.stream_chips(_meant(database, asked), stored, asked.f)
    first = next(pieces)
    disposition = {"Content-Disposition": f'attachment; filename="chips.{asked.f}"'}
    return StreamingResponse(chain((first,), pieces), media_type=TYPES[asked.f], headers=disposition)


def _meant(database: DatabaseDep, asked: ChipsAsked) -> ControlPoints:
    by_question = asked.model_dump(exclude={"ids", "f"}, exclude_none=True)
    if (asked.ids is None) == (not by_question):
        raise InvalidParameter("ids: either ids or one of bbox, filter, intersects, datetime expected")
    with database.reading() as connection:
        if asked.ids is not None:
            return points.points_of_ids(connection, asked.ids)
        return points.points_of_question(connection, FeatureQuery(**by_question))


def _parse_ids(text: str | None) -> list[int] | None:
    if text is None:
        return None
    parts = text.split(",")
    if not all(part.strip().isdecimal() and len(part) < 20 for part in parts):
        raise InvalidParameter(f"ids: {text!r:.60} found, whole numbers separated by commas expected")
    return [int(part) for part in parts]
