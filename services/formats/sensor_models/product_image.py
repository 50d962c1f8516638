"""The image that a path stands for: an image file, a product in tiles by its document, or a folder."""

from dataclasses import replace
from pathlib import Path

from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace
from amers.services.formats.images.bands import BandMix
from amers.services.formats.images.raster import open_raster
from amers.services.formats.images.siblings import Siblings
from amers.services.formats.images.tiled_image import SceneImage, TiledImage, open_tiles
from amers.services.formats.members import folder_member
from amers.services.formats.sensor_models.product_documents import (
    ProductTile,
    is_document,
    read_product,
    tile_of_product,
)
from amers.services.formats.text_files import read_text
from amers.services.statements import Statement, Subject, Use

IMAGE_SUFFIXES = (".tif", ".tiff", ".jp2", ".j2k", ".ntf", ".nitf", ".nsf")


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


def whole_product(image: Path) -> Path:
    """The document of the product that an image is a tile of, where all tiles are there; else the image.

    Raises:
        FormatError: a document beside the image cannot be used.
    """
    tile = tile_of_product(image, Siblings(image))
    if tile is None:
        return image
    tiles = read_product(tile.document)
    is_whole = all(tile_file(other).is_file() for other in tiles)
    return tile.document if is_whole and isinstance(tile.document, Path) else image


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


def tile_file(tile: ProductTile) -> FilePlace:
    """The file of a tile; its name in upper or lower case.

    Raises:
        FormatError: its name leads out of the folder of its document.
    """
    if isinstance(tile.document, Address):
        return tile.document.with_name(tile.name)
    file = folder_member(tile.document.parent, tile.name, "the folder of the product")
    if not file.is_file() and file.parent.is_dir():
        alike = (other for other in file.parent.iterdir() if other.name.upper() == file.name.upper())
        return next(alike, file)
    return file


def scenes_in(folder: Path) -> list[Path]:
    """The scenes directly inside a folder, by name: images, and documents in place of their tiles.

    Raises:
        FormatError: the document of a product in tiles cannot be used.
    """
    files = sorted(folder.iterdir())
    images = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
    scenes: list[Path] = []
    for document in files:
        if not _lists_tiles(document):
            continue
        tiles = [tile_file(tile) for tile in read_product(document)]
        if len(tiles) > 1 and any(tile in images for tile in tiles):
            scenes.append(document)
            images = [image for image in images if image not in tiles]
    return sorted([*images, *scenes])


def _lists_tiles(file: Path) -> bool:
    """Whether a file is the document of a product in several files."""
    name = file.name.upper()
    if name.endswith(".TIL"):
        return True
    is_dimap = name == "METADATA.DIM" or (name.startswith("DIM_") and name.endswith(".XML"))
    return is_dimap and read_text(file).count("<DATA_FILE_PATH") > 1
