"""Images and terrains that consist of several files: folders, lists, archives, catalogues.

| a user names | its pieces |
|---|---|
| a file, an address of one | itself |
| a folder | its files; of images also those in folders below, as in a product of Sentinel-2 (`.SAFE`) |
| `.txt` | one a line, relative to its own folder, or an address |
| `.vrt` of images | the sources of its first band |
| `.zip`, `.tar`, `.tar.gz`, `.tgz` | the files of its folders, unpacked until the process ends |
| a STAC item, collection, catalogue or search: a file, a folder, an address | one asset of each item |

Of the bands of a product of Sentinel-2, and of the Global Reference Image, the red one of 10 m is taken.
Sources: Sentinel-2 Products Specification Document, names of image files; software that downloads the
Global Reference Image, whose items have a tar with the folders `IMG_DATA` and `QI_DATA`.
"""

import re
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from amers.services.errors import FormatError
from amers.services.formats.addresses import Address, FilePlace, file_place
from amers.services.formats.archives import ArchiveLimits, check_archive, unpack_archive
from amers.services.formats.stac.documents import Documents, absolute_address
from amers.services.formats.stac.places import image_place, place_of_address
from amers.services.formats.stac.walk import walk
from amers.services.formats.text_files import parse_xml, read_text
from amers.services.types import Array

MOST_PIECES = 20_000
"""Largest number of pieces: SRTM has 14,000 tiles."""
IMAGE_SUFFIXES = (".tif", ".tiff", ".jp2", ".ntf", ".nitf")
_ARCHIVES = (".zip", ".tar", ".tar.gz", ".tgz")
CATALOGUES = (".json", ".geojson", ".ndjson", ".jsonl", ".geojsonl")
"""Endings of STAC documents, which lead to files elsewhere."""
_ROOTS = ("catalog.json", "collection.json")
_LARGEST_ARCHIVE_BYTES = 100_000_000_000
_BAND = re.compile(r"_(B\d[\dA]|TCI|PVI|AOT|WVP|SCL|CLD|SNW|DDV)(_\d0m)?\.(jp2|tiff?)", re.IGNORECASE)
"""Ending of a file of Sentinel-2: its band, and the sampling of level 2A."""
_NO_IMAGES = ("QI_DATA", "AUX_DATA")


@dataclass(frozen=True)
class PlaceList:
    """Several files, folders or catalogues, as one image or terrain.

    Attributes:
        places: two or more.
    """

    places: tuple[FilePlace, ...]

    @property
    def name(self) -> str:
        """That of the first, and the number of the others."""
        return f"{self.places[0].name} and {len(self.places) - 1} more"

    def __str__(self) -> str:
        """The first, and the number of the others."""
        return f"{self.places[0]} and {len(self.places) - 1} more"


Source = FilePlace | PlaceList
"""What a user names as one image or terrain."""


@dataclass(frozen=True)
class PieceKind:
    """Which files are pieces.

    Attributes:
        what: they are, for messages.
        suffixes: of their names.
        assets: names of the assets of STAC items that are taken first.
        is_deep: folders below a folder are searched, and VRTs are lists.
    """

    what: str
    suffixes: tuple[str, ...]
    assets: tuple[str, ...]
    is_deep: bool

    def fits(self, path: PurePath) -> bool:
        """Whether a file of a folder or an archive is a piece, by its name."""
        name = path.name.lower()
        if name.startswith(".") or not name.endswith(self.suffixes) or name.endswith(".vrt"):
            return False
        if not self.is_deep:
            return True
        if any(part in _NO_IMAGES for part in path.parts):
            return False
        band = _BAND.search(path.name)
        return band is None or (band[1].upper() == "B04" and band[2] in (None, "_10m"))


IMAGES = PieceKind("images on a map", IMAGE_SUFFIXES, ("B04", "red", "visual"), is_deep=True)


def source_of(places: Sequence[str | Path | Address]) -> Source:
    """One image or terrain of what a user names.

    Args:
        places: paths and addresses, at least one.

    Raises:
        FormatError: a path leads nowhere, or an address cannot be read.
    """
    found = tuple(file_place(place) if isinstance(place, str) else place for place in places)
    for place in found:
        if isinstance(place, Path) and not place.exists():
            raise FormatError(f"{place}: expected the name of an existing file or folder, or an address")
    return found[0] if len(found) == 1 else PlaceList(found)


def paths_of(source: Source) -> list[Path]:
    """The paths that a user names, without addresses."""
    places = source.places if isinstance(source, PlaceList) else (source,)
    return [place for place in places if isinstance(place, Path)]


def is_band_of_sentinel_2(place: FilePlace) -> bool:
    """Whether the name of a file is that of a band of Sentinel-2, whose pixels of 0 have no data."""
    return _BAND.search(place.name) is not None


def pieces_of(source: Source, kind: PieceKind, outline: Array | None = None) -> list[FilePlace]:
    """The files of an image or a terrain.

    Args:
        source: what a user names.
        kind: which files are pieces.
        outline: (n, 2) lon, lat; items of catalogues are taken where their boxes meet its box. None
            takes all.

    Raises:
        FormatError: there is none, there are too many, or one cannot be found.
    """
    places = source.places if isinstance(source, PlaceList) else (source,)
    found = dict.fromkeys(
        islice((one for place in places for one in _expanded(place, kind, outline)), MOST_PIECES + 1)
    )
    if not 1 <= len(found) <= MOST_PIECES:
        count = "more" if len(found) > MOST_PIECES else "none"
        raise FormatError(f"{source}: expected {kind.what}, at most {MOST_PIECES:,}, found {count}")
    return list(found)


