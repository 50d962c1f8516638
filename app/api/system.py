"""The landing page, what the service conforms to, its description, and whether it lives."""

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse

from app.api import processes, stac
from app.api.deps import DatabaseDep
from app.api.features import Format
from app.api.json_schemas import document_of
from app.api.negotiation import DOCUMENTS, HTML, JSON, OPENAPI_JSON, chosen_format, refuse_unknown
from app.api.pages import Cell, document_page

router = APIRouter(tags=["system"])

COMMON = "http://www.opengis.net/spec/ogcapi-common-1/1.0/conf/"
FEATURES = "http://www.opengis.net/spec/ogcapi-features-"
CQL2 = "http://www.opengis.net/spec/cql2/1.0/conf/"
TILES = "http://www.opengis.net/spec/ogcapi-tiles-1/1.0/conf/"
CONFORMS_TO = (
    *(f"{COMMON}{name}" for name in ("core", "landing-page", "json", "html")),
    *(f"{FEATURES}1/1.0/conf/{name}" for name in ("core", "geojson", "html")),
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
REL = "http://www.opengis.net/def/rel/ogc/1.0/"
LINKS = (
    ("self", "", JSON, "this document"),
    ("alternate", "?f=html", HTML, "this document as a page"),
    ("service-desc", "api", OPENAPI_JSON, "the API, machine readable"),
    ("service-doc", "api?f=html", HTML, "the API, for people"),
    ("conformance", "conformance", JSON, "what the service conforms to"),
    (f"{REL}conformance", "conformance", JSON, "what the service conforms to"),
    ("data", "collections", JSON, "the collections"),
    (f"{REL}data", "collections", JSON, "the collections"),
    (f"{REL}tiling-schemes", "tileMatrixSets", JSON, "the grids of tiles"),
    (f"{REL}processes", "processes", JSON, "the processes"),
    (f"{REL}job-list", "jobs", JSON, "the jobs"),
    ("related", "map", HTML, "the map"),
)


@router.get("/", response_class=Response, responses=document_of("Landing"))
def landing(request: Request, f: Format = None) -> Response:
    """What this is, and where everything begins."""
    refuse_unknown(request, {"f"})
    title, description = request.app.title, request.app.description
    links = [
        {"rel": rel, "href": f"{request.base_url}{path}", "type": kind, "title": said}
        for rel, path, kind, said in LINKS
    ]
    if chosen_format(request, DOCUMENTS, f) == "json":
        links += stac.landing_links(str(request.base_url))
        said = {"title": title, "description": description, "conformsTo": CONFORMS_TO}
        return JSONResponse({**stac.LANDING_MEMBERS, **said, "links": links})
    pages = {link["title"]: link for link in links if not link["rel"].startswith("http")}
    return document_page(request, title, description, list(pages.values()))


@router.get("/conformance", response_class=Response, responses=document_of("Conformance"))
def conformance(request: Request, f: Format = None) -> Response:
    """The conformance classes of OGC API that the service keeps."""
    refuse_unknown(request, {"f"})
    if chosen_format(request, DOCUMENTS, f) == "json":
        return JSONResponse({"conformsTo": CONFORMS_TO})
    rows = [[Cell(name)] for name in CONFORMS_TO]
    return document_page(request, "Conformance", "", [], ("class",), rows)


@router.get("/api", include_in_schema=False)
def description(request: Request, f: Format = None) -> Response:
    """The API in OpenAPI 3.1, or as a list of what can be asked."""
    refuse_unknown(request, {"f"})
    document: dict[str, Any] = request.app.openapi()
    form = chosen_format(request, {"json": OPENAPI_JSON, "plain": JSON, "html": HTML}, f)
    if form != "html":
        # GDAL refuses the type of version 3.1, and says with Accept that plain JSON will do.
        return JSONResponse(document, media_type=OPENAPI_JSON if form == "json" else JSON)
    rows = [
        [Cell(method.upper()), Cell(path), Cell(operation.get("description", ""))]
        for path, operations in document["paths"].items()
        for method, operation in operations.items()
    ]
    title = f"{document['info']['title']} {document['info']['version']}"
    columns = ("method", "path", "what it does")
    return document_page(request, title, document["info"]["description"], [], columns, rows)


@router.get("/healthz")
def alive() -> dict[str, str]:
    """The process answers."""
    return {"status": "alive"}


@router.get("/readyz")
def ready(database: DatabaseDep) -> dict[str, str]:
    """The database answers too."""
    with database.reading() as connection:
        connection.execute("select postgis_version()")
    return {"status": "ready"}
