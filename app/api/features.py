"""Features of every collection: pages of items in six formats, one item, search by POST."""

import json
from collections.abc import Callable, Generator
from dataclasses import dataclass
from itertools import islice
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from amers.app.api.access import needs
from amers.app.api.deps import CallerDep, DatabaseDep, SecretDep, SettingsDep
from amers.app.api.disposition import disposition
from amers.app.api.negotiation import (
    CRS_HEADER,
    FEATURES,
    FILE_HEADER,
    GEOJSON,
    HTML,
    JSON,
    chosen_format,
    header,
    refuse_unknown,
)
from amers.app.api.pages import Page, count_text, features_page
from amers.app.api.routes import CallerRoute
from amers.app.api.streams import Streamed
from amers.app.auth import Scope, is_administrator, require
from amers.app.db.engine import Database
from amers.app.db.features.collection import Collection, Viewer
from amers.app.db.features.pages import TextFormat
from amers.app.usecases.features import items as features
from amers.app.usecases.features.items import FeaturePage
from amers.app.usecases.features.query import FeatureQuery, ResolvedQuery, Restriction, resolve
from amers.services.formats.vector.feature_files import (
    FeatureTable,
    format_flatgeobuf,
    format_geopackage,
    format_parquet,
)

router = APIRouter(tags=["features"], route_class=CallerRoute)


async def _collection(collection: str) -> Collection:
    return features.find_collection(collection)


CollectionDep = Annotated[Collection, Depends(_collection)]


def viewer_of(collection: CollectionDep, caller: CallerDep, settings: SettingsDep) -> Viewer:
    """The viewer that a caller is to a collection.

    Open collections need the scope `read` unless points are public; closed ones need `register`.

    Raises:
        NotAllowed: the caller has no such scope.
    """
    if not collection.is_open:
        caller = require(caller, Scope.REGISTER)
    elif caller is not None or not settings.public_points:
        caller = require(caller, Scope.READ)
    return Viewer() if caller is None else Viewer(caller.id, is_administrator(caller))


@needs(Scope.READ, "public_points")
async def _viewer(collection: CollectionDep, caller: CallerDep, settings: SettingsDep) -> Viewer:
    return viewer_of(collection, caller, settings)


ViewerDep = Annotated[Viewer, Depends(_viewer)]


FILES: dict[str, Callable[[FeatureTable, str], bytes]] = {
    "fgb": format_flatgeobuf,
    "parquet": format_parquet,
    "gpkg": format_geopackage,
}
FORMAT_TEXT = "Format of the reply; without it the header Accept decides."
Format = Annotated[str | None, Query(description=FORMAT_TEXT)]
CrsUri = Annotated[str | None, Query(description="URI of the coordinate reference system of the reply.")]


class ItemsQuery(FeatureQuery):
    """The parameters of a page of features."""

    f: str | None = Field(default=None, description=FORMAT_TEXT)


class Search(ItemsQuery):
    """The parameters of a page of features in the body of a POST, where a long polygon has room."""

    model_config = ConfigDict(extra="forbid")


def parameter_names(model: type[BaseModel]) -> set[str]:
    """The names of the parameters that a model declares, as requests write them."""
    return {field.alias or name for name, field in model.model_fields.items()}


ITEMS_PARAMETERS = parameter_names(ItemsQuery)
CONTENT: dict[str, Any] = {media_type: {} for media_type in FEATURES.values()}
PAGE_HEADERS = {
    **CRS_HEADER,
    **FILE_HEADER,
    "OGC-NumberMatched": header("Number of features on all pages."),
    "OGC-NumberReturned": header("Number of features on this page."),
    "Amers-Next-Token": header("The parameter `token` of the next page; none on the last one."),
    "Link": header("Links to this page and the next one."),
}
PAGE: dict[int | str, dict[str, Any]] = {
    200: {"description": "A page.", "content": CONTENT, "headers": PAGE_HEADERS}
}


