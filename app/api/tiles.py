"""OGC API - Tiles: vector tiles, tile sets, tile matrix sets."""

import hashlib

from fastapi import APIRouter, Request, Response

from amers.app.api.access import Public
from amers.app.api.conditions import if_held
from amers.app.api.deps import DatabaseDep
from amers.app.api.features import CollectionDep, ViewerDep
from amers.app.api.models.base import Link
from amers.app.api.models.documents import (
    TileLayer,
    TileMatrix,
    TileMatrixSet,
    TileMatrixSetItem,
    TileMatrixSets,
    TileSet,
    TileSets,
)
from amers.app.api.negotiation import JSON, MVT, TAG_HEADER
from amers.app.api.paths import PathNumber
from amers.app.api.routes import CallerRoute
from amers.app.db.features.collection import Collection
from amers.app.errors import NotFound
from amers.app.usecases.features import tiles
from amers.app.usecases.features.tiles import MATRIX_SET

router = APIRouter(tags=["tiles"], route_class=CallerRoute)

MATRIX_SET_URI = "http://www.opengis.net/def/tilematrixset/OGC/1.0/WebMercatorQuad"
MERCATOR = "http://www.opengis.net/def/crs/EPSG/0/3857"
WORLD_M = 20_037_508.342789244
FIRST_SCALE = 559_082_264.028717
REL = "http://www.opengis.net/def/rel/ogc/1.0"
GEOMETRY_DIMENSION = {"Point": 0, "Polygon": 2}


@router.get("/tileMatrixSets", dependencies=[Public])
def tile_matrix_sets(*, request: Request) -> TileMatrixSets:
    """List the tile matrix sets: the grids of tiles."""
    href = f"{request.base_url}tileMatrixSets/{MATRIX_SET}"
    link = Link(rel=f"{REL}/tiling-scheme", href=href, type=JSON)
    item = TileMatrixSetItem(id=MATRIX_SET, uri=MATRIX_SET_URI, links=[link])
    return TileMatrixSets(tile_matrix_sets=[item])


@router.get("/tileMatrixSets/{matrix_set}", dependencies=[Public])
def tile_matrix_set(*, matrix_set: str) -> TileMatrixSet:
    """Return the tile matrix set WebMercatorQuad: the square of web maps, halved with each zoom."""
    refuse_other_matrix_set(matrix_set)
    matrices = [
        TileMatrix(
            id=str(z),
            scale_denominator=FIRST_SCALE / 2**z,
            cell_size=2.0 * WORLD_M / 256 / 2**z,
            corner_of_origin="topLeft",
            point_of_origin=[-WORLD_M, WORLD_M],
            tile_width=256,
            tile_height=256,
            matrix_width=2**z,
            matrix_height=2**z,
        )
        for z in range(tiles.MOST_ZOOM + 1)
    ]
    return TileMatrixSet(
        id=MATRIX_SET,
        uri=MATRIX_SET_URI,
        crs=MERCATOR,
        ordered_axes=["X", "Y"],
        tile_matrices=matrices,
    )


@router.get("/collections/{collection}/tiles")
def tilesets(*, request: Request, collection: CollectionDep, viewer: ViewerDep) -> TileSets:
    """List the tile sets of a collection."""
    tiles.refuse_untiled(collection.id)
    here = f"{request.base_url}collections/{collection.id}/tiles"
    links = [Link(rel="self", href=here, type=JSON)]
    return TileSets(links=links, tilesets=[_tileset(request, collection)])


@router.get("/collections/{collection}/tiles/{matrix_set}")
def tileset(
    *, matrix_set: str, request: Request, collection: CollectionDep, viewer: ViewerDep
) -> TileSet:
    """Return one tile set of a collection."""
    tiles.refuse_untiled(collection.id)
    refuse_other_matrix_set(matrix_set)
    tileset = _tileset(request, collection)
    dimension = GEOMETRY_DIMENSION[collection.geometry_type]
    tileset.layers = [TileLayer(id=collection.id, data_type="vector", geometry_dimension=dimension)]
    return tileset


@router.get(
    "/collections/{collection}/tiles/{matrix_set}/{z}/{y}/{x}",
    response_class=Response,
    responses={
        200: {"description": "A vector tile.", "content": {MVT: {}}, "headers": TAG_HEADER},
        304: {"description": "The tile that the caller has is the newest.", "headers": TAG_HEADER},
    },
)
def tile(
    *,
    matrix_set: str,
    z: PathNumber,
    y: PathNumber,
    x: PathNumber,
    request: Request,
    collection: CollectionDep,
    viewer: ViewerDep,
    database: DatabaseDep,
) -> Response:
    """Return a vector tile; z, y and x are tile matrix, row and column."""
    refuse_other_matrix_set(matrix_set)
    with database.reading() as connection:
        version = tiles.version(connection, collection.id, z)
        state = f"{version} {collection.id} {z} {y} {x} {viewer.is_admin}"
        tag = f'"{hashlib.sha256(state.encode()).hexdigest()[:20]}"'
        headers = {"ETag": tag, "Cache-Control": "private, no-cache"}
        held = if_held(request, headers)
        if held is not None:
            return held
        content = tiles.tile(connection, collection.id, z, y, x, viewer=viewer)
    return Response(content, media_type=MVT, headers=headers)


def _tileset(request: Request, collection: Collection) -> TileSet:
    base = str(request.base_url)
    here = f"{base}collections/{collection.id}/tiles/{MATRIX_SET}"
    template = here + "/{tileMatrix}/{tileRow}/{tileCol}"
    return TileSet(
        title=collection.title,
        data_type="vector",
        crs=MERCATOR,
        tile_matrix_set_uri=MATRIX_SET_URI,
        links=[
            Link(rel="self", href=here, type=JSON),
            Link(rel="item", href=template, type=MVT, templated=True),
            Link(rel=f"{REL}/tiling-scheme", href=f"{base}tileMatrixSets/{MATRIX_SET}", type=JSON),
            Link(rel=f"{REL}/geodata", href=f"{base}collections/{collection.id}", type=JSON),
        ],
    )


def refuse_other_matrix_set(matrix_set: str) -> None:
    """Refuse a tile matrix set that tiles do not have.

    Raises:
        NotFound: it is another one.
    """
    if matrix_set != MATRIX_SET:
        raise NotFound(f"no tile matrix set {matrix_set:.60}: there is {MATRIX_SET}")
