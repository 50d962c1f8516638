"""STAC API: scenes as items, one by one, by pages, and by search.

Source: STAC API 1.0.0 (core, collections, ogcapi-features, item-search; filter and sort of item-search).
"""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from app.api import features
from app.api.deps import CallerDep, DatabaseDep, SettingsDep
from app.api.features import PARAMETERS, CrsUri, Format, SecretDep, viewer_of
from app.api.negotiation import (
    FEATURES,
    GEOJSON,
    HTML,
    JSON,
    SCHEMA_JSON,
    chosen_format,
    refuse_unknown,
)
from app.api.processes import inlined
from app.db.engine import Database
from app.db.features.collection import Viewer
from app.db.features.outlines import SCENES
from app.errors import InvalidParameter
from app.usecases.features import items as all_features
from app.usecases.features import stac
from app.usecases.features.query import DEFAULT_LIMIT, FeatureQuery, resolve

router = APIRouter(tags=["stac"])

API = "https://api.stacspec.org/v1.0.0/"
CONFORMS_TO = (
    *(f"{API}{name}" for name in ("core", "collections", "ogcapi-features", "item-search")),
    f"{API}item-search#filter",
    f"{API}item-search#sort",
)
SEARCH_LINKS = (
    {"rel": "root", "path": "", "type": JSON, "title": "this document"},
    {"rel": "child", "path": f"collections/{stac.COLLECTION}", "type": JSON, "title": "Scenes"},
    {
        "rel": "http://www.opengis.net/def/rel/ogc/1.0/queryables",
        "path": f"collections/{stac.COLLECTION}/queryables",
        "type": SCHEMA_JSON,
        "title": "what a search may name",
    },
    {"rel": "search", "path": "search", "type": GEOJSON, "title": "search of scenes", "method": "GET"},
    {"rel": "search", "path": "search", "type": GEOJSON, "title": "search of scenes", "method": "POST"},
)
LANDING_MEMBERS = {"type": "Catalog", "stac_version": stac.VERSION, "id": "amers"}
COLLECTION_MEMBERS = {"type": "Collection", "stac_version": stac.VERSION, "license": "other"}
SEARCHED = {"bbox", "collections", "datetime", "ids", "intersects", "limit", "sortby", "token"}
FILTERED = {"filter", "filter-lang", "filter-crs"}
ITEMS: dict[int | str, dict[str, Any]] = {200: {"description": "A page.", "content": {GEOJSON: {}}}}


def landing_links(base: str) -> list[dict[str, str]]:
    """The links of a STAC catalog that can be searched."""
    return [
        {name: value for name, value in link.items() if name != "path"} | {"href": base + link["path"]}
        for link in SEARCH_LINKS
    ]


class SortedBy(BaseModel):
    """A property to sort by."""

    model_config = ConfigDict(extra="forbid")

    field: str
    direction: str = Field("asc", pattern="^(asc|desc)$")


class ItemSearch(BaseModel):
    """The body of a search."""

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    bbox: list[float] | None = None
    intersects: dict[str, Any] | None = None
    datetime: str | None = None
    ids: list[str] | None = None
    collections: list[str] | None = None
    limit: int = Field(DEFAULT_LIMIT, ge=1)
    filter: str | dict[str, Any] | None = None
    filter_lang: str | None = Field(None, alias="filter-lang")
    filter_crs: str | None = Field(None, alias="filter-crs")
    sortby: list[SortedBy] | None = None
    token: str | None = None

    @property
    def question(self) -> FeatureQuery:
        """The same as a request for features says it."""
        return FeatureQuery(
            limit=self.limit,
            token=self.token,
            bbox=None if self.bbox is None else ",".join(map(repr, self.bbox)),
            datetime=self.datetime,
            filter=self.filter,
            filter_lang=self.filter_lang,
            filter_crs=self.filter_crs,
            sortby=None if not self.sortby else ",".join(map(_sorted_by, self.sortby)),
            intersects=self.intersects,
            ids=_wanted(self.ids, self.collections),
        )


async def _scenes_viewer(caller: CallerDep, settings: SettingsDep) -> Viewer:
    return viewer_of(SCENES, caller, settings)


def _search_schema() -> dict[str, Any]:
    """The JSON Schema of a search, for the description of the API."""
    schema = ItemSearch.model_json_schema()
    described: dict[str, Any] = inlined(schema, schema.pop("$defs", {}))
    return described


ViewerDep = Annotated[Viewer, Depends(_scenes_viewer)]
Listed = Annotated[str | None, Query(description="Separated by commas.")]