def equal_parameters(request: Request, collection: Collection) -> tuple[tuple[str, str], ...]:
    """The parameters that are named as a property, each with the value the property must have."""
    return tuple(
        (name, value)
        for name, value in request.query_params.items()
        if name in collection.queryables and name not in ITEMS_PARAMETERS
    )


@router.get("/collections/{collection}/items", response_class=Response, responses=PAGE)
def items(
    *,
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
    secret: SecretDep,
    query: Annotated[ItemsQuery, Query()],
) -> Response:
    """Return a page of the features of a collection."""
    refuse_unknown(request, ITEMS_PARAMETERS | set(collection.queryables))
    restriction = Restriction(equal=equal_parameters(request, collection))
    return _page_reply(
        PageRequest(
            request=request,
            database=database,
            form=chosen_format(request, FEATURES, query.f),
            query=resolve(collection, viewer, query, secret, restriction),
            secret=secret,
            next_link=lambda token: {"href": str(request.url.include_query_params(token=token))},
        )
    )


@router.post("/collections/{collection}/search", response_class=Response, responses=PAGE)
def search(
    *,
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
    secret: SecretDep,
    body: Search,
) -> Response:
    """Return a page of features by POST; send the `token` of the link `next` for the next page."""
    refuse_unknown(request, set())

    def next_link(token: str) -> dict[str, Any]:
        same = body.model_dump(by_alias=True, exclude_none=True)
        return {"href": str(request.url), "method": "POST", "body": {**same, "token": token}}

    return _page_reply(
        PageRequest(
            request=request,
            database=database,
            form=chosen_format(request, FEATURES, body.f),
            query=resolve(collection, viewer, body, secret),
            secret=secret,
            next_link=next_link,
        )
    )


@router.get(
    "/collections/{collection}/items/{feature_id}",
    response_class=Response,
    responses={
        200: {"description": "A feature.", "content": {GEOJSON: {}, HTML: {}}, "headers": CRS_HEADER}
    },
)
def item(
    *,
    feature_id: str,
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
    crs: CrsUri = None,
    f: Format = None,
) -> Response:
    """Return one feature."""
    refuse_unknown(request, {"crs", "f"})
    form = chosen_format(request, {"json": GEOJSON, "html": HTML}, f)
    with database.reading() as connection:
        text, reply_crs = features.find_feature(connection, collection, viewer, feature_id, crs)
    here = f"{request.base_url}collections/{collection.id}"
    links = [
        {"rel": "self", "href": f"{here}/items/{feature_id}", "type": GEOJSON},
        {"rel": "alternate", "href": f"{here}/items/{feature_id}?f=html", "type": HTML},
        {"rel": "collection", "href": here, "type": JSON},
    ]
    if form == "html":
        feature = json.loads(text)
        html = Page(f"{collection.title}: {feature['id']}", collection.description, links)
        return features_page(request, collection, [feature], html)
    body = f'{text[:-1]},"links":{json.dumps(links)}}}'
    return Response(body, media_type=GEOJSON, headers={"Content-Crs": f"<{reply_crs.uri}>"})


@dataclass(frozen=True)
class PageRequest:
    """A request for a page of features.

    Attributes:
        form: name of the format.
        secret: key that page tokens are signed with.
        next_link: makes the members of the link `next` from a page token.
    """

    request: Request
    database: Database
    form: str
    query: ResolvedQuery
    secret: bytes
    next_link: Callable[[str], dict[str, Any]]

    @property
    def collection(self) -> Collection:
        """The collection of the features."""
        return self.query.selection.collection


