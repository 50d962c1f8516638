"""The collections of the service, in the vocabulary of OGC API - Features."""

from typing import Any

from fastapi import APIRouter, Request

from app.api.deps import PointsReader, ReadConnection
from app.errors import NotFound
from app.usecases.blocks import published_bounds

router = APIRouter(tags=["collections"])

CRS84H = "http://www.opengis.net/def/crs/OGC/0/CRS84h"
GEOJSON = "application/geo+json"
COLLECTIONS = {
    "points": ("Control points", "3D ground control points with image chips, of all published blocks."),
    "blocks": ("Blocks", "Productions of points, published as a whole."),
}


@router.get("/collections")
def collections(request: Request, connection: ReadConnection, caller: PointsReader) -> dict[str, Any]:
    """The collections there are."""
    bounds = published_bounds(connection)
    return {
        "links": [_link(request, "self", "collections", "application/json")],
        "collections": [_collection(request, name, bounds) for name in COLLECTIONS],
    }


@router.get("/collections/{name}")
def collection(
    name: str, request: Request, connection: ReadConnection, caller: PointsReader
) -> dict[str, Any]:
    """One collection."""
    if name not in COLLECTIONS:
        raise NotFound(f"no collection {name:.100}: there are {', '.join(COLLECTIONS)}")
    return _collection(request, name, published_bounds(connection))


def _collection(request: Request, name: str, bounds: tuple[float, ...] | None) -> dict[str, Any]:
    title, description = COLLECTIONS[name]
    extent = {"extent": {"spatial": {"bbox": [bounds], "crs": CRS84H}}} if bounds else {}
    return {
        "id": name,
        "title": title,
        "description": description,
        "itemType": "feature",
        "crs": [CRS84H],
        "storageCrs": CRS84H,
        **extent,
        "links": [
            _link(request, "self", f"collections/{name}", "application/json"),
            _link(request, "items", f"collections/{name}/items", GEOJSON),
        ],
    }


def _link(request: Request, rel: str, path: str, kind: str) -> dict[str, str]:
    return {"rel": rel, "href": f"{request.base_url}{path}", "type": kind}
