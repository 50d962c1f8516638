"""Documents that list the files of one image: DIMAP (`DIM_….XML`, `METADATA.DIM`), `.TIL`.

Sources: SPOT 6/7, Pléiades and Pléiades Neo product formats (Raster_Dimensions, Data_Access); Maxar,
image support data (tile map file). A DIMAP tile of row R and column C begins at (R - 1, C - 1) times the
size of a tile, less the overlap.
"""

import re
from dataclasses import dataclass
from xml.etree import ElementTree

from amers.services.errors import FormatError
from amers.services.formats.addresses import FilePlace
from amers.services.formats.images.siblings import Siblings
from amers.services.formats.reader_rows import Reader, Treatment
from amers.services.formats.sensor_models.xml_values import single, whole_number
from amers.services.formats.text_files import parse_xml, read_text
from amers.services.statements import Subject

READER = Reader(
    "Documents of products in tiles (`DIM_….XML`, `METADATA.DIM`, `.TIL`)",
    ("read_product",),
    (
        Treatment(
            Subject.PLACE,
            "used",
            "Regular_Tiling, or the offsets of a `.TIL` file, state the position of each "
            "tile. Amers reads all tiles as one image.",
        ),
        Treatment(
            Subject.PLACE, "refused", "Tiles are missing, overlap, or have another size than stated."
        ),
        Treatment(Subject.UNIT, "refused", "tileUnits is not Pixels."),
        Treatment(Subject.MODEL, "used", "The document names the RPC of the whole image."),
        Treatment(
            Subject.BANDS,
            "named",
            "The product contains a second image, such as NED of Pléiades Neo.",
        ),
        Treatment(Subject.IDENTITY, "used", "The document states the sensor of the product."),
    ),
    never=(
        Subject.PIXEL_ORIGIN,
        Subject.HORIZONTAL_DATUM,
        Subject.VERTICAL_DATUM,
        Subject.EPOCH,
        Subject.ORDER,
        Subject.VALIDITY,
        Subject.ACCURACY,
    ),
)

_TILE = re.compile(r"_R(\d{1,4})C(\d{1,4})(?=[_-]|$)", re.IGNORECASE)
_PNEO_BANDS = re.compile(r"_(?:P|RGB|NED)$", re.IGNORECASE)
_GROUP = re.compile(r"BEGIN_GROUP\s*=\s*TILE_\d+(.*?)END_GROUP", re.DOTALL | re.IGNORECASE)
_BOX = ("ULRowOffset", "ULColOffset", "LRRowOffset", "LRColOffset")
_MAX_SIZE = 100_000_000


@dataclass(frozen=True)
class ProductTile:
    """One file of an image in tiles.

    Attributes:
        document: that states it.
        name: of the file, relative to the document.
        first: line and sample of its first pixel in the whole image.
        shape: its lines and samples.
        product_shape: those of the whole image.
        others: names of other images that the document lists.
    """

    document: FilePlace
    name: str
    first: tuple[int, int]
    shape: tuple[int, int]
    product_shape: tuple[int, int]
    others: tuple[str, ...] = ()


def is_document(path: FilePlace) -> bool:
    """Whether a file has the name of a document of a product."""
    return path.suffix.lower() in (".xml", ".dim", ".til")


def read_product(path: FilePlace) -> list[ProductTile]:
    """The files of the image of a product, in the order of their places.

    Of a product with several images, such as the two groups of bands of Pléiades Neo, those of the first
    one that has the panchromatic band, or red, green and blue.

    Raises:
        FormatError: it is not such a document, or places are missing or impossible.
    """
    text = read_text(path)
    if path.suffix.lower() == ".til":
        return _til_tiles(text, path)
    root = parse_xml(text, path.name)
    if root.tag != "Dimap_Document" or root.find(".//Data_Access") is None:
        raise FormatError(
            f"{path}: <{root.tag[:60]}> found, the document of a product with its files expected "
            "(DIM_….XML, METADATA.DIM or .TIL), or an image"
        )
    return _dimap_tiles(root, path)


def tile_of_product(
    path: FilePlace, siblings: Siblings, model: FilePlace | None = None
) -> ProductTile | None:
    """The place of an image in a product of several files, by the document beside it or its model.

    A converted tile is recognised by `_R2C1` in its name. None for an image that no document lists.

    Args:
        path: of the image.
        siblings: the files beside it.
        model: file of the model, where it was given.

    Raises:
        FormatError: the document cannot be read.
    """
    names = document_names(path.stem)
    documents = [*(siblings.named(names) if names else ()), *siblings.ending(".TIL")]
    numbers = _TILE.search(path.stem)
    if model is not None and numbers is not None:
        product = model.with_name(re.sub("^RPC_", "DIM_", model.name, flags=re.IGNORECASE))
        documents += [product] if product.is_file() and product not in documents else []
    for document in documents:
        if document.suffix.lower() != ".til" and "<Regular_Tiling" not in read_text(document):
            continue
        tiles = read_product(document)
        for tile in tiles if len(tiles) > 1 else ():
            of_name = _TILE.search(tile.name.rpartition(".")[0])
            same_tile = numbers and of_name and of_name.groups() == numbers.groups()
            if tile.name.upper() == path.name.upper() or (same_tile and document.suffix != ".TIL"):
                return tile
    return None


