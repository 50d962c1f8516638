"""Files of products in tiles, found by their documents without opening any image."""

from pathlib import Path

from amers.services.formats.addresses import Address, FilePlace
from amers.services.formats.images.siblings import Siblings
from amers.services.formats.members import folder_member
from amers.services.formats.sensor_models.product_documents import (
    ProductTile,
    read_product,
    tile_of_product,
)
from amers.services.formats.text_files import read_text

IMAGE_SUFFIXES = (".tif", ".tiff", ".jp2", ".j2k", ".ntf", ".nitf", ".nsf")


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
