"""The landing page, the conformance classes, the description of the API, and health checks."""

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse

from amers.app.api import processes, stac
from amers.app.api.access import Public
from amers.app.api.features import Format
from amers.app.api.models.base import Link
from amers.app.api.models.documents import Conformance, Health, Landing, PartReadiness, ReadinessReport
from amers.app.api.negotiation import (
    DOCUMENTS,
    HTML,
    JSON,
    OPENAPI_30_JSON,
    OPENAPI_JSON,
    chosen_format,
    described,
    json_reply,
    refuse_unknown,
)
from amers.app.api.operations_page import operations_page
from amers.app.api.pages import Cell, Page, document_page
from amers.app.api.public_address import address_state, log_wrong_address
from amers.app.api.routes import CallerRoute
from amers.app.api.try_out import TRY_OUTS
from amers.app.usecases.readiness import Readiness, overall

router = APIRouter(tags=["system"], route_class=CallerRoute)

COMMON = "http://www.opengis.net/spec/ogcapi-common-1/1.0/conf/"
FEATURES = "http://www.opengis.net/spec/ogcapi-features-"
CQL2 = "http://www.opengis.net/spec/cql2/1.0/conf/"
TILES = "http://www.opengis.net/spec/ogcapi-tiles-1/1.0/conf/"
CONFORMS_TO = (
    *(f"{COMMON}{name}" for name in ("core", "landing-page", "json", "html", "oas30")),
    *(f"{FEATURES}1/1.0/conf/{name}" for name in ("core", "geojson", "html", "oas30")),
    f"{FEATURES}2/1.0/conf/crs",
    *(
        f"{FEATURES}3/1.0/conf/{name}"
        for name in ("queryables", "queryables-query-parameters", "filter", "features-filter")
    ),
    *(
        f"{CQL2}{name}"
        for name in (
            "cql2-text",
            "cql2-json",
            "basic-cql2",
            "advanced-comparison-operators",
            "case-insensitive-comparison",
            "basic-spatial-functions",
            "basic-spatial-functions-plus",
            "spatial-functions",
            "temporal-functions",
            "property-property",
            "arithmetic",
        )
    ),
    *(f"{TILES}{name}" for name in ("core", "tileset", "tilesets-list", "geodata-tilesets", "mvt")),
    *processes.CONFORMS_TO,
    *stac.CONFORMS_TO,
)
DESCRIPTIONS = {"json": OPENAPI_JSON, "oas30": OPENAPI_30_JSON, "plain": JSON, "html": HTML}
"""Formats of the description; clients that know neither version of OpenAPI take plain JSON."""
REL = "http://www.opengis.net/def/rel/ogc/1.0/"
LINKS = (
    ("self", "", JSON, "this document"),
    ("alternate", "?f=html", HTML, "this document as a page"),
    ("service-desc", "api", OPENAPI_JSON, "description of the API in OpenAPI 3.1"),
    ("service-desc", "api?f=oas30", OPENAPI_30_JSON, "description of the API in OpenAPI 3.0"),
    ("service-doc", "api?f=html", HTML, "description of the API as a page"),
    ("conformance", "conformance", JSON, "conformance classes of the service"),
    (f"{REL}conformance", "conformance", JSON, "conformance classes of the service"),
    ("data", "collections", JSON, "the collections"),
    (f"{REL}data", "collections", JSON, "the collections"),
    (f"{REL}tiling-schemes", "tileMatrixSets", JSON, "tile matrix sets"),
    (f"{REL}processes", "processes", JSON, "the processes"),
    (f"{REL}job-list", "jobs", JSON, "the jobs"),
    ("related", "map", HTML, "the map"),
    ("related", "connect", HTML, "how QGIS, GDAL and Python connect"),
)


@router.get("/", dependencies=[Public], response_class=Response, responses=described(Landing, HTML))
def landing(*, request: Request, f: Format = None) -> Response:
    """Return the landing page with links to everything else."""
    refuse_unknown(request, {"f"})
    log_wrong_address(request)
    title, description = request.app.title, request.app.description
    links = [
        Link(rel=rel, href=f"{request.base_url}{path}", type=kind, title=text)
        for rel, path, kind, text in LINKS
    ]
    if chosen_format(request, DOCUMENTS, f) == "json":
        links += stac.landing_links(str(request.base_url))
        return json_reply(
            Landing(
                **stac.LANDING_MEMBERS,
                title=title,
                description=description,
                conforms_to=CONFORMS_TO,
                links=links,
            )
        )
    pages = {link.title: link for link in links if not link.rel.startswith("http")}
    page = Page(title, description, list(pages.values()))
    return document_page(request, page, "landing.html", try_outs=TRY_OUTS)


@router.get(
    "/conformance",
    dependencies=[Public],
    response_class=Response,
    responses=described(Conformance, HTML),
)
def conformance(*, request: Request, f: Format = None) -> Response:
    """Return the conformance classes of OGC API and STAC that the service implements."""
    refuse_unknown(request, {"f"})
    if chosen_format(request, DOCUMENTS, f) == "json":
        return json_reply(Conformance(conforms_to=CONFORMS_TO))
    rows = [[Cell(name)] for name in CONFORMS_TO]
    return document_page(request, Page("Conformance", columns=("class",), rows=rows))


@router.get("/api", include_in_schema=False)
def description(*, request: Request, f: Format = None) -> Response:
    """Return the description of the API in OpenAPI 3.1 or 3.0, or a page of its operations."""
    refuse_unknown(request, {"f"})
    form = chosen_format(request, DESCRIPTIONS, f)
    if form == "html":
        return operations_page(request, request.app.openapi())
    app = request.app
    document: dict[str, Any] = app.state.openapi_30() if form == "oas30" else app.openapi()
    servers = [{"url": str(request.base_url).rstrip("/")}]
    return JSONResponse({**document, "servers": servers}, media_type=DESCRIPTIONS[form])


@router.get("/healthz", dependencies=[Public])
def alive() -> Health:
    """Report that the process answers."""
    return Health(status="alive")


@router.get("/readyz", dependencies=[Public], responses={503: {"model": ReadinessReport}})
def ready(*, request: Request, response: Response) -> ReadinessReport:
    """Report what of the service works; 503 when requests that read cannot be answered."""
    readiness: Readiness = request.app.state.readiness
    parts = {**readiness.check(), "address": address_state(request)}
    status = overall(parts)
    if status == "not ready":
        response.status_code = 503
    return ReadinessReport(
        status=status,
        parts={name: PartReadiness.model_validate(part) for name, part in parts.items()},
    )
