"""The landing page, what the service conforms to, and whether it lives."""

from fastapi import APIRouter, Request

from app.api.deps import ReadConnection

router = APIRouter(tags=["system"])

CONFORMS_TO = (
    "http://www.opengis.net/spec/ogcapi-common-1/1.0/conf/core",
    "http://www.opengis.net/spec/ogcapi-common-1/1.0/conf/landing-page",
    "http://www.opengis.net/spec/ogcapi-common-1/1.0/conf/json",
    "http://www.opengis.net/spec/ogcapi-common-1/1.0/conf/oas30",
)
LINKS = (
    ("self", "", "application/json", "this document"),
    ("service-desc", "api", "application/vnd.oai.openapi+json;version=3.1", "the API, machine readable"),
    ("conformance", "conformance", "application/json", "what the service conforms to"),
)


@router.get("/")
def landing(request: Request) -> dict[str, object]:
    """What this is, and where everything begins."""
    base = str(request.base_url)
    links = [
        {"rel": rel, "href": base + path, "type": kind, "title": title}
        for rel, path, kind, title in LINKS
    ]
    return {"title": request.app.title, "description": request.app.description, "links": links}


@router.get("/conformance")
def conformance() -> dict[str, tuple[str, ...]]:
    """The conformance classes of OGC API that the service keeps."""
    return {"conformsTo": CONFORMS_TO}


@router.get("/healthz")
def alive() -> dict[str, str]:
    """The process answers."""
    return {"status": "alive"}


@router.get("/readyz")
def ready(connection: ReadConnection) -> dict[str, str]:
    """The database answers too."""
    connection.execute("select postgis_version()")
    return {"status": "ready"}
