"""The collections of the service and what can be asked of each, as OGC API - Features has it."""

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse

from app.api import stac
from app.api.deps import DatabaseDep, PointsReader, SettingsDep
from app.api.features import CollectionDep, Format, ViewerDep, viewer_of
from app.api.json_schemas import document_of, geometry_schema, property_schema
from app.api.negotiation import (
    DOCUMENTS,
    FEATURES,
    GEOJSON,
    HTML,
    JSON,
    SCHEMA_JSON,
    chosen_format,
    refuse_unknown,
)
from app.api.pages import Cell, document_page, drawn
from app.db.engine import Connection
from app.db.features.collection import Collection, Viewer
from app.errors import NotAllowed
from app.usecases.features import items
from app.usecases.features.tiles import TILED

router = APIRouter(tags=["collections"])

REL = "http://www.opengis.net/def/rel/ogc/1.0"


@router.get("/collections", response_class=Response, responses=document_of("Collections"))
def collections(
    request: Request,
    database: DatabaseDep,
    caller: PointsReader,
    settings: SettingsDep,
    f: Format = None,
) -> Response:
    """The collections the caller may see."""
    refuse_unknown(request, {"f"})
    seen = []
    for collection in items.COLLECTIONS.values():
        try:
            seen.append((collection, viewer_of(collection, caller, settings)))
        except NotAllowed:
            continue
    with database.reading() as connection:
        described = [describe(request, connection, *one) for one in seen]
    document = {"links": _self_links(request, "collections"), "collections": described}
    if chosen_format(request, DOCUMENTS, f) == "json":
        return JSONResponse(document)
    rows = [
        [
            Cell(collection.title, f"{request.base_url}collections/{collection.id}?f=html"),
            Cell(collection.description),
        ]
        for collection, _ in seen
    ]
    return document_page(
        request, "Collections", "", document["links"], ("collection", "what it holds"), rows
    )


@router.get("/collections/{collection}", response_class=Response, responses=document_of("Collection"))
def one_collection(
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
    f: Format = None,
) -> Response:
    """One collection."""
    refuse_unknown(request, {"f"})
    with database.reading() as connection:
        document = describe(request, connection, collection, viewer)
    if chosen_format(request, DOCUMENTS, f) == "json":
        return JSONResponse(document)
    box = document.get("extent", {}).get("spatial", {}).get("bbox", [None])[0]
    rows = [
        [Cell(item.name), Cell(item.title), Cell(item.type), Cell(item.unit)]
        for item in collection.queryables.values()
    ]
    return document_page(
        request,
        collection.title,
        collection.description,
        document["links"],
        ("property", "what it is", "type", "unit"),
        rows,
        drawn([] if box is None else [_rectangle(box)]),
    )


@router.get(
    "/collections/{collection}/queryables",
    response_class=Response,
    responses=document_of("JsonSchema", SCHEMA_JSON),
)
def queryables(
    request: Request, collection: CollectionDep, viewer: ViewerDep, f: Format = None
) -> Response:
    """What a filter may name, as a JSON Schema."""
    members = {item.name: property_schema(item) for item in collection.queryables.values()}
    members["geometry"] = geometry_schema(collection)
    return _schema_reply(request, collection, "queryables", members, f)


@router.get(
    "/collections/{collection}/sortables",
    response_class=Response,
    responses=document_of("JsonSchema", SCHEMA_JSON),
)
def sortables(
    request: Request, collection: CollectionDep, viewer: ViewerDep, f: Format = None
) -> Response:
    """What features can be sorted by, as a JSON Schema."""
    members = {item.name: property_schema(item) for item in collection.queryables.values()}
    return _schema_reply(request, collection, "sortables", members, f)


