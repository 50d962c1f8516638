"""Features of every collection: pages of items in six formats, one item, search by POST."""

import json
from collections.abc import Callable, Generator
from itertools import islice
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool

from app.api.deps import CallerDep, DatabaseDep, SettingsDep
from app.api.negotiation import FEATURES, GEOJSON, HTML, JSON, chosen_format, refuse_unknown
from app.api.pages import features_page
from app.api.streams import Streamed
from app.auth import Scope, allows, require
from app.db.engine import Database
from app.db.features.collection import Collection, Viewer
from app.usecases.features import items as features
from app.usecases.features.items import Answer
from app.usecases.features.query import (
    DEFAULT_LIMIT,
    FILTER_LANGUAGES,
    FeatureQuery,
    ResolvedQuery,
    resolve,
)
from services.formats.vector.feature_files import (
    FeatureTable,
    format_flatgeobuf,
    format_geopackage,
    format_parquet,
)

router = APIRouter(tags=["features"])

PARAMETERS = {
    "f",
    "limit",
    "token",
    "bbox",
    "bbox-crs",
    "crs",
    "datetime",
    "filter",
    "filter-lang",
    "filter-crs",
    "sortby",
    "properties",
}


async def _collection(collection: str) -> Collection:
    return features.find_collection(collection)


CollectionDep = Annotated[Collection, Depends(_collection)]


def viewer_of(collection: CollectionDep, caller: CallerDep, settings: SettingsDep) -> Viewer:
    """Who asks: with a token to read where points are not public, to register for closed collections."""
    if not collection.is_open:
        caller = require(caller, Scope.REGISTER)
    elif caller is not None or not settings.public_points:
        caller = require(caller, Scope.READ)
    return Viewer() if caller is None else Viewer(caller.id, allows(caller, Scope.ADMIN))


async def _viewer(collection: CollectionDep, caller: CallerDep, settings: SettingsDep) -> Viewer:
    return viewer_of(collection, caller, settings)


ViewerDep = Annotated[Viewer, Depends(_viewer)]


async def _secret(request: Request, database: DatabaseDep) -> bytes:
    """The secret of page links, read once by each process."""
    known: bytes | None = getattr(request.app.state, "page_secret", None)
    if known is None:
        known = request.app.state.page_secret = await run_in_threadpool(_read_secret, database)
    return known


def _read_secret(database: Database) -> bytes:
    with database.reading() as connection:
        return features.page_secret(connection)


SecretDep = Annotated[bytes, Depends(_secret)]
FILES: dict[str, Callable[[FeatureTable, str], bytes]] = {
    "fgb": format_flatgeobuf,
    "parquet": format_parquet,
    "gpkg": format_geopackage,
}
Format = Annotated[str | None, Query(description=f"Format: {', '.join(FEATURES)}.")]
CrsUri = Annotated[str | None, Query(description="URI of the reference system of the reply.")]


async def question_of_query(
    limit: Annotated[
        int,
        Query(ge=1, description="Most features on the page.", json_schema_extra={"maximum": 10_000}),
    ] = DEFAULT_LIMIT,
    token: Annotated[str | None, Query(description="From the link `next` of the page before.")] = None,
    bbox: Annotated[
        str | None,
        Query(
            description="W,S,E,N, or with heights between; W greater than E crosses the antimeridian."
        ),
    ] = None,
    bbox_crs: Annotated[
        str | None, Query(alias="bbox-crs", description="URI of the reference system of bbox.")
    ] = None,
    crs: CrsUri = None,
    datetime: Annotated[
        str | None, Query(description="A time, or FROM/TO with .. for an open end.")
    ] = None,
    filter: Annotated[str | None, Query(description="CQL2.")] = None,
    filter_lang: Annotated[
        str | None,
        Query(
            alias="filter-lang",
            description="cql2-text unless said.",
            json_schema_extra={"enum": list(FILTER_LANGUAGES)},
        ),
    ] = None,
    filter_crs: Annotated[
        str | None, Query(alias="filter-crs", description="URI of the reference system in filter.")
    ] = None,
    sortby: Annotated[
        str | None, Query(description="Properties by which to sort, - before one for descending.")
    ] = None,
    properties: Annotated[str | None, Query(description="Properties to give, all by default.")] = None,
) -> FeatureQuery:
    return FeatureQuery(
        limit=limit,
        token=token,
        bbox=bbox,
        bbox_crs=bbox_crs,
        crs=crs,
        datetime=datetime,
        filter=filter,
        filter_lang=filter_lang,
        filter_crs=filter_crs,
        sortby=sortby,
        properties=properties,
    )


