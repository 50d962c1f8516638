"""Control points: one point with its views, and its chips."""

import json
from datetime import date
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response

from amers.app.api.conditions import tag_of
from amers.app.api.deps import ChipsDep, DatabaseDep, PointsReader
from amers.app.api.features import CrsUri, Format
from amers.app.api.models.features import PointWithViews
from amers.app.api.negotiation import (
    CRS_HEADER,
    FILE_HEADER,
    GEOJSON,
    HTML,
    JSON,
    NPZ,
    TAG_HEADER,
    TIFF,
    GeoJsonResponse,
    chosen_format,
    described,
    refuse_unknown,
)
from amers.app.api.paths import PathNumber
from amers.app.api.point_page import point_page
from amers.app.api.routes import CallerRoute
from amers.app.db.features.collection import Viewer
from amers.app.db.features.instants import format_moment
from amers.app.db.point_detail import PointDetail, PointView
from amers.app.db.points import POINTS
from amers.app.usecases.features import points
from amers.app.usecases.features.items import find_feature
from amers.services.formats.chips.images import (
    format_chip_png,
    format_chip_tiff,
    format_chips_npz,
    format_sheet_png,
)
from amers.services.quality.accuracy_statement import accuracy_document

router = APIRouter(prefix="/collections/points/items", tags=["points"], route_class=CallerRoute)

PNG = "image/png"
CHIPS_NEVER_CHANGE = {"Cache-Control": "private, max-age=86400"}
NOT_PROPERTIES = {
    "id",
    "lon_deg",
    "lat_deg",
    "height_m",
    "chip_key",
    "chip_row",
    "chip_count",
    "frame",
    "history",
}


@router.get(
    "/{point_id}",
    response_class=GeoJsonResponse,
    responses=described(PointWithViews, HTML, headers=CRS_HEADER),
)
def item(
    *,
    point_id: PathNumber,
    request: Request,
    database: DatabaseDep,
    caller: PointsReader,
    crs: CrsUri = None,
    f: Format = None,
) -> Response:
    """Return one point with its views, their images, and its history in registrations."""
    refuse_unknown(request, {"crs", "f"})
    reply_crs = POINTS.storage_crs
    with database.reading() as connection:
        point = points.find_point(connection, point_id)
        feature = _feature(point, str(request.url.replace(query="")))
        if crs is not None:
            text, reply_crs = find_feature(connection, POINTS, Viewer(), str(point_id), crs)
            feature["geometry"] = json.loads(text)["geometry"]
    if chosen_format(request, {"json": GEOJSON, "html": HTML}, f) == "html":
        return point_page(request, point)
    text = json.dumps(feature, default=_plain)
    return Response(text, media_type=GEOJSON, headers={"Content-Crs": f"<{reply_crs.uri}>"})


@router.get(
    "/{point_id}/chips",
    response_class=Response,
    responses={
        200: {
            "description": "The chips.",
            "content": {NPZ: {}, PNG: {}},
            "headers": FILE_HEADER | TAG_HEADER,
        }
    },
)
def chips(
    *,
    point_id: PathNumber,
    database: DatabaseDep,
    stored: ChipsDep,
    caller: PointsReader,
    f: Annotated[
        Literal["npz", "png"], Query(description="npz: raw values; png: all chips on one sheet.")
    ] = "npz",
) -> Response:
    """Return all chips of a point: raw values with their metadata, or a sheet to look at."""
    with database.reading() as connection:
        point = points.find_point(connection, point_id)
    labelled = points.read_chips(stored, point)
    if f == "png":
        return _chip_reply(format_sheet_png(labelled), PNG)
    return _chip_reply(format_chips_npz(labelled), NPZ, f"{point_id}.npz")


@router.get(
    "/{point_id}/chips/{view}",
    response_class=Response,
    responses={
        200: {
            "description": "A chip.",
            "content": {PNG: {}, TIFF: {}, NPZ: {}},
            "headers": FILE_HEADER | TAG_HEADER,
        }
    },
)
def chip(
    *,
    point_id: PathNumber,
    view: PathNumber,
    database: DatabaseDep,
    stored: ChipsDep,
    caller: PointsReader,
    f: Annotated[
        Literal["png", "tif", "npz"],
        Query(description="png: stretched; tif: GeoTIFF of raw values; npz: raw values."),
    ] = "png",
) -> Response:
    """Return one chip: stretched to look at, or its raw values."""
    with database.reading() as connection:
        point = points.find_point(connection, point_id)
    labelled = points.read_chip(stored, point, view)
    if f == "png":
        return _chip_reply(format_chip_png(labelled.chips[0]), PNG)
    if f == "npz":
        return _chip_reply(format_chips_npz(labelled), NPZ, f"{point_id}_{view}.npz")
    tiff = format_chip_tiff(labelled.chips[0], labelled.lon_lat_h, float(labelled.gsd_m[0]))
    return _chip_reply(tiff, TIFF, f"{point_id}_{view}.tif")


def _chip_reply(content: bytes, kind: str, name: str | None = None) -> Response:
    """Chips as they are shown, or as a file with a name; the same chips have the same tag for ever."""
    headers = {**CHIPS_NEVER_CHANGE, "ETag": tag_of(content)}
    if name is not None:
        headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return Response(content, media_type=kind, headers=headers)


def _feature(point: PointDetail, url: str) -> dict[str, Any]:
    members = {**vars(point), **vars(point.history)}
    return {
        "type": "Feature",
        "id": point.id,
        "geometry": {"type": "Point", "coordinates": [point.lon_deg, point.lat_deg, point.height_m]},
        "properties": {k: v for k, v in members.items() if k not in NOT_PROPERTIES}
        | accuracy_document(points.point_accuracy(point)),
        "links": [
            {"rel": "self", "href": url, "type": GEOJSON},
            {"rel": "alternate", "href": f"{url}?f=html", "type": HTML},
            {"rel": "collection", "href": url.rsplit("/items/", 1)[0], "type": JSON},
        ],
    }


def _plain(value: date | PointView) -> Any:
    """Dates, times and views as values that JSON has."""
    return format_moment(value) if isinstance(value, date) else vars(value)
