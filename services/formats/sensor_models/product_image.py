"""The image that a path names: an image file, the document of a tiled product, or a folder."""

from dataclasses import replace
from pathlib import Path

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.bands import BandMix
from amers.services.formats.images.raster import open_raster
from amers.services.formats.images.tiled_image import SceneImage, TiledImage, open_tiles
from amers.services.formats.sensor_models.product_documents import (
    ProductTile,
    is_document,
    read_product,
)
from amers.services.formats.sensor_models.product_files import scenes_in, tile_file
from amers.services.statements import Statement, Subject, Use


def open_image(path: FilePlace, bands: int | BandMix | None = 1) -> SceneImage:
    """Open an image file, or all files of a product in tiles as one image.

    Args:
        path: of an image, of the document that lists its tiles (`DIM_….XML`, `METADATA.DIM`, `.TIL`), or
            of a folder with one of these.
        bands: as for `open_raster`.

    Raises:
        FormatError: the image cannot be used, or a tile of it is missing.
    """
    if isinstance(path, Path) and path.is_dir():
        found = scenes_in(path)
        if len(found) != 1:
            names = ", ".join(file.name for file in found[:5]) or "none"
            raise FormatError(f"{path}: {len(found)} images found ({names}), a folder with one expected")
        path = found[0]
    if not is_document(path):
        return open_raster(path, bands)
    tiles = read_product(path)
    files = [tile_file(tile) for tile in tiles]
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise FormatError(
            f"{path}: of its {len(tiles)} tiles {len(missing)} not found: {', '.join(missing[:5])}; put "
            f"them beside {path.name}, or give the tiles that are there: each keeps its place"
        )
    note = "give one of its files"
    others = tuple(
        Statement(path.name, Subject.BANDS, Use.NOT_USED, f"the image {other}", note=note)
        for other in tiles[0].others
    )
    if len(tiles) == 1:
        image = open_raster(files[0], bands)
        return replace(image, statements=(*image.statements, *others))
    parts = [(file, tile.first, tile.shape) for file, tile in zip(files, tiles, strict=True)]
    _refuse_overlaps(tiles)
    tiled = open_tiles(path, tiles[0].product_shape, parts, bands)
    size = f"{tiled.shape[0]} x {tiled.shape[1]} pixels"
    whole = Statement(path.name, Subject.PLACE, Use.USED, size, where=f"{len(tiles)} tiles")
    return replace(tiled, statements=(*tiled.statements, whole, *others))


def _refuse_overlaps(tiles: list[ProductTile]) -> None:
    for k, one in enumerate(tiles):
        for other in tiles[:k]:
            ends = zip(one.first, one.shape, other.first, other.shape, strict=True)
            if all(a < b + b_size and b < a + a_size for a, a_size, b, b_size in ends):
                raise FormatError(
                    f"{one.document.name}: {other.name} and {one.name} overlap, "
                    "tiles side by side expected"
                )


def files_to_send(path: Path) -> list[Path]:
    """The image file of a path as for `open_image`, then the other files of the same product, if any.

    Raises:
        FormatError: the document of the product cannot be used.
    """
    image = open_image(path)
    image.close()
    if not isinstance(image, TiledImage):
        return [Path(str(image.path))]
    files = [*(tile.path for tile in image.tiles), image.path]
    return [file for file in files if isinstance(file, Path)]
