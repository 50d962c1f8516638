"""The collections of the service, and the schemas of their properties (OGC API - Features)."""

from typing import Any

from fastapi import APIRouter, Request, Response

from amers.app.api import stac
from amers.app.api.deps import DatabaseDep, PointsReader, SettingsDep
from amers.app.api.features import CollectionDep, Format, ViewerDep, viewer_of
from amers.app.api.json_schemas import geometry_schema, property_schema
from amers.app.api.models.base import Link
from amers.app.api.models.documents import (
    CollectionDescription,
    Collections,
    Extent,
    JsonSchema,
    SpatialExtent,
    TemporalExtent,
)
from amers.app.api.negotiation import (
    DOCUMENTS,
    FEATURES,
    GEOJSON,
    HTML,
    JSON,
    SCHEMA_JSON,
    SchemaResponse,
    chosen_format,
    described,
    json_reply,
    refuse_unknown,
)
from amers.app.api.pages import Cell, Page, document_page, drawn
from amers.app.api.routes import CallerRoute
from amers.app.db.engine import Connection
from amers.app.db.features.collection import Collection, Viewer
from amers.app.db.features.crs import CRS84
from amers.app.db.features.instants import format_moment
from amers.app.errors import NotAllowed
from amers.app.usecases.features import items
from amers.app.usecases.features.tiles import TILED

router = APIRouter(tags=["collections"], route_class=CallerRoute)

REL = "http://www.opengis.net/def/rel/ogc/1.0"
WORLD = (-180.0, -90.0, 180.0, 90.0)


@router.get("/collections", response_class=Response, responses=described(Collections, HTML))
def collections(
    *,
    request: Request,
    database: DatabaseDep,
    caller: PointsReader,
    settings: SettingsDep,
    f: Format = None,
) -> Response:
    """List the collections that the caller may read."""
    refuse_unknown(request, {"f"})
    readable = []
    for collection in items.COLLECTIONS.values():
        try:
            readable.append((collection, viewer_of(collection, caller, settings)))
        except NotAllowed:
            continue
    links = _self_links(request, "collections")
    links.append(Link(rel="root", href=str(request.base_url), type=JSON, title="the service"))
    if chosen_format(request, DOCUMENTS, f) == "json":
        with database.reading() as connection:
            listed = [describe(request, connection, *pair) for pair in readable]
        return json_reply(Collections(links=links, collections=listed))
    rows = [
        [
            Cell(collection.title, f"{request.base_url}collections/{collection.id}?f=html"),
            Cell(collection.description),
        ]
        for collection, _ in readable
    ]
    columns = ("collection", "description")
    return document_page(request, Page("Collections", links=links, columns=columns, rows=rows))


@router.get(
    "/collections/{collection}",
    response_class=Response,
    responses=described(CollectionDescription, HTML),
)
def one_collection(
    *,
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
    f: Format = None,
) -> Response:
    """Return one collection."""
    refuse_unknown(request, {"f"})
    with database.reading() as connection:
        document = describe(request, connection, collection, viewer)
    if chosen_format(request, DOCUMENTS, f) == "json":
        return json_reply(document)
    page = Page(
        collection.title,
        collection.description,
        document.links,
        columns=("property", "title", "type", "unit"),
        rows=[
            [Cell(item.name), Cell(item.title), Cell(item.type), Cell(item.unit)]
            for item in collection.columns.values()
        ],
        drawing=drawn([_rectangle(document.extent.spatial.bbox[0])]),
    )
    return document_page(request, page)


@router.get(
    "/collections/{collection}/queryables",
    response_class=SchemaResponse,
    responses=described(JsonSchema, HTML),
)
def queryables(
    *, request: Request, collection: CollectionDep, viewer: ViewerDep, f: Format = None
) -> Response:
    """Return the properties that a filter may name, as a JSON Schema."""
    members = {item.name: property_schema(item) for item in collection.queryables.values()}
    members["geometry"] = geometry_schema(collection)
    return _schema_reply(request, collection, "queryables", members, f)


@router.get(
    "/collections/{collection}/sortables",
    response_class=SchemaResponse,
    responses=described(JsonSchema, HTML),
)
def sortables(
    *, request: Request, collection: CollectionDep, viewer: ViewerDep, f: Format = None
) -> Response:
    """Return the properties that features can be sorted by, as a JSON Schema."""
    members = {item.name: property_schema(item) for item in collection.columns.values()}
    return _schema_reply(request, collection, "sortables", members, f)


