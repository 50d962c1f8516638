"""Vector tiles and what describes them, as OGC API - Tiles has it."""

import hashlib
from typing import Any

from fastapi import APIRouter, Request, Response

from app.api.deps import DatabaseDep
from app.api.features import CollectionDep, ViewerDep
from app.api.json_schemas import json_of
from app.api.negotiation import JSON, MVT
from app.db.features.collection import Collection
from app.errors import NotFound
from app.usecases.features import tiles
from app.usecases.features.tiles import MATRIX_SET

router = APIRouter(tags=["tiles"])

MATRIX_SET_URI = "http://www.opengis.net/def/tilematrixset/OGC/1.0/WebMercatorQuad"
MERCATOR = "http://www.opengis.net/def/crs/EPSG/0/3857"
WORLD_M = 20_037_508.342789244
FIRST_SCALE = 559_082_264.028717
REL = "http://www.opengis.net/def/rel/ogc/1.0"
GEOMETRY_DIMENSION = {"Point": 0, "Polygon": 2}


@router.get("/tileMatrixSets", responses=json_of("TileMatrixSets"))
def tile_matrix_sets(request: Request) -> dict[str, Any]:
    """The grids of tiles there are."""
    href = f"{request.base_url}tileMatrixSets/{MATRIX_SET}"
    link = {"rel": f"{REL}/tiling-scheme", "href": href, "type": JSON}
    return {"tileMatrixSets": [{"id": MATRIX_SET, "uri": MATRIX_SET_URI, "links": [link]}]}


@router.get("/tileMatrixSets/{matrix_set}", responses=json_of("TileMatrixSet"))
def tile_matrix_set(matrix_set: str) -> dict[str, Any]:
    """The one grid there is: the square of web maps, halved with each zoom."""
    _refuse_other(matrix_set)
    return {
        "id": MATRIX_SET,
        "uri": MATRIX_SET_URI,
        "crs": MERCATOR,
        "orderedAxes": ["X", "Y"],
        "tileMatrices": [
            {
                "id": str(z),
                "scaleDenominator": FIRST_SCALE / 2**z,
                "cellSize": 2.0 * WORLD_M / 256 / 2**z,
                "cornerOfOrigin": "topLeft",
                "pointOfOrigin": [-WORLD_M, WORLD_M],
                "tileWidth": 256,
                "tileHeight": 256,
                "matrixWidth": 2**z,
                "matrixHeight": 2**z,
            }
            for z in range(tiles.MOST_ZOOM + 1)
        ],
    }


@router.get("/collections/{collection}/tiles", responses=json_of("TileSets"))
def tilesets(request: Request, collection: CollectionDep, viewer: ViewerDep) -> dict[str, Any]:
    """The sets of tiles of a collection."""
    tiles.refuse_untiled(collection.id)
    here = f"{request.base_url}collections/{collection.id}/tiles"
    return {"links": [_link("self", here, JSON)], "tilesets": [_tileset(request, collection)]}


@router.get("/collections/{collection}/tiles/{matrix_set}", responses=json_of("TileSet"))
def tileset(
    matrix_set: str, request: Request, collection: CollectionDep, viewer: ViewerDep
) -> dict[str, Any]:
    """One set of tiles of a collection."""
    tiles.refuse_untiled(collection.id)
    _refuse_other(matrix_set)
    layer = {
        "id": collection.id,
        "dataType": "vector",
        "geometryDimension": GEOMETRY_DIMENSION[collection.geometry_type],
    }
    return {**_tileset(request, collection), "layers": [layer]}


@router.get(
    "/collections/{collection}/tiles/{matrix_set}/{z}/{y}/{x}",
    response_class=Response,
    responses={200: {"description": "A vector tile.", "content": {MVT: {}}}},
)
def tile(
    matrix_set: str,
    z: int,
    y: int,
    x: int,
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
) -> Response:
    """A vector tile; z, y, x are tile matrix, row and column."""
    _refuse_other(matrix_set)
    with database.reading() as connection:
        said = f"{tiles.version(connection)} {collection.id} {z} {y} {x} {viewer.is_admin}"
        tag = f'"{hashlib.sha256(said.encode()).hexdigest()[:20]}"'
        headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers=headers)
        content = tiles.tile(connection, collection.id, z, y, x, viewer=viewer)
    return Response(content, media_type=MVT, headers=headers)


def _tileset(request: Request, collection: Collection) -> dict[str, Any]:
    base = str(request.base_url)
    here = f"{base}collections/{collection.id}/tiles/{MATRIX_SET}"
    template = {**_link("item", here + "/{tileMatrix}/{tileRow}/{tileCol}", MVT), "templated": True}
    return {
        "title": collection.title,
        "dataType": "vector",
        "crs": MERCATOR,
        "tileMatrixSetURI": MATRIX_SET_URI,
        "links": [
            _link("self", here, JSON),
            template,
            _link(f"{REL}/tiling-scheme", f"{base}tileMatrixSets/{MATRIX_SET}", JSON),
            _link(f"{REL}/geodata", f"{base}collections/{collection.id}", JSON),
        ],
    }


def _refuse_other(matrix_set: str) -> None:
    if matrix_set != MATRIX_SET:
        raise NotFound(f"no tile matrix set {matrix_set:.60}: there is {MATRIX_SET}")


def _link(rel: str, href: str, kind: str) -> dict[str, Any]:
    return {"rel": rel, "href": href, "type": kind}
