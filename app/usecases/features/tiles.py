"""Vector tiles of the collections that the map page shows."""

from app.db import tiles
from app.db.engine import Connection
from app.db.features.collection import Viewer
from app.errors import NotFound

TILED = ("points", "density", "blocks")
MATRIX_SET = "WebMercatorQuad"
MOST_ZOOM = 24


def tile(connection: Connection, collection: str, z: int, y: int, x: int, *, viewer: Viewer) -> bytes:
    """A Mapbox vector tile with one layer, named like the collection; empty where there is no feature.

    Raises:
        NotFound: the collection has no tiles, or the tile lies outside of the tile matrix.
    """
    refuse_untiled(collection)
    if not 0 <= z <= MOST_ZOOM or not (0 <= x < 2**z and 0 <= y < 2**z):
        raise NotFound(
            f"no tile {z}/{y}/{x}: expected zoom 0 to {MOST_ZOOM}, row and column 0 to 2^zoom - 1"
        )
    if collection == "points":
        return tiles.point_tile(connection, z, x, y)
    if collection == "density":
        return tiles.density_tile(connection, z, x, y)
    return tiles.block_tile(connection, z, x, y, viewer)


def version(connection: Connection) -> str:
    """A text that changes whenever the content of any tile changes."""
    return tiles.version(connection)


def refuse_untiled(collection: str) -> None:
    """Refuse a collection without tiles.

    Raises:
        NotFound: it has no tiles.
    """
    if collection not in TILED:
        raise NotFound(f"no tiles of {collection}: expected one of {', '.join(TILED)}")