@router.get(
    "/collections/{collection}/schema",
    response_class=SchemaResponse,
    responses=described(JsonSchema, HTML),
)
def schema(
    *, request: Request, collection: CollectionDep, viewer: ViewerDep, f: Format = None
) -> Response:
    """Return the properties of a feature and their roles, as a JSON Schema (Features - Part 5)."""
    members: dict[str, Any] = {}
    for item in collection.columns.values():
        members[item.name] = property_schema(item)
    members[collection.key.name]["x-ogc-role"] = "id"
    if collection.interval and collection.interval[0] != collection.interval[1]:
        for name, end in zip(collection.interval, ("start", "end"), strict=True):
            members[name]["x-ogc-role"] = f"primary-interval-{end}"
    elif collection.interval:
        members[collection.interval[0]]["x-ogc-role"] = "primary-instant"
    members["geometry"] = {**geometry_schema(collection), "x-ogc-role": "primary-geometry"}
    # A property that is not required may be unknown: null in GeoJSON and in files, nothing in CSV.
    required = [item.name for item in collection.columns.values() if not item.nullable]
    required += [] if collection.geometry_nullable else ["geometry"]
    return _schema_reply(request, collection, "schema", members, f, required=required)


def describe(
    request: Request, connection: Connection, collection: Collection, viewer: Viewer
) -> CollectionDescription:
    """A collection as OGC API - Features and STAC describe it."""
    box = items.extent(connection, collection, viewer)
    period = items.period(connection, collection, viewer)
    return CollectionDescription(
        **stac.COLLECTION_MEMBERS,
        id=collection.id,
        title=collection.title,
        description=collection.description,
        item_type="feature",
        crs=[crs.uri for crs in collection.crs],
        storage_crs=collection.storage_crs.uri,
        extent=Extent(
            # STAC requires an extent even for a collection without features.
            spatial=SpatialExtent(bbox=[list(box or WORLD)], crs=CRS84.uri),
            temporal=TemporalExtent(
                interval=[[None if time is None else format_moment(time) for time in period]]
            ),
        ),
        links=_collection_links(request, collection),
    )


def _collection_links(request: Request, collection: Collection) -> list[Link]:
    base, path = str(request.base_url), f"collections/{collection.id}"
    here = f"{base}{path}"
    links = [
        *_self_links(request, path),
        # STAC clients append ids to the first of these links: it needs to be without a query.
        Link(rel="items", href=f"{here}/items", type=GEOJSON, title="Items, json"),
        *(
            Link(rel="items", href=f"{here}/items?f={name}", type=media_type, title=f"Items, {name}")
            for name, media_type in FEATURES.items()
            if name != "json"
        ),
        Link(rel="root", href=base, type=JSON, title="the service"),
        Link(rel="parent", href=base, type=JSON, title="the service"),
        Link(rel="describedby", href=f"{here}/schema", type=SCHEMA_JSON, title="schema"),
        *(
            Link(rel=f"{REL}/{name}", href=f"{here}/{name}", type=SCHEMA_JSON, title=name)
            for name in ("schema", "queryables", "sortables")
        ),
    ]
    if collection.id in TILED:
        links.append(Link(rel=f"{REL}/tilesets-vector", href=f"{here}/tiles", type=JSON, title="tiles"))
    return links


def _self_links(request: Request, path: str) -> list[Link]:
    href = f"{request.base_url}{path}"
    return [
        Link(rel="self", href=href, type=JSON, title="this document"),
        Link(rel="alternate", href=f"{href}?f=html", type=HTML, title="this document"),
    ]


def _schema_reply(
    request: Request,
    collection: Collection,
    name: str,
    members: dict[str, Any],
    f: str | None,
    *,
    required: list[str] | None = None,
) -> Response:
    refuse_unknown(request, {"f"})
    path = f"collections/{collection.id}/{name}"
    if chosen_format(request, {"json": SCHEMA_JSON, "html": HTML}, f) == "html":
        page = Page(
            f"{collection.title}: {name}",
            links=_self_links(request, path),
            columns=("property", "title", "type"),
            rows=[
                [
                    Cell(key),
                    Cell(value.get("title", "")),
                    Cell(value.get("type", value.get("format", ""))),
                ]
                for key, value in members.items()
            ],
        )
        return document_page(request, page)
    document = JsonSchema(
        schema_uri="https://json-schema.org/draft/2020-12/schema",
        id=f"{request.base_url}{path}",
        type="object",
        title=collection.title,
        properties=members,
        required=required,
        additional_properties=False,
    )
    return json_reply(document, SCHEMA_JSON)


def _rectangle(box: list[float]) -> dict[str, Any]:
    west, south, east, north = box
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    return {"type": "Polygon", "coordinates": [ring]}
