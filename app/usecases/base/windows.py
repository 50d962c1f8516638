"""Reading the windows of a base into its work folder: each whole or not at all, addresses refreshed."""

import json
import re
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

import shapely

from amers.app.errors import InputError
from amers.app.usecases.base.request import BaseOptions
from amers.app.usecases.base.search import Candidates, read_area
from amers.services.errors import CoverageError, FormatError
from amers.services.formats.addresses import (
    TRAFFIC,
    AccessRefused,
    FilePlace,
    NoUsableReply,
    file_place,
)
from amers.services.formats.images.window_copy import (
    WindowSource,
    clear_share,
    copy_heights,
    copy_window,
)
from amers.services.formats.stac.archive_items import asset_address
from amers.services.formats.stac.documents import Documents, is_address
from amers.services.imagery.archives import COPERNICUS_DEM, Archive
from amers.services.production.date_choice import TileArea
from amers.services.types import Progress, no_progress

_Read = TypeVar("_Read")
_PAUSES_S = (0.5, 2.0, 8.0)
"""Until an image is read again, whose server gave no usable reply; 5xx was tried again before."""
_MOST_SILENT = 3
"""Images in a row that no server gives, after which the work stops: the network is gone."""


@dataclass
class WindowReader:
    """Reads images of an archive into a folder, and remembers why one was not taken.

    Attributes:
        folder: of the copies.
        archive: of the images.
        candidates: images and items.
        options: of the base.
        progress: receives the fraction done and a message with the bytes read.
        expected: number of images that are planned.
        pixels, full_pixels: read, and of the whole images, since the folder began.
        left_out: words for images that were not taken.
    """

    folder: Path
    archive: Archive
    candidates: Candidates
    options: BaseOptions
    progress: Progress = no_progress
    expected: int = 1
    pixels: int = 0
    full_pixels: int = 0
    left_out: list[str] = field(default_factory=list)
    _taken: int = 0
    _silent: int = 0
    _before: int = field(default_factory=lambda: TRAFFIC.bytes)

    @property
    def bytes(self) -> int:
        """Read at addresses so far."""
        return TRAFFIC.bytes - self._before

    def path(self, number: int) -> Path:
        """Of the copy of an image."""
        return self.folder / f"{_file_name(self.candidates.images[number].id)}.tif"

    def take(self, tile: TileArea, number: int) -> bool:
        """Read an image, if it was not read before; whether it is clear enough to be used.

        Raises:
            InputError: no server answers any more.
        """
        record = self.path(number).with_suffix(".json")
        if record.is_file():
            stated = json.loads(record.read_text(encoding="utf-8"))
        else:
            try:
                stated = self._read(tile, number)
                self._silent = 0
            except (NoUsableReply, AccessRefused) as error:
                return self._without_reply(error)
            except (FormatError, CoverageError) as error:
                stated = {"refused": str(error)}
            _write(record, json.dumps(stated))
        if "refused" in stated:
            self.left_out.append(f"{self.candidates.images[number].id}: {stated['refused']}")
            return False
        self.pixels += stated["pixels"]
        self.full_pixels += stated["full_pixels"]
        self._taken += 1
        done = min(1.0, self._taken / max(1, self.expected))
        self.progress(done, f"{self._taken} images, {self.bytes / 1e6:.1f} MB read")
        return True

    def _without_reply(self, error: FormatError) -> bool:
        """Go on with another image for a while; nothing is remembered, so that it is tried again."""
        self._silent += 1
        if self._silent >= _MOST_SILENT:
            raise InputError(
                f"{error}. {_MOST_SILENT} images in a row were not read; give the same command again to "
                "go on"
            ) from None
        self.left_out.append(str(error))
        return False

    def _read(self, tile: TileArea, number: int) -> dict[str, Any]:
        image = self.candidates.images[number]

        def read(item: Any) -> dict[str, Any]:
            mask = None
            if self.archive.mask:
                mask = _place(item, self.archive.mask, image.id)
            source = WindowSource(
                _place(item, self.archive.image, image.id), mask, self.archive, image.offset
            )
            clear = clear_share(source, tile.places)
            least = self.options.min_clear / 100.0 * _shown(image, tile)
            if clear < least:
                return {"refused": f"{100.0 * clear:.0f} % of the region is clear"}
            copied = copy_window(source, read_area(tile, self.archive), self.path(number))
            full = copied.full
            return {
                "pixels": copied.pixels,
                "full_pixels": full[0] * full[1],
                "clear": clear,
                "valid": copied.valid,
            }

        return with_fresh_addresses(self.candidates.items, number, self.archive, read)

    def clear_of(self, name: str) -> float:
        """The same by the id of the image."""
        return self.clear([image.id for image in self.candidates.images].index(name))

    def clear(self, number: int) -> float:
        """Clear share of the region in an image that was taken."""
        record = self.path(number).with_suffix(".json")
        return float(json.loads(record.read_text(encoding="utf-8"))["clear"])


