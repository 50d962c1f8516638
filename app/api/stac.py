"""STAC API: scenes as items, one by one, by pages, and by search.

Source: STAC API 1.0.0 (core, collections, ogcapi-features, item-search; filter and sort of item-search).
"""

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    WithJsonSchema,
    field_validator,
)

from amers.app.api import features
from amers.app.api.access import needs
from amers.app.api.deps import CallerDep, DatabaseDep, SecretDep, SettingsDep
from amers.app.api.features import (
    CrsUri,
    Format,
    ItemsQuery,
    equal_parameters,
    parameter_names,
    viewer_of,
)
from amers.app.api.models.base import Link
from amers.app.api.models.features import StacItem, StacItems
from amers.app.api.negotiation import (
    CRS_HEADER,
    FEATURES,
    GEOJSON,
    HTML,
    JSON,
    SCHEMA_JSON,
    GeoJsonResponse,
    chosen_format,
    described,
    refuse_unknown,
)
from amers.app.api.processes import inlined
from amers.app.api.routes import CallerRoute
from amers.app.auth import Scope
from amers.app.db.engine import Database
from amers.app.db.features.collection import Viewer
from amers.app.db.features.instants import parse_interval
from amers.app.db.features.outlines import SCENES
from amers.app.errors import InvalidParameter
from amers.app.usecases.features import items as all_features
from amers.app.usecases.features import stac
from amers.app.usecases.features.query import (
    Bbox,
    FeatureQuery,
    ResolvedQuery,
    Restriction,
    crs_of,
    resolve,
)

router = APIRouter(tags=["stac"], route_class=CallerRoute)

API = "https://api.stacspec.org/v1.0.0/"
CONFORMS_TO = (
    *(f"{API}{name}" for name in ("core", "collections", "ogcapi-features", "item-search")),
    f"{API}item-search#filter",
    f"{API}item-search#sort",
)
SEARCH_LINKS = (
    Link(rel="root", href="", type=JSON, title="this document"),
    Link(rel="child", href=f"collections/{stac.COLLECTION}", type=JSON, title="Scenes"),
    Link(
        rel="http://www.opengis.net/def/rel/ogc/1.0/queryables",
        href=f"collections/{stac.COLLECTION}/queryables",
        type=SCHEMA_JSON,
        title="properties that a filter of the search may name",
    ),
    Link(rel="search", href="search", type=GEOJSON, title="search of scenes", method="GET"),
    Link(rel="search", href="search", type=GEOJSON, title="search of scenes", method="POST"),
)
LANDING_MEMBERS: dict[str, Any] = {"type": "Catalog", "stac_version": stac.VERSION, "id": "amers"}
COLLECTION_MEMBERS: dict[str, Any] = {
    "type": "Collection",
    "stac_version": stac.VERSION,
    "license": "other",
}
ITEMS = described(StacItems, headers=CRS_HEADER)


def landing_links(base: str) -> list[Link]:
    """The links of a STAC catalog with search, below the address of the service."""
    return [link.model_copy(update={"href": base + link.href}) for link in SEARCH_LINKS]


def _split(value: Any) -> Any:
    """The parts of texts with commas in a query; other values are left to the check of the type."""
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        return value
    return [part for text in value for part in text.split(",") if part]


class SortedBy(BaseModel):
    """A property to sort by."""

    model_config = ConfigDict(extra="forbid")

    field: str
    direction: str = Field("asc", pattern="^(asc|desc)$")

    @property
    def text(self) -> str:
        """The same as the parameter `sortby` has it."""
        return ("-" if self.direction == "desc" else "") + self.field.removeprefix("properties.")


def _without_prefix(value: Any) -> Any:
    """The text of `sortby`, where names may begin with `properties.`."""
    return value.replace("properties.", "") if isinstance(value, str) else value


def _sort_text(value: Any) -> Any:
    """A list of properties to sort by, as the parameter `sortby` has it."""
    if not isinstance(value, list):
        return value
    return ",".join(SortedBy.model_validate(item).text for item in value) or None


Names = Annotated[tuple[str, ...], BeforeValidator(_split)]
SORTED_BY = WithJsonSchema({"type": "array", "items": SortedBy.model_json_schema()})