def document_names(stem: str) -> list[str]:
    """The names that the DIMAP document of an image may have."""
    names = [f"DIM_{name}.XML" for name in airbus_names(stem)]
    return [*names, "METADATA.DIM"] if stem.upper() == "IMAGERY" else names


def airbus_names(stem: str) -> list[str]:
    """What follows `DIM_` and `RPC_` in the names of the documents of an image `IMG_…`."""
    if not stem.upper().startswith("IMG_"):
        return []
    name = without_tile(stem)[4:]
    return list(dict.fromkeys([name, _PNEO_BANDS.sub("", name)]))


def without_tile(stem: str) -> str:
    """The name of the whole image of a tile that is called `…_R2C1…`; other names as they are."""
    return _TILE.sub("", stem, count=1)


def _dimap_tiles(root: ElementTree.Element, path: FilePlace) -> list[ProductTile]:
    source = path.name
    shape = (
        whole_number(root, "Raster_Dimensions/NROWS", source, (1, _MAX_SIZE)),
        whole_number(root, "Raster_Dimensions/NCOLS", source, (1, _MAX_SIZE)),
    )
    files, others = _image_files(root, source)
    tiling = root.find(".//Regular_Tiling")
    if len(files) == 1:
        return [ProductTile(path, files[0][0], (0, 0), shape, shape, others)]
    if tiling is None:
        raise FormatError(
            f"{source}: {len(files)} files and no Regular_Tiling found, their places expected"
        )
    size = single(tiling, "NTILES_SIZE", source)
    overlap = [int(tiling.findtext(f"OVERLAP_{axis}", "0")) for axis in ("ROW", "COL")]
    steps = []
    for name, less in zip(("nrows", "ncols"), overlap, strict=True):
        text = size.get(name, "")
        if not text.isdecimal() or int(text) <= less:
            raise FormatError(f"{source}: NTILES_SIZE {name}: {text[:20]!r} found, pixels expected")
        steps.append((int(text), int(text) - less))
    tiles = []
    for name, row, column in files:
        first = ((row - 1) * steps[0][1], (column - 1) * steps[1][1])
        size_px = [min(steps[k][0], shape[k] - first[k]) for k in (0, 1)]
        if min(size_px) <= 0:
            raise FormatError(
                f"{source}: the tile {name[:200]} begins beyond the {shape} pixels of the image"
            )
        tiles.append(ProductTile(path, name, first, (size_px[0], size_px[1]), shape, others))
    return sorted(tiles, key=lambda tile: tile.first)


def _image_files(
    root: ElementTree.Element, source: str
) -> tuple[list[tuple[str, int, int]], tuple[str, ...]]:
    """Name, row and column of the files of one image, and the names of the other images."""
    groups: dict[str, list[tuple[str, int, int]]] = {}
    for entry in root.iter("Data_File"):
        name = single(entry, "DATA_FILE_PATH", source).get("href", "")
        row, column = (entry.get(key, "1") for key in ("tile_R", "tile_C"))
        if not (row.isdecimal() and column.isdecimal() and int(row) and int(column)):
            raise FormatError(
                f"{source}: Data_File: tile {row[:9]!r}, {column[:9]!r} found, numbers from 1 expected"
            )
        stem = name.rpartition(".")[0]
        groups.setdefault(without_tile(stem), []).append((name, int(row), int(column)))
    if not groups:
        raise FormatError(f"{source}: no Data_File found, the files of the image expected")
    visible = [stem for stem in groups if not stem.upper().endswith("_NED")]
    chosen = (visible or list(groups))[0]
    files = groups[chosen]
    if len({(row, column) for _, row, column in files}) < len(files):
        raise FormatError(
            f"{source}: two files have the same tile_R and tile_C, each place once expected"
        )
    return files, tuple(stem for stem in groups if stem != chosen)


def _til_tiles(text: str, path: FilePlace) -> list[ProductTile]:
    units = re.search(r'\btileUnits\s*=\s*"?(\w+)', text)
    if units is not None and units[1].lower() != "pixels":
        raise FormatError(f"{path.name}: tileUnits: {units[1][:20]} found, Pixels expected")
    names: list[str] = []
    boxes: list[list[int]] = []
    for group in _GROUP.findall(text):
        name = re.search(r'\bfilename\s*=\s*"([^"]+)"', group)
        numbers = [int(n) for key in _BOX for n in re.findall(rf"\b{key}\s*=\s*(\d{{1,8}})\s*;", group)]
        if name is None or len(numbers) != len(_BOX):
            raise FormatError(
                f"{path.name}: tile {len(names) + 1}: filename, {', '.join(_BOX)} expected"
            )
        names.append(name[1])
        boxes.append(numbers)
    if not boxes:
        raise FormatError(f"{path.name}: no group TILE_1 found, the tiles of an image expected")
    shape = (max(box[2] for box in boxes) + 1, max(box[3] for box in boxes) + 1)
    tiles = [
        ProductTile(path, name, (top, left), (bottom - top + 1, right - left + 1), shape)
        for name, (top, left, bottom, right) in zip(names, boxes, strict=True)
    ]
    return sorted(tiles, key=lambda tile: tile.first)