def _expanded(place: FilePlace, kind: PieceKind, outline: Array | None) -> Iterator[FilePlace]:
    name = place.name.lower()
    if isinstance(place, Address):
        if name.endswith(_ARCHIVES):
            raise FormatError(
                f"{place}: an archive on a server is not read by parts: download it, and give the file"
            )
        yield from [place] if name.endswith(kind.suffixes) else _items(place.url, kind, outline)
    elif place.is_dir():
        if any((place / root).is_file() for root in _ROOTS):
            yield from _items(str(place), kind, outline)
        else:
            yield from _in_folder(place, kind)
    elif name.endswith(CATALOGUES):
        yield from _items(str(place), kind, outline)
    elif name.endswith(_ARCHIVES) and not name.endswith(kind.suffixes):
        state = place.stat()
        yield from _unpacked(place.resolve(), kind, (state.st_size, state.st_mtime_ns))
    elif name.endswith(".txt"):
        yield from _listed(place, kind)
    elif name.endswith(".vrt") and kind.is_deep:
        yield from _sources_of_vrt(place)
    else:
        yield place


def _in_folder(folder: Path, kind: PieceKind) -> list[FilePlace]:
    paths = folder.rglob("*") if kind.is_deep else folder.iterdir()
    found = sorted(path for path in paths if path.is_file() and kind.fits(path.relative_to(folder)))
    if not found:
        raise FormatError(
            f"{folder}: expected a folder with {kind.what}, at most {MOST_PIECES:,}, found 0"
        )
    return list(found)


def _listed(path: Path, kind: PieceKind) -> Iterator[FilePlace]:
    for line in read_text(path).splitlines():
        if line.strip() and not line.strip().startswith("#"):
            place = file_place(line.strip())
            if isinstance(place, Path):
                place = path.parent / place
                if not place.is_file():
                    raise FormatError(
                        f"{path}: {place} does not exist; expected a list of {kind.what}, one a line"
                    )
            yield place


def _sources_of_vrt(path: Path) -> list[FilePlace]:
    """The sources of the first band of a VRT: files, in place of pixels that GDAL would compute."""
    root = parse_xml(read_text(path), path.name)
    band = root.find("VRTRasterBand")
    nodes = [] if band is None or band.get("subClass") else list(band.iter("SourceFilename"))
    found: list[FilePlace] = []
    for node in nodes:
        source = (
            path.parent / (node.text or "") if node.get("relativeToVRT") == "1" else Path(str(node.text))
        )
        if not source.is_file():
            raise FormatError(f"{path}: source {str(node.text)[:80]!r} found, an existing file expected")
        found.append(source)
    if not found:
        raise FormatError(
            f"{path}: no list of files found; a VRT as gdalbuildvrt writes it expected: convert this "
            "one into a GeoTIFF (gdal_translate)"
        )
    return found


@cache
def _unpacking_folder(path: Path, state: tuple[int, int]) -> tempfile.TemporaryDirectory[str]:
    """A folder for the files of an archive in one state; it is removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="amers-pieces-")


def _unpacked(path: Path, kind: PieceKind, state: tuple[int, int]) -> list[FilePlace]:
    limits = ArchiveLimits(_LARGEST_ARCHIVE_BYTES)
    folder = Path(_unpacking_folder(path, state).name)
    wanted = [member.path for member in check_archive(path, limits) if kind.fits(member.path)]
    if not wanted:
        raise FormatError(f"{path}: expected an archive with {kind.what}, found none")
    files = {member: folder / f"{number}-{member.name}" for number, member in enumerate(wanted)}
    missing = {member: file for member, file in files.items() if not file.is_file()}
    if missing:
        unpack_archive(path, missing, limits)
    return list(files.values())


def _items(source: str, kind: PieceKind, outline: Array | None) -> Iterator[FilePlace]:
    """The files of the items of a catalogue."""
    query = {}
    if outline is not None:
        (west, south), (east, north) = outline.min(axis=0), outline.max(axis=0)
        query["bbox"] = f"{west:.6f},{south:.6f},{east:.6f},{north:.6f}"
    with Documents(source) as documents:
        for found in walk(documents, query):
            if isinstance(found.item, FormatError):
                raise found.item
            if outline is None or _meets(found.item.get("bbox"), outline):
                yield from _of_item(found.item, found.base, found.source, kind)


def _meets(box: Any, outline: Array) -> bool:
    """Whether the box of an item meets that of an outline; without a box it may."""
    if not isinstance(box, list) or len(box) not in (4, 6):
        return True
    west, south, east, north = box[0], box[1], box[len(box) // 2], box[len(box) // 2 + 1]
    low, high = outline.min(axis=0), outline.max(axis=0)
    east += 360.0 if east < west else 0.0
    turns = 360.0 * np.arange(-1, 2)
    is_near = ((west + turns <= high[0]) & (east + turns >= low[0])).any()
    return bool(is_near and south <= high[1] and north >= low[1])


def _of_item(item: Any, base: str, source: str, kind: PieceKind) -> Iterator[FilePlace]:
    """The files of an item: its image, or those of its archive."""
    stated = item.get("assets") if isinstance(item, dict) else None
    assets = {
        name: {**asset, "href": absolute_address(asset["href"], base)}
        for name, asset in (stated.items() if isinstance(stated, dict) else ())
        if isinstance(asset, dict) and isinstance(asset.get("href"), str)
    }
    hrefs = [asset["href"] for asset in assets.values()]
    where = f"{source}: item {str(item.get('id'))[:80]!r}"
    packed = [href for href in hrefs if href.lower().endswith(_ARCHIVES)]
    if packed and not any(href.lower().endswith(kind.suffixes) for href in hrefs):
        yield from _expanded(place_of_address(packed[0], where), kind, None)
        return
    yield image_place({**item, "assets": assets}, where, kind.assets)