def _page_reply(page: PageRequest) -> Response:
    """A page in its format; links are in the document where the format has them, and in the header."""
    if page.form == "json" and page.query.limit > features.LARGEST_TEXT:
        return _streamed_reply(page)
    with page.database.reading() as connection:
        if page.form in FILES:
            table, answer = features.table(connection, page.query, page.secret)
            body = FILES[page.form](table, page.collection.id)
        else:
            kind: TextFormat = "csv" if page.form == "csv" else "geojson"
            answer = features.page(connection, page.query, kind, page.secret)
            body = answer.body
    links = _links(page, answer)
    headers = {**_headers(page), **_answer_headers(answer, links)}
    if page.form == "html":
        rows = json.loads(b'{"features":[' + body + b"]}")["features"]
        description = f"{count_text(answer)} {page.collection.description}"
        html = Page(page.collection.title, description, links)
        return features_page(page.request, page.collection, rows, html)
    if page.form == "json":
        body = b'{"type":"FeatureCollection","features":[' + body + _members(answer, links)
    elif page.form == "csv":
        body = features.csv_header(page.query.selection).encode() + b"\r\n" + body + b"\r\n" * bool(body)
    return Response(body, media_type=FEATURES[page.form], headers=headers)


def _streamed_reply(page: PageRequest) -> Response:
    """A large page as GeoJSON in pieces.

    Three pieces are read first: an error then still has its own status, and a small page is whole.
    """
    pieces = _pieces(page)
    first_pieces = list(islice(pieces, 3))
    if len(first_pieces) < 3:
        return Response(b"".join(first_pieces), media_type=GEOJSON, headers=_headers(page))
    return Streamed(first_pieces, pieces, GEOJSON, _headers(page))


def _pieces(page: PageRequest) -> Generator[bytes, None, None]:
    with page.database.reading() as connection:
        opening = b'{"type":"FeatureCollection","features":['
        for piece in features.stream(connection, page.query, page.secret):
            if isinstance(piece, FeaturePage):
                yield opening + _members(piece, _links(page, piece))
            else:
                yield opening + piece
            opening = b""


def _members(answer: FeaturePage, links: list[dict[str, Any]]) -> bytes:
    """The end of a FeatureCollection after its features."""
    members = {
        "numberMatched": answer.matched.number,
        "numberReturned": answer.returned,
        "amers:numberMatchedIsExact": answer.matched.exact,
        "links": links,
    }
    return b"]," + json.dumps(members)[1:].encode()


def _links(page: PageRequest, answer: FeaturePage) -> list[dict[str, Any]]:
    url, media_type = page.request.url, FEATURES[page.form]
    links = [{"rel": "self", "href": str(url), "type": media_type}]
    links += [
        {"rel": "alternate", "href": str(url.include_query_params(f=name)), "type": other}
        for name, other in FEATURES.items()
        if name != page.form and page.request.method == "GET"
    ]
    here = f"{page.request.base_url}collections/{page.collection.id}"
    links.append({"rel": "collection", "href": here, "type": JSON})
    if answer.next_token is not None:
        links.append({"rel": "next", "type": media_type, **page.next_link(answer.next_token)})
    return links


def _headers(page: PageRequest) -> dict[str, str]:
    """Headers that are known before the features are read."""
    headers = {"Content-Crs": f"<{page.query.selection.crs.uri}>"}
    if page.form not in ("json", "html"):
        file_name = f"{page.collection.id}.{page.form}"
        headers["Content-Disposition"] = disposition(file_name)
    return headers


def _answer_headers(answer: FeaturePage, links: list[dict[str, Any]]) -> dict[str, str]:
    """Counts, page token and links, for formats that have no place for them."""
    in_header = [link for link in links if link["rel"] in ("self", "next") and "method" not in link]
    return {
        "OGC-NumberMatched": str(answer.matched.number),
        "OGC-NumberReturned": str(answer.returned),
        **({} if answer.next_token is None else {"Amers-Next-Token": answer.next_token}),
        "Link": ", ".join(
            f'<{link["href"]}>; rel="{link["rel"]}"; type="{link["type"]}"' for link in in_header
        ),
    }