@router.get(
    "/collections/{collection}/schema",
    response_class=Response,
    responses=document_of("JsonSchema", SCHEMA_JSON),
)
def schema(request: Request, collection: CollectionDep, viewer: ViewerDep, f: Format = None) -> Response:
    """The properties of a feature, as a JSON Schema with the roles of OGC API - Features - Part 5."""
    members: dict[str, Any] = {}
    for item in collection.queryables.values():
        members[item.name] = property_schema(item)
    members[collection.key.name]["x-ogc-role"] = "id"
    if collection.interval and collection.interval[0] != collection.interval[1]:
        for name, end in zip(collection.interval, ("start", "end"), strict=True):
            members[name]["x-ogc-role"] = f"primary-interval-{end}"
    elif collection.interval:
        members[collection.interval[0]]["x-ogc-role"] = "primary-instant"
    members["geometry"] = {**geometry_schema(collection), "x-ogc-role": "primary-geometry"}
    return _schema_reply(request, collection, "schema", members, f)


def describe(
    request: Request, connection: Connection, collection: Collection, viewer: Viewer
) -> dict[str, Any]:
    """A collection as OGC API - Features describes it."""
    box = items.extent(connection, collection, viewer)
    # STAC calls for an extent even where nothing is.
    spatial = {"bbox": [box or WORLD], "crs": _CRS84}
    period = items.period(connection, collection, viewer)
    temporal = {"interval": [[None if time is None else time.isoformat() for time in period]]}
    path = f"collections/{collection.id}"
    here = f"{request.base_url}{path}"
    links = [
        *_self_links(request, path),
        *(
            # Clients of STAC append ids to the first of them.
            {
                "rel": "items",
                "href": f"{here}/items" if name == "json" else f"{here}/items?f={name}",
                "type": kind,
                "title": f"Items, {name}",
            }
            for name, kind in {"json": GEOJSON, **FEATURES}.items()
        ),
        {"rel": "root", "href": str(request.base_url), "type": JSON},
        {"rel": "parent", "href": str(request.base_url), "type": JSON},
        {"rel": "describedby", "href": f"{here}/schema", "type": SCHEMA_JSON},
        {"rel": f"{REL}/schema", "href": f"{here}/schema", "type": SCHEMA_JSON},
        {"rel": f"{REL}/queryables", "href": f"{here}/queryables", "type": SCHEMA_JSON},
        {"rel": f"{REL}/sortables", "href": f"{here}/sortables", "type": SCHEMA_JSON},
    ]
    if collection.id in TILED:
        links.append({"rel": f"{REL}/tilesets-vector", "href": f"{here}/tiles", "type": JSON})
    return {
        "id": collection.id,
        "title": collection.title,
        "description": collection.description,
        "itemType": "feature",
        "crs": [crs.uri for crs in collection.crs],
        "storageCrs": collection.storage_crs.uri,
        **stac.COLLECTION_MEMBERS,
        "extent": {"spatial": spatial, "temporal": temporal},
        "links": links,
    }


WORLD = (-180.0, -90.0, 180.0, 90.0)
_CRS84 = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"


def _self_links(request: Request, path: str) -> list[dict[str, str]]:
    href = f"{request.base_url}{path}"
    return [
        {"rel": "self", "href": href, "type": JSON, "title": "this document"},
        {"rel": "alternate", "href": f"{href}?f=html", "type": HTML, "title": "this document"},
    ]


def _schema_reply(
    request: Request, collection: Collection, name: str, members: dict[str, Any], f: str | None
) -> Response:
    refuse_unknown(request, {"f"})
    path = f"collections/{collection.id}/{name}"
    if chosen_format(request, {"json": SCHEMA_JSON, "html": HTML}, f) == "html":
        rows = [
            [Cell(key), Cell(value.get("title", "")), Cell(value.get("type", value.get("format", "")))]
            for key, value in members.items()
        ]
        links = _self_links(request, path)
        title = f"{collection.title}: {name}"
        return document_page(request, title, "", links, ("property", "what it is", "type"), rows)
    document = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"{request.base_url}{path}",
        "type": "object",
        "title": collection.title,
        "properties": members,
        "additionalProperties": False,
    }
    return JSONResponse(document, media_type=SCHEMA_JSON)


def _rectangle(box: list[float]) -> dict[str, Any]:
    west, south, east, north = box
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    return {"type": "Polygon", "coordinates": [ring]}