def with_fresh_addresses(
    items: list[Any], number: int, archive: Archive, read: Callable[[Any], _Read]
) -> _Read:
    """What is read of an item, once more with new addresses where a server refuses the old ones.

    A server that gives no usable reply, such as 429, is asked again after pauses; ranges that were read
    stay in memory.

    Args:
        items: of the archive; the one that is read is replaced by its new state.
        number: of the item.
        archive: says who signs addresses.
        read: of an item.

    Raises:
        AccessRefused: the catalogue has no new addresses, or they are refused, too.
    """
    if archive.sign:
        items[number] = _signed(items[number], archive)
    try:
        return _patiently(read, items[number])
    except AccessRefused:
        fresh = _signed(items[number], archive) if archive.sign else refreshed(items[number])
        if fresh is None:
            raise
        items[number] = fresh
        return _patiently(read, fresh)


def _patiently(read: Callable[[Any], _Read], item: Any) -> _Read:
    for pause_s in _PAUSES_S:
        try:
            return read(item)
        except NoUsableReply:
            time.sleep(pause_s)
    return read(item)


def refreshed(item: Any) -> Any | None:
    """An item as its catalogue states it now, with new addresses; None where it has no address."""
    source = item["catalogue"]
    links = [link["href"] for link in item["links"] if link.get("rel") == "self"]
    if not links or not is_address(links[0]) or not is_address(source):
        return None
    with Documents(source) as documents:
        fresh = documents.read(documents.resolved(links[0], source))
    if not isinstance(fresh, dict) or fresh.get("id") != item["id"]:
        return None
    return {**item, "assets": fresh.get("assets")}


def read_terrain_windows(
    candidates: Candidates, area: shapely.Geometry, folder: Path, progress: Progress = no_progress
) -> Path:
    """Copy the heights of a region from the terrain of its catalogues; the folder with their tiles.

    Raises:
        InputError: the catalogues have no terrain there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for number, item in enumerate(candidates.terrain):
        path = folder / f"{_file_name(item['id'])}.tif"

        def read(item: Any, path: Path = path) -> int:
            return copy_heights(_place(item, COPERNICUS_DEM.image, item["id"]), area, path)

        if not path.is_file():
            try:
                with_fresh_addresses(candidates.terrain, number, COPERNICUS_DEM, read)
            except CoverageError:
                continue
        progress(0.0, f"heights of {number + 1} of {len(candidates.terrain)} tiles")
    if not any(folder.glob("*.tif")):
        raise InputError("heights of the region: the files of the catalogues do not show it; give --dem")
    return folder


def _file_name(name: str) -> str:
    """A file name for an id, of no other id."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", name)
    return plain if plain == name else f"{plain}-{zlib.crc32(name.encode()):08x}"


def _shown(image: Any, tile: TileArea) -> float:
    """Share of the region of a tile that an image shows: clouds count within it."""
    return float(shapely.contains_xy(image.footprint, tile.places).mean())


def _place(item: Any, asset: str, name: str) -> FilePlace:
    address = asset_address(item, asset, name)
    place = file_place(address.removeprefix("file://"))
    if is_address(item["catalogue"]) and isinstance(place, Path):
        raise FormatError(
            f"{name}: {asset}: its catalogue on a server leads to a file of this machine; an address "
            "(https://, s3://) expected"
        )
    return place


def _signed(item: Any, archive: Archive) -> Any:
    """An item whose addresses the service of the archive has signed."""
    assets = {}
    for name, asset in item["assets"].items():
        plain = asset["href"].partition("?")[0]
        address = archive.sign.replace("{href}", quote(plain, safe=""))
        with Documents(address) as documents:
            reply = documents.read(address)
        if not isinstance(reply, dict) or not isinstance(reply.get("href"), str):
            raise FormatError(f"{archive.sign}: href: nothing found, a signed address expected")
        assets[name] = {**asset, "href": reply["href"]}
    return {**item, "assets": assets}


def _write(path: Path, text: str) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(text, encoding="utf-8")
    partial.rename(path)