class Search(BaseModel):
    """A question too long for a URL; its members are those of the query of items."""

    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    intersects: dict[str, Any] | None = Field(
        None, description="GeoJSON geometry, longitude and latitude, that features must meet."
    )
    filter: str | dict[str, Any] | None = None
    filter_lang: str | None = Field(None, alias="filter-lang")
    filter_crs: str | None = Field(None, alias="filter-crs")
    bbox: str | None = None
    bbox_crs: str | None = Field(None, alias="bbox-crs")
    crs: str | None = None
    datetime: str | None = None
    sortby: str | None = None
    properties: str | None = None
    limit: int = Field(DEFAULT_LIMIT, ge=1)
    token: str | None = None
    f: str | None = None


CONTENT: dict[str, Any] = {kind: {} for kind in FEATURES.values()}
PAGE: dict[int | str, dict[str, Any]] = {200: {"description": "A page.", "content": CONTENT}}


@router.get("/collections/{collection}/items", response_class=Response, responses=PAGE)
def items(
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
    secret: SecretDep,
    question: Annotated[FeatureQuery, Depends(question_of_query)],
    f: Format = None,
) -> Response:
    """A page of the features of a collection."""
    refuse_unknown(request, PARAMETERS | set(collection.queryables))
    form = chosen_format(request, FEATURES, f)
    equal = tuple(
        (name, value)
        for name, value in request.query_params.items()
        if name in collection.queryables and name not in PARAMETERS
    )
    asked = resolve(collection, viewer, FeatureQuery(**{**vars(question), "equal": equal}), secret)
    return _answer(request, database, asked, form, secret, _next_of_query(request))


@router.post("/collections/{collection}/search", response_class=Response, responses=PAGE)
def search(
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
    secret: SecretDep,
    body: Search,
) -> Response:
    """The same by POST; the next page is asked for with the `token` of the link `next`."""
    refuse_unknown(request, set())
    said = body.model_dump(exclude={"f"})
    asked = resolve(collection, viewer, FeatureQuery(**said), secret)
    form = chosen_format(request, FEATURES, body.f)

    def next_link(token: str) -> dict[str, Any]:
        again = body.model_dump(by_alias=True, exclude_none=True) | {"token": token}
        return {"href": str(request.url), "method": "POST", "body": again}

    return _answer(request, database, asked, form, secret, next_link)


@router.get(
    "/collections/{collection}/items/{feature_id}",
    response_class=Response,
    responses={200: {"description": "A feature.", "content": {GEOJSON: {}, HTML: {}}}},
)
def item(
    feature_id: str,
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
    crs: CrsUri = None,
    f: Format = None,
) -> Response:
    """One feature."""
    refuse_unknown(request, {"crs", "f"})
    form = chosen_format(request, {"json": GEOJSON, "html": HTML}, f)
    with database.reading() as connection:
        text, given = features.find_feature(connection, collection, viewer, feature_id, crs)
    here = f"{request.base_url}collections/{collection.id}"
    links = [
        {"rel": "self", "href": f"{here}/items/{feature_id}", "type": GEOJSON},
        {"rel": "alternate", "href": f"{here}/items/{feature_id}?f=html", "type": HTML},
        {"rel": "collection", "href": here, "type": JSON},
    ]
    if form == "html":
        feature = json.loads(text)
        return features_page(
            request, collection, f"{collection.title}: {feature['id']}", [feature], links
        )
    body = f'{text[:-1]},"links":{json.dumps(links)}}}'
    return Response(body, media_type=GEOJSON, headers={"Content-Crs": f"<{given.uri}>"})


def _next_of_query(request: Request) -> Any:
    return lambda token: {"href": str(request.url.include_query_params(token=token))}


