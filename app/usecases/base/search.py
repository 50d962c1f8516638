"""What catalogues have for a base, and which images of it are taken."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from amers.app.errors import InputError
from amers.app.usecases.base.request import BaseOptions, BaseRequest, area_km2
from amers.services.errors import FormatError
from amers.services.formats.stac.archive_items import archive_image
from amers.services.formats.stac.catalogue import NoItems, read_catalogue
from amers.services.geodesy import metres_per_degree
from amers.services.imagery.archives import COPERNICUS_DEM, Archive, ArchiveImage
from amers.services.production.chip_sampling import COARSE_FACTOR
from amers.services.production.date_choice import TileArea, choose_dates, tile_areas
from amers.services.types import Progress, no_progress

CHIP_PX = 101
"""Side of a chip."""
_USUAL_PX, _LEAST_PX = 100.0, 25.0
"""Sides of the square of a point: chips of neighbours touch, and overlap by three quarters."""
_FEWEST_SQUARES = 40.0
"""A registration needs six points, and a good one twenty, of those that its scene shows."""
SECONDS_PER_MEGABYTE = 0.4
"""Of a plan: 20 Mbit/s, a slow line of an office."""
SECONDS_PER_POINT_AND_DATE = 0.02
"""Of a plan, of one core: three corners searched in a date, and two chips. A base took 0.008 for the
squares of Berlin (`tests/journeys/test_real_base.py`) and 0.018 for those of a simulated one
(`tests/app/test_base_scenes.py`)."""


@dataclass(frozen=True)
class Candidates:
    """Images of an archive over a region, and files of heights.

    Attributes:
        images: sorted by id.
        items: their items, JSON with absolute addresses; `catalogue` is where each was found.
        terrain: items of the terrain; empty where heights come from files.
        problems: words for items that cannot be used.
    """

    images: list[ArchiveImage]
    items: list[Any]
    terrain: list[Any]
    problems: list[str]


@dataclass(frozen=True)
class PlannedDate:
    """One image of a plan.

    Attributes:
        image: its number among the candidates.
        tile: that it shows.
        pixels: that are read.
        bytes: estimated, with its mask.
    """

    image: int
    tile: str
    pixels: int
    bytes: int


@dataclass(frozen=True)
class BasePlan:
    """What a base will take.

    Attributes:
        area_km2: of the region.
        tiles: with the part of the region that each gives.
        dates: images, tile by tile.
        terrain_bytes: estimated.
        full_pixels: of the whole images.
        points: estimated number.
        read_s, cpu_s: estimated seconds, of reading and of one core.
    """

    area_km2: float
    tiles: list[TileArea]
    dates: list[PlannedDate]
    terrain_bytes: int
    full_pixels: int
    points: int
    read_s: float
    cpu_s: float

    @property
    def bytes(self) -> int:
        """Of images, masks and terrain."""
        return self.terrain_bytes + sum(date.bytes for date in self.dates)


def find_candidates(
    request: BaseRequest,
    archive: Archive,
    area: shapely.Geometry,
    options: BaseOptions,
    progress: Progress = no_progress,
) -> Candidates:
    """Search all catalogues of a request.

    Raises:
        InputError: a catalogue cannot be read, or none has an image that can be used.
    """
    if not request.catalogues:
        raise InputError(
            "--catalogue: nothing found; a folder, a file or the address of a search API expected. "
            "docs/methods/base.md lists public ones"
        )
    wide = widened(area, 2.0 * COPERNICUS_DEM.gsd_m)
    box = shapely.bounds(wide).tolist()
    since = _day(request.since)
    # Items of a terrain have the days of its production, which are before any `since`.
    first = None if request.terrain is None else since
    found: dict[str, tuple[ArchiveImage, Any]] = {}
    terrain: dict[str, Any] = {}
    problems: list[str] = []
    for source in request.catalogues:
        wanted = archive.collections + (() if request.terrain else COPERNICUS_DEM.collections)
        try:
            catalogue = read_catalogue(source, box, first, progress, elsewhere=True, collections=wanted)
        except NoItems as error:
            problems.append(str(error))
            continue
        problems += catalogue.problems
        footprints = catalogue.images.footprint
        rows = np.flatnonzero(shapely.intersects(footprints, wide)).tolist()
        for item in catalogue.items.read(rows):
            if item.get("collection") in COPERNICUS_DEM.collections:
                terrain[item["id"]] = _kept(item, COPERNICUS_DEM, source)
                continue
            try:
                image = archive_image(item, archive, source)
            except FormatError as error:
                problems.append(str(error))
                continue
            is_recent = since is None or image.acquired >= since
            is_clear = 100.0 * image.cloud <= options.max_cloud
            if is_recent and is_clear and shapely.intersects(image.footprint, area):
                found[image.id] = (image, _kept(item, archive, source))
    if not found:
        raise InputError(
            f"no image of {archive.name} with at most {options.max_cloud:g} % cloud shows the region in "
            f"{len(request.catalogues)} catalogues"
            + (f"; the first problem: {problems[0]}" if problems else "")
        )
    if request.terrain is None and not terrain:
        expected = ", ".join(COPERNICUS_DEM.collections)
        raise InputError(
            f"heights of the region: no item of {expected} found in the catalogues; give a catalogue "
            "that has it (--catalogue), or a terrain (--dem)"
        )
    ordered = [found[name] for name in sorted(found)]
    images, items = [image for image, _ in ordered], [item for _, item in ordered]
    heights = [terrain[name] for name in sorted(terrain)]
    return Candidates(images, items, heights, problems)


def write_candidates(path: Path, candidates: Candidates) -> None:
    """Keep what was found, so that an interrupted base goes on with the same images."""
    document = {
        "items": candidates.items,
        "terrain": candidates.terrain,
        "problems": candidates.problems,
    }
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(document), encoding="utf-8")
    partial.rename(path)


def read_candidates(path: Path, archive: Archive) -> Candidates:
    """What `write_candidates` has kept."""
    document = json.loads(path.read_text(encoding="utf-8"))
    items = document["items"]
    images = [archive_image(item, archive, str(path)) for item in items]
    return Candidates(images, items, document["terrain"], document["problems"])


def tiles_of(candidates: Candidates, area: shapely.Geometry, archive: Archive) -> list[TileArea]:
    """The tiles that give the region, each with its part."""
    _, north_m = metres_per_degree(area.centroid.y, 0.0)
    return tile_areas(candidates.images, area, CHIP_PX / 2.0 * archive.gsd_m / north_m)


def chosen_dates(
    candidates: Candidates,
    tiles: Sequence[TileArea],
    options: BaseOptions,
    accept: Callable[[TileArea, int], bool],
) -> dict[str, list[int]]:
    """The images of every tile, in the order of their choice; passes of one are preferred in others."""
    chosen: dict[str, list[int]] = {}
    passes: set[str] = set()
    for tile in tiles:

        def accepted(number: int, tile: TileArea = tile) -> bool:
            return accept(tile, number)

        chosen[tile.tile] = choose_dates(
            tile, candidates.images, options.dates, accepted, frozenset(passes)
        )
        passes |= {candidates.images[number].date for number in chosen[tile.tile]}
    return chosen


def read_area(tile: TileArea, archive: Archive) -> shapely.Geometry:
    """What is read of a tile: its part of the region, with the room for chips and searches."""
    margin_m = CHIP_PX / 2.0 * COARSE_FACTOR * archive.gsd_m * 1.1
    return widened(tile.polygon, margin_m)


def widened(polygon: shapely.Geometry, margin_m: float) -> shapely.Geometry:
    """Polygons with what lies around them, longitude and latitude."""
    scale = np.array(metres_per_degree(polygon.centroid.y, 0.0))
    in_metres = shapely.transform(polygon, lambda lon_lat: lon_lat * scale)
    wider = shapely.buffer(in_metres, margin_m, join_style="mitre")
    return shapely.transform(wider, lambda metres: metres / scale)


def plan_base(
    candidates: Candidates,
    area: shapely.Geometry,
    archive: Archive,
    options: BaseOptions,
    *,
    reads_terrain: bool,
) -> BasePlan:
    """What a base will take, from its catalogue alone; clouds over the region may change its dates."""
    tiles = tiles_of(candidates, area, archive)
    chosen = chosen_dates(candidates, tiles, options, lambda tile, number: True)
    dates, full = [], 0
    for tile in tiles:
        read = read_area(tile, archive)
        for number in chosen[tile.tile]:
            seen = candidates.images[number].footprint
            pixels = math.ceil(area_km2(read.intersection(seen)) * 1e6 / archive.gsd_m**2)
            full += math.ceil(area_km2(seen) * 1e6 / archive.gsd_m**2)
            size = pixels * archive.bytes_per_px * (1.02 if archive.mask else 1.0)
            dates.append(PlannedDate(number, tile.tile, pixels, math.ceil(size)))
    size_km2 = area_km2(area)
    points = math.ceil(size_km2 / (spacing_m(options, archive, size_km2) / 1000.0) ** 2)
    terrain = size_km2 * 1.3e6 / COPERNICUS_DEM.gsd_m**2 * COPERNICUS_DEM.bytes_per_px
    terrain_bytes = math.ceil(terrain) if reads_terrain else 0
    mean_dates = len(dates) / max(1, len(tiles))
    read_s = SECONDS_PER_MEGABYTE * (sum(one.bytes for one in dates) + terrain_bytes) / 1e6
    cpu_s = SECONDS_PER_POINT_AND_DATE * points * mean_dates
    return BasePlan(size_km2, tiles, dates, terrain_bytes, full, points, read_s, cpu_s)


def spacing_m(options: BaseOptions, archive: Archive, size_km2: float) -> float:
    """Side of the square of a point: a hundred pixels, less in a region of few such squares."""
    few_m = 1000.0 * math.sqrt(size_km2 / _FEWEST_SQUARES)
    most_m, least_m = (count * archive.gsd_m for count in (_USUAL_PX, _LEAST_PX))
    return options.spacing_m or max(least_m, min(most_m, few_m))


def _day(text: str | None) -> datetime | None:
    if text is None:
        return None
    try:
        return datetime.strptime(text, "%Y-%m-%d").replace(tzinfo=UTC)
    except ValueError:
        raise InputError(f"--since: {text!r:.40} found, a day such as 2022-01-25 expected") from None


def _kept(item: Any, archive: Archive, source: str) -> Any:
    """An item without the assets that are not needed, and its catalogue."""
    names = {archive.image, archive.mask}
    assets = {name: asset for name, asset in (item.get("assets") or {}).items() if name in names}
    links = [link for link in item.get("links") or [] if link.get("rel") == "self"]
    kept = {name: item.get(name) for name in ("type", "id", "collection", "geometry", "properties")}
    return {**kept, "assets": assets, "links": links, "catalogue": source}