class SceneRestriction(BaseModel):
    """Scenes by their ids; searches over other collections find none."""

    ids: Names | None = Field(default=None, description="Ids of scenes, separated by commas in a URL.")
    collections: Names | None = Field(
        default=None, description="Ids of collections, separated by commas in a URL."
    )

    @property
    def restriction(self) -> Restriction:
        """The ids to look for: none if only other collections are searched."""
        if self.collections and stac.COLLECTION not in self.collections:
            return Restriction(ids=())
        return Restriction(ids=self.ids)


class SceneItemsQuery(SceneRestriction, ItemsQuery):
    """The parameters of a page of scenes."""


class SceneSearch(SceneRestriction, FeatureQuery):
    """The parameters of a search; STAC items have all properties, in longitude and latitude."""

    crs: None = None
    properties: None = None
    sortby: Annotated[str | None, BeforeValidator(_without_prefix)] = Field(
        default=None, description="Properties to sort by; `-` before one sorts it descending."
    )
    bbox: Bbox | None = Field(
        default=None,
        description="Box W,S,E,N; only scenes that have an outline, and that meets the box.",
    )

    @property
    def restriction(self) -> Restriction:
        """As of any request; a scene without an outline is in no box, as clients of STAC expect."""
        return replace(super().restriction, has_geometry=self.bbox is not None)


NOT_SEARCHED = {"crs", "properties"}


class SceneSearchBody(SceneSearch):
    """The parameters of a search in the body of a POST."""

    model_config = ConfigDict(extra="forbid")

    sortby: Annotated[str | None, BeforeValidator(_sort_text), SORTED_BY] = Field(
        default=None, description="Properties to sort by."
    )

    @field_validator("bbox", "intersects", "sortby", mode="before")
    @classmethod
    def _refuse_text(cls, value: Any) -> Any:
        if isinstance(value, str):
            raise ValueError("text found, a JSON value expected")
        return value


def _check_instants(interval: str | None) -> None:
    """Refuse what STAC search refuses: dates without a time of day, and an interval without any end.

    Raises:
        InvalidParameter: the interval is one of these; the message names it.
    """
    ends = (None, datetime.min) if interval is None else parse_interval(interval)
    if ends == (None, None) or any(end is not None and not isinstance(end, datetime) for end in ends):
        raise InvalidParameter(
            f"datetime: {interval!r:.100} found; STAC search expects instants, such as"
            " 2024-05-06T00:00:00Z/2024-05-06T23:59:59Z, and one known end at least"
        )


@needs(Scope.REGISTER)
async def _scenes_viewer(caller: CallerDep, settings: SettingsDep) -> Viewer:
    return viewer_of(SCENES, caller, settings)


def _search_schema() -> dict[str, Any]:
    """The JSON Schema of a search, for the description of the API."""
    schema = SceneSearchBody.model_json_schema()
    for name in NOT_SEARCHED:
        del schema["properties"][name]
    described: dict[str, Any] = inlined(schema, schema.pop("$defs", {}))
    return described


ViewerDep = Annotated[Viewer, Depends(_scenes_viewer)]
NextLink = Callable[[str], dict[str, Any]]


@router.get("/search", response_class=GeoJsonResponse, responses=ITEMS)
def search(
    *,
    request: Request,
    viewer: ViewerDep,
    database: DatabaseDep,
    secret: SecretDep,
    query: Annotated[SceneSearch, Query()],
) -> Response:
    """Return a page of the scenes that meet the parameters, as STAC items."""
    refuse_unknown(request, parameter_names(SceneSearch) - NOT_SEARCHED)
    _check_instants(query.datetime)
    resolved = _resolved(viewer, query, secret, query.restriction)
    return _page_reply(request, database, secret, resolved, _next_of_query(request))


@router.post(
    "/search",
    response_class=GeoJsonResponse,
    responses=ITEMS,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {JSON: {"schema": _search_schema()}},
        }
    },
)
def search_by_post(
    *,
    request: Request,
    viewer: ViewerDep,
    database: DatabaseDep,
    secret: SecretDep,
    body: dict[str, Any],
) -> Response:
    """Return a page of the scenes that meet the parameters in the body, as STAC items."""
    refuse_unknown(request, set())
    try:
        query = SceneSearchBody.model_validate(body)
    except ValidationError as error:
        wrong = (f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())
        raise InvalidParameter("; ".join(wrong)) from None
    _check_instants(query.datetime)

    def next_link(token: str) -> dict[str, Any]:
        return {"href": str(request.url), "method": "POST", "body": {**body, "token": token}}

    resolved = _resolved(viewer, query, secret, query.restriction)
    return _page_reply(request, database, secret, resolved, next_link)