def _answer(
    request: Request, database: Database, asked: ResolvedQuery, form: str, secret: bytes, next_link: Any
) -> Response:
    """A page in a format; links are in the document where it has a place for them, in the header too."""
    if form == "json" and asked.limit > features.LARGEST_TEXT:
        pieces = _streamed(request, database, asked, secret, next_link)
        # Read ahead to know that there is no error; with what follows features, it may be all there is.
        ahead = list(islice(pieces, 3))
        headers = _headers(asked, FEATURES["json"])
        if len(ahead) < 3:
            return Response(b"".join(ahead), media_type=GEOJSON, headers=headers)
        return Streamed(ahead, pieces, GEOJSON, headers)
    with database.reading() as connection:
        if form in FILES:
            table, answer = features.table(connection, asked, secret)
            body = FILES[form](table, asked.selection.collection.id)
        else:
            answer = features.page(connection, asked, "csv" if form == "csv" else "geojson", secret)
            body = answer.body
    links = _links(request, asked, answer, next_link, form)
    headers = _headers(asked, FEATURES[form], links, answer)
    if form == "html":
        page = json.loads(b'{"features":[' + body + b"]}")["features"]
        return features_page(
            request, asked.selection.collection, asked.selection.collection.title, page, links, answer
        )
    if form == "json":
        body = b'{"type":"FeatureCollection","features":[' + body + _rest(answer, links)
    elif form == "csv":
        body = features.csv_header(asked.selection).encode() + b"\r\n" + body + b"\r\n" * bool(body)
    return Response(body, media_type=FEATURES[form], headers=headers)


def _streamed(
    request: Request, database: Database, asked: ResolvedQuery, secret: bytes, next_link: Any
) -> Generator[bytes, None, None]:
    with database.reading() as connection:
        opened = b'{"type":"FeatureCollection","features":['
        for piece in features.stream(connection, asked, secret):
            if isinstance(piece, Answer):
                yield opened + _rest(piece, _links(request, asked, piece, next_link, "json"))
            else:
                yield opened + piece
            opened = b""


def _rest(answer: Answer, links: list[dict[str, Any]]) -> bytes:
    rest = {
        "numberMatched": answer.matched.number,
        "numberReturned": answer.returned,
        "amers:numberMatchedIsExact": answer.matched.exact,
        "links": links,
    }
    return b"]," + json.dumps(rest)[1:].encode()


def _links(
    request: Request, asked: ResolvedQuery, answer: Answer, next_link: Any, form: str
) -> list[dict[str, Any]]:
    kind = FEATURES[form]
    links = [{"rel": "self", "href": str(request.url), "type": kind}]
    links += [
        {"rel": "alternate", "href": str(request.url.include_query_params(f=name)), "type": other}
        for name, other in FEATURES.items()
        if name != form and request.method == "GET"
    ]
    here = f"{request.base_url}collections/{asked.selection.collection.id}"
    links.append({"rel": "collection", "href": here, "type": JSON})
    if answer.next_token is not None:
        links.append({"rel": "next", "type": kind, **next_link(answer.next_token)})
    return links


def _headers(
    asked: ResolvedQuery,
    kind: str,
    links: list[dict[str, Any]] | None = None,
    answer: Answer | None = None,
) -> dict[str, str]:
    headers = {"Content-Crs": f"<{asked.selection.crs.uri}>"}
    if answer is not None:
        headers |= {
            "OGC-NumberMatched": str(answer.matched.number),
            "OGC-NumberReturned": str(answer.returned),
        }
        if answer.next_token is not None:
            headers["Amers-Next-Token"] = answer.next_token
    said = [link for link in links or [] if link["rel"] in ("self", "next") and "method" not in link]
    if said:
        headers["Link"] = ", ".join(
            f'<{link["href"]}>; rel="{link["rel"]}"; type="{link["type"]}"' for link in said
        )
    suffix = {name for name, value in FEATURES.items() if value == kind} - {"json", "html"}
    for name in suffix:
        file = f"{asked.selection.collection.id}.{name}"
        headers["Content-Disposition"] = f'attachment; filename="{file}"'
    return headers
