"""The tiles of a reference image on the map of the web, drawn on demand."""

from dataclasses import replace
from datetime import datetime
from functools import lru_cache

from amers.app.config import Settings
from amers.app.db import references
from amers.app.db.engine import Database
from amers.app.errors import NotFound
from amers.app.usecases.references import reference_files
from amers.app.usecases.registration.reference_source import ReferenceFiles, read_reference
from amers.services.errors import CoverageError
from amers.services.formats.images.map_tiles import draw_map_tile
from amers.services.formats.images.tiles import grey_range
from amers.services.orthorectification.tile_limits import MOST_ZOOM, TilePlace, tile_outline
from amers.services.sensors.ortho import OrthoModel

_KEPT = 64
"""References whose range of grey values a process keeps."""


def reference_tile(database: Database, settings: Settings, name: str, place: TilePlace) -> bytes:
    """A tile of a reference image, in grey.

    Raises:
        NotFound: there is no reference of this name, it does not lie there, or the zoom is so coarse
            that the image would be read as a whole.
        InputError: its files cannot be read.
    """
    if place.zoom > MOST_ZOOM or max(place.row, place.column) >= 2**place.zoom:
        raise NotFound(f"no tile {place.zoom}/{place.row}/{place.column} in the tile matrix set")
    with database.reading() as connection:
        row = references.find_reference(connection, name)
    if row is None:
        raise NotFound(f"no reference {name:.120}")
    files = replace(reference_files(settings, row), terrain=None)
    try:
        greys = _greys(row.id, row.created_at, files)
        return _drawn(files, place, greys)
    except CoverageError as error:
        raise NotFound(f"reference {name:.120} has no such tile: {error}") from error


def _drawn(files: ReferenceFiles, place: TilePlace, greys: tuple[float, float]) -> bytes:
    reference = read_reference(files, tile_outline(place))
    assert isinstance(reference.model, OrthoModel)
    try:
        return draw_map_tile(reference.image, reference.model.grid, place, greys)
    finally:
        reference.image.close()  # type: ignore[attr-defined]


@lru_cache(_KEPT)
def _greys(reference_id: int, added: datetime, files: ReferenceFiles) -> tuple[float, float]:
    """The values of a reference that become black and white; all its tiles share them."""
    reference = read_reference(files)
    try:
        return grey_range(reference.image)
    finally:
        reference.image.close()  # type: ignore[attr-defined]
