"""Images and masks of a STAC catalogue, with their items for later use."""

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from typing import IO, Any

import numpy as np
import shapely

from amers.services.errors import FormatError
from amers.services.formats.addresses import without_query
from amers.services.formats.stac.documents import Documents, absolute_address, json_bytes
from amers.services.formats.stac.items import StacImage, parse_item, parse_polygons
from amers.services.formats.stac.walk import walk
from amers.services.formats.text_files import load_json
from amers.services.imagery.catalogue import ImageCatalogue
from amers.services.imagery.footprints import footprint_on_ground
from amers.services.types import Progress, no_progress

MOST_PROBLEMS = 20
"""Number of problems whose words are kept; all are counted."""
_REPORTED_EVERY = 500
_LON_LAT_CRS = ("CRS84", "4326")


class NoItems(FormatError):
    """A catalogue has no item, or none of what a search asks for."""


@dataclass(frozen=True)
class StacCatalogue:
    """What was read of a catalogue.

    Attributes:
        images: of the n items that can be used.
        items: their JSON.
        older: number of items before the first time asked for.
        bad: number of items that cannot be used.
        problems: words for the first of them.
        other_masks: number of masks that are no GeoJSON and were not read.
    """

    images: ImageCatalogue
    items: "ItemStore"
    older: int
    bad: int
    problems: tuple[str, ...]
    other_masks: int


class ItemStore:
    """The JSON of items in a temporary file, so that a large catalogue does not fill the memory."""

    def __init__(self) -> None:
        # It lives as long as the store, which no block of code encloses.
        self._file: IO[bytes] = tempfile.TemporaryFile(prefix="amers-items-")  # noqa: SIM115
        self._start: list[int] = []
        self._end = 0

    def add(self, item: dict[str, Any], base: str) -> None:
        """Append an item; its addresses become absolute."""
        assets, links = item.get("assets"), item.get("links")
        members = list(assets.values()) if isinstance(assets, dict) else []
        for member in members + (links if isinstance(links, list) else []):
            if isinstance(member, dict) and isinstance(member.get("href"), str):
                member["href"] = absolute_address(member["href"], base)
        self._start.append(self._end)
        self._end += self._file.write(json_bytes(item))

    def read(self, rows: Iterable[int]) -> Iterator[dict[str, Any]]:
        """The items of some rows."""
        for row in rows:
            self._file.seek(self._start[row])
            yield load_json(self._file.readline().decode(), "an item of the catalogue")


def read_catalogue(
    source: str,
    box: tuple[float, float, float, float] | None = None,
    since: datetime | None = None,
    progress: Progress = no_progress,
    *,
    elsewhere: bool = False,
    collections: tuple[str, ...] = (),
) -> StacCatalogue:
    """The images of a STAC catalogue; items that cannot be used are left out and counted.

    Args:
        source: path of a folder or a file, or address of an API or of a catalogue on a server or in a
            bucket.
        box: west, south, east, north, which a search API is asked for; required with such an API.
        since: items before are left out.
        progress: receives 0 and a message with the number of items.
        elsewhere: whether masks may be on other servers, as those of our own selections.
        collections: ids, which a search API is asked for; all by default.

    Raises:
        NoItems: the source has no item, or none since the time.
        FormatError: the source is no catalogue, or none of its items can be used.
    """
    query = {} if box is None else {"bbox": ",".join(f"{value:.6f}" for value in box)}
    if since is not None:
        query["datetime"] = f"{since:%Y-%m-%dT%H:%M:%SZ}/.."
    if collections:
        query["collections"] = ",".join(collections)
    reader = _Reader(since)
    with ExitStack() as stack:
        documents = stack.enter_context(Documents(source, elsewhere=elsewhere))
        for count, found in enumerate(walk(documents, query)):
            reader.take(documents, found.source, found.base, found.item)
            if count % _REPORTED_EVERY == 0:
                progress(0.0, f"{count} items read")
    return reader.catalogue(source)