@router.get("/search", response_class=Response, responses=ITEMS)
def search(
    request: Request,
    viewer: ViewerDep,
    database: DatabaseDep,
    secret: SecretDep,
    question: Annotated[FeatureQuery, Depends(features.question_of_query)],
    ids: Listed = None,
    collections: Listed = None,
    intersects: Annotated[str | None, Query(description="A GeoJSON geometry.")] = None,
) -> Response:
    """STAC items that meet what is asked, a page of them."""
    refuse_unknown(request, SEARCHED | FILTERED)
    asked = replace(
        question,
        ids=_wanted(_listed(ids), _listed(collections)),
        intersects=None if intersects is None else _geometry(intersects),
        sortby=question.sortby and question.sortby.replace("properties.", ""),
    )
    return _page(request, database, viewer, secret, asked, _next_of_query(request))


@router.post(
    "/search",
    response_class=Response,
    responses=ITEMS,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {JSON: {"schema": _search_schema()}},
        }
    },
)
def search_by_post(
    request: Request, viewer: ViewerDep, database: DatabaseDep, secret: SecretDep, body: dict[str, Any]
) -> Response:
    """The same by POST."""
    refuse_unknown(request, set())
    try:
        asked = ItemSearch.model_validate(body)
    except ValidationError as error:
        wrong = (f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())
        raise InvalidParameter("; ".join(wrong)) from None

    def next_link(token: str) -> dict[str, Any]:
        return {"href": str(request.url), "method": "POST", "body": {**body, "token": token}}

    return _page(request, database, viewer, secret, asked.question, next_link)


@router.get("/collections/scenes/items", response_class=Response, responses=features.PAGE)
def items(
    request: Request,
    viewer: ViewerDep,
    database: DatabaseDep,
    secret: SecretDep,
    question: Annotated[FeatureQuery, Depends(features.question_of_query)],
    ids: Listed = None,
    collections: Listed = None,
    f: Format = None,
) -> Response:
    """A page of scenes: STAC items, or features in another format."""
    plain = question.crs is not None or question.properties is not None
    if plain or chosen_format(request, FEATURES, f) != "json":
        return features.items(request, SCENES, viewer, database, secret, question, f)
    refuse_unknown(request, PARAMETERS | set(SCENES.queryables) | {"ids", "collections"})
    equal = tuple(
        (name, value)
        for name, value in request.query_params.items()
        if name in SCENES.queryables and name != "datetime"
    )
    asked = replace(question, equal=equal, ids=_wanted(_listed(ids), _listed(collections)))
    return _page(request, database, viewer, secret, asked, _next_of_query(request))


@router.get(
    "/collections/scenes/items/{item_id}",
    response_class=Response,
    responses={200: {"description": "An item.", "content": {GEOJSON: {}, HTML: {}}}},
)
def item(
    item_id: str,
    request: Request,
    viewer: ViewerDep,
    database: DatabaseDep,
    crs: CrsUri = None,
    f: Format = None,
) -> Response:
    """A scene: a STAC item, or a feature in another reference system or as a page."""
    if crs is not None or chosen_format(request, {"json": GEOJSON, "html": HTML}, f) != "json":
        return features.item(item_id, request, SCENES, viewer, database, crs, f)
    refuse_unknown(request, {"crs", "f"})
    with database.reading() as connection:
        text, given = all_features.find_feature(connection, SCENES, viewer, item_id, None)
        found = stac.stac_items(connection, text.encode(), str(request.base_url))
    return JSONResponse(found[0], media_type=GEOJSON, headers={"Content-Crs": f"<{given.uri}>"})


def _page(
    request: Request,
    database: Database,
    viewer: Viewer,
    secret: bytes,
    question: FeatureQuery,
    next_link: Callable[[str], dict[str, Any]],
) -> Response:
    """Items with the links that a page has."""
    if question.bbox is not None and question.intersects is not None:
        raise InvalidParameter("bbox, intersects: only one of them can be asked for")
    asked = resolve(SCENES, viewer, question, secret)
    base = str(request.base_url)
    with database.reading() as connection:
        answer = all_features.page(connection, asked, "geojson", secret)
        found = stac.stac_items(connection, answer.body, base)
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
        "features": found,
        "numberMatched": answer.matched.number,
        "numberReturned": answer.returned,
        "links": links,
    }
    headers = {"Content-Crs": f"<{SCENES.storage_crs.uri}>"}
    return JSONResponse(page, media_type=GEOJSON, headers=headers)


def _next_of_query(request: Request) -> Callable[[str], dict[str, Any]]:
    return lambda token: {"href": str(request.url.include_query_params(token=token)), "method": "GET"}


def _listed(text: str | None) -> list[str] | None:
    return None if text is None else [part for part in text.split(",") if part]


def _wanted(ids: list[str] | None, collections: list[str] | None) -> tuple[str, ...] | None:
    """Ids to look for; none of them when only other collections are asked for."""
    if collections and stac.COLLECTION not in collections:
        return ()
    return None if ids is None else tuple(ids)


def _geometry(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        raise InvalidParameter(f"intersects: {text!r:.60} found, GeoJSON expected") from None


def _sorted_by(wanted: SortedBy) -> str:
    return ("-" if wanted.direction == "desc" else "") + wanted.field.removeprefix("properties.")
