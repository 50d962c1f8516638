"""Vector tiles of the collections that the map page shows."""

from amers.app.db import tiles
from amers.app.db.engine import Connection
from amers.app.db.features.collection import Viewer
from amers.app.db.tiles import Layer
from amers.app.errors import NotFound

TILED = ("points", "density", "blocks")
MATRIX_SET = "WebMercatorQuad"
MOST_ZOOM = 24


def tile(connection: Connection, collection: str, z: int, y: int, x: int, *, viewer: Viewer) -> bytes:
    """A Mapbox vector tile with one layer, named like the collection; empty where there is no feature.

    Raises:
        NotFound: the collection has no tiles, or the tile lies outside of the tile matrix.
    """
    layer = _layer(collection, z)
    if not 0 <= z <= MOST_ZOOM or not (0 <= x < 2**z and 0 <= y < 2**z):
        raise NotFound(
            f"no tile {z}/{y}/{x}: expected zoom 0 to {MOST_ZOOM}, row and column 0 to 2^zoom - 1"
        )
    return tiles.tile(connection, layer, z, x, y, viewer=viewer)


def version(connection: Connection, collection: str, z: int) -> str:
    """A text that changes whenever the content of any tile of a collection and zoom changes.

    Raises:
        NotFound: the collection has no tiles.
    """
    return tiles.version(connection, _layer(collection, z))


def refuse_untiled(collection: str) -> None:
    """Refuse a collection without tiles.

    Raises:
        NotFound: it has no tiles.
    """
    if collection not in TILED:
        raise NotFound(f"no tiles of {collection}: expected one of {', '.join(TILED)}")


def _layer(collection: str, z: int) -> Layer:
    refuse_untiled(collection)
    if collection == "points":
        return tiles.point_layer(z)
    return tiles.DENSITY_LAYER if collection == "density" else tiles.BLOCK_LAYER