class _Reader:
    """Collects the items of a catalogue."""

    def __init__(self, since: datetime | None) -> None:
        self._since = since
        self._items = ItemStore()
        self._images: list[StacImage] = []
        self._masks: list[shapely.Geometry | None] = []
        self._keys: set[tuple[str, str]] = set()
        self._problems: list[str] = []
        self._bad = 0
        self._older = 0

    def take(self, documents: Documents, source: str, base: str, item: Any) -> None:
        """Keep an item, or the reason why it cannot be used."""
        try:
            if isinstance(item, FormatError):
                raise item
            image = parse_item(item, source)
            if image.key in self._keys:
                raise FormatError(f"{source}: id: {image.key[1]!r:.80} found twice, unique ids expected")
            if self._since is not None and image.acquired < self._since:
                self._older += 1
                return
            mask = read_masks(documents, image, base)
        except FormatError as error:
            self._bad += 1
            if len(self._problems) < MOST_PROBLEMS:
                self._problems.append(str(error))
            return
        self._keys.add(image.key)
        self._images.append(image)
        self._masks.append(mask)
        self._items.add(item, base)

    def catalogue(self, source: str) -> StacCatalogue:
        """All that was collected."""
        source = without_query(source)
        if not self._images:
            if self._older:
                raise NoItems(
                    f"{source}: no item to choose from: {self._older} are before the first time asked "
                    f"for, {self._bad} cannot be used; state an earlier time (--since)"
                )
            if self._bad:
                raise FormatError(
                    f"{source}: none of {self._bad} items can be used; the first: {self._problems[0]}"
                )
            raise NoItems(
                f"{source}: no STAC item found; a folder, an item, an item collection, a "
                "catalog, lines of items (.ndjson) or the address of a search API expected"
            )
        other_masks = sum(image.other_masks for image in self._images)
        return StacCatalogue(
            as_catalogue(self._images, self._masks),
            self._items,
            self._older,
            self._bad,
            tuple(self._problems),
            other_masks,
        )


def as_catalogue(images: list[StacImage], masks: list[shapely.Geometry | None]) -> ImageCatalogue:
    """Images as columns."""

    def objects(values: list[Any]) -> Any:
        out = np.empty(len(values), dtype=object)
        out[:] = values
        return out

    numbers = {
        name: np.array([getattr(image, name) for image in images], dtype=np.float64)
        for name in (
            "cloud_percent",
            "snow_percent",
            "incidence_deg",
            "azimuth_deg",
            "sun_elevation_deg",
            "sun_azimuth_deg",
        )
    }
    acquired = [image.acquired.replace(tzinfo=None) for image in images]
    return ImageCatalogue(
        id=objects([image.key[1] for image in images]),
        footprint=objects([image.footprint for image in images]),
        mask=objects(masks),
        acquired=np.array(acquired, dtype="datetime64[ms]"),
        platform=objects([image.platform for image in images]),
        orbit=np.array([image.orbit for image in images], dtype=np.int64),
        **numbers,
    )


def read_masks(documents: Documents, image: StacImage, base: str) -> shapely.Geometry | None:
    """All that hides the ground of an image, as a multipolygon; None where the item has no mask.

    Raises:
        FormatError: a mask cannot be read.
    """
    if not image.masks:
        return None
    polygons: list[shapely.Geometry] = []
    for written in image.masks:
        address = documents.resolved(written, base)
        polygons += parse_mask(documents.read(address), without_query(address))
    return shapely.MultiPolygon(polygons)


def parse_mask(document: Any, source: str) -> list[shapely.Geometry]:
    """The polygons of a mask in GeoJSON, valid, with continuous longitudes.

    Raises:
        FormatError: it has other geometries, or other coordinates than longitude and latitude.
    """
    return _valid_polygons([footprint_on_ground(shape) for shape in _geojson_shapes(document, source)])


def parse_area(document: Any, source: str) -> shapely.Geometry:
    """The polygons of an area in GeoJSON, exactly as written: an area may go round the Earth.

    Raises:
        FormatError: it has no polygons, or other coordinates than longitude and latitude.
    """
    polygons = _valid_polygons(_geojson_shapes(document, source))
    if not polygons:
        raise FormatError(f"{source}: no polygon found, the area as GeoJSON polygons expected")
    return shapely.MultiPolygon(polygons)


def _geojson_shapes(document: Any, source: str) -> list[shapely.Geometry]:
    """All polygons and multipolygons of a GeoJSON document."""
    if not isinstance(document, dict):
        raise FormatError(f"{source}: {document!r:.80} found, GeoJSON expected")
    crs = str(document.get("crs") or _LON_LAT_CRS[0])
    if not any(name in crs for name in _LON_LAT_CRS):
        raise FormatError(f"{source}: crs: {crs:.120} found, longitude and latitude (CRS84) expected")
    features = [document]
    if document.get("type") == "FeatureCollection":
        features = document.get("features")  # type: ignore[assignment]
        if not isinstance(features, list):
            raise FormatError(f"{source}: features: {features!r:.80} found, a list expected")
    shapes = []
    for feature in features:
        is_feature = isinstance(feature, dict) and feature.get("type") == "Feature"
        geometry = feature.get("geometry") if is_feature else feature
        if geometry is not None:
            shapes.append(parse_polygons(geometry, source))
    return shapes


def _valid_polygons(shapes: list[shapely.Geometry]) -> list[shapely.Geometry]:
    parts = shapely.get_parts(np.array(shapes, dtype=object))
    is_valid = shapely.is_valid(parts)
    if not is_valid.all():
        mended = shapely.make_valid(parts[~is_valid])
        parts = np.concatenate([parts[is_valid], shapely.get_parts(shapely.get_parts(mended))])
    return [part for part in parts if part.geom_type == "Polygon" and not part.is_empty]