@router.get("/collections/scenes/items", response_class=Response, responses=features.PAGE)
def items(
    *,
    request: Request,
    viewer: ViewerDep,
    database: DatabaseDep,
    secret: SecretDep,
    query: Annotated[SceneItemsQuery, Query()],
) -> Response:
    """Return a page of scenes: STAC items, or features in another format."""
    is_plain = not _is_in_longitude_latitude(query.crs) or query.properties is not None
    if is_plain or chosen_format(request, FEATURES, query.f) != "json":
        return features.items(
            request=request,
            collection=SCENES,
            viewer=viewer,
            database=database,
            secret=secret,
            query=query,
        )
    refuse_unknown(request, parameter_names(SceneItemsQuery) | set(SCENES.queryables))
    restriction = replace(query.restriction, equal=equal_parameters(request, SCENES))
    resolved = _resolved(viewer, query, secret, restriction)
    return _page_reply(request, database, secret, resolved, _next_of_query(request))


@router.get(
    "/collections/scenes/items/{item_id}",
    response_class=GeoJsonResponse,
    responses=described(StacItem, HTML, headers=CRS_HEADER),
)
def item(
    *,
    item_id: str,
    request: Request,
    viewer: ViewerDep,
    database: DatabaseDep,
    crs: CrsUri = None,
    f: Format = None,
) -> Response:
    """Return a scene: a STAC item, or a feature in another reference system or as a page."""
    if (
        not _is_in_longitude_latitude(crs)
        or chosen_format(request, {"json": GEOJSON, "html": HTML}, f) != "json"
    ):
        return features.item(
            feature_id=item_id,
            request=request,
            collection=SCENES,
            viewer=viewer,
            database=database,
            crs=crs,
            f=f,
        )
    refuse_unknown(request, {"crs", "f"})
    with database.reading() as connection:
        text, reply_crs = all_features.find_feature(connection, SCENES, viewer, item_id, None)
        items = stac.stac_items(connection, text.encode(), str(request.base_url))
    headers = {"Content-Crs": f"<{reply_crs.uri}>"}
    return GeoJsonResponse(items[0], headers=headers)


def _is_in_longitude_latitude(crs: str | None) -> bool:
    """Whether a reply in a reference system can be STAC, which knows this one alone."""
    return crs is None or crs_of("crs", crs, SCENES) is SCENES.storage_crs


def _resolved(
    viewer: Viewer, query: FeatureQuery, secret: bytes, restriction: Restriction
) -> ResolvedQuery:
    if query.bbox is not None and query.intersects is not None:
        raise InvalidParameter("bbox, intersects: both found, only one of them expected")
    return resolve(SCENES, viewer, query, secret, restriction)


def _page_reply(
    request: Request, database: Database, secret: bytes, query: ResolvedQuery, next_link: NextLink
) -> Response:
    """A page of STAC items with its links."""
    base = str(request.base_url)
    with database.reading() as connection:
        answer = all_features.page(connection, query, "geojson", secret)
        items = stac.stac_items(connection, answer.body, base)
    links = [
        {"rel": "self", "href": str(request.url), "type": GEOJSON},
        {"rel": "root", "href": base, "type": JSON},
        {"rel": "collection", "href": f"{base}collections/{stac.COLLECTION}", "type": JSON},
    ]
    if request.url.path.endswith("/items"):
        html = str(request.url.include_query_params(f="html"))
        links.append({"rel": "alternate", "href": html, "type": HTML})
    if answer.next_token is not None:
        links.append({"rel": "next", "type": GEOJSON, **next_link(answer.next_token)})
    page = {
        "type": "FeatureCollection",
        "features": items,
        "numberMatched": answer.matched.number,
        "numberReturned": answer.returned,
        "links": links,
    }
    headers = {"Content-Crs": f"<{SCENES.storage_crs.uri}>"}
    return GeoJsonResponse(page, headers=headers)


def _next_of_query(request: Request) -> NextLink:
    return lambda token: {"href": str(request.url.include_query_params(token=token)), "method": "GET"}
