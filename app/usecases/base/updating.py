"""Update a base: new dates become views, vanished points leave, gaps fill; only new windows are read."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from amers.app.errors import InputError
from amers.app.usecases.base.made import MadeBase
from amers.app.usecases.base.making import CANDIDATES, CHOSEN, Finishing, Making, PutBlock
from amers.app.usecases.base.request import BaseOptions, BaseRequest, archive_of
from amers.app.usecases.base.search import Candidates, read_candidates, write_candidates
from amers.app.usecases.base.windows import WindowReader
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.new_block import BlockIdentity, refuse_existing
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.production.date_choice import TileArea, choose_dates, places_in
from amers.services.types import Progress, no_progress, part_of

_INPUTS = "inputs.json"
_HERE = ComputeOptions()


@dataclass(frozen=True)
class _Before:
    """What a work folder keeps of the last block."""

    making: Making
    tiles: dict[str, shapely.Geometry]
    images: dict[str, list[str]]
    identity: BlockIdentity


def update_base(
    work: Path,
    folder: Path,
    *,
    catalogues: tuple[str, ...] = (),
    new_dates: int = 2,
    version: str | None = None,
    compute: ComputeOptions = _HERE,
    put: PutBlock | None = None,
    progress: Progress = no_progress,
) -> MadeBase:
    """Make the next version of a base from what was read for the last one, and from newer images.

    Every place gets `new_dates` of the clearest dates after the last ones. Beyond half as many dates
    again as the base was made of, the oldest leave. A point leaves that two of the new dates contradict.

    Args:
        work: folder that the base was made with (`--work`); it has the new images afterwards.
        folder: of the block; must not exist.
        catalogues: to search in place of those of the base.
        new_dates: number of dates that each place gets.
        version: of the block; by default the next number.
        compute: where tasks are computed.
        put: moves the whole block into its folder.
        progress: receives the fraction done and a message.

    Raises:
        InputError: the folder is no such work folder, or there is no newer image.
        ComputationError: the images have too few points in common.
    """
    refuse_existing(folder)
    before = _before(work)
    making = before.making
    if catalogues:
        making = replace(making, request=replace(making.request, catalogues=catalogues))
    old = read_candidates(work / CANDIDATES, making.archive)
    candidates = _with_newer(making, old, before, part_of(progress, 0.0, 0.2))
    write_candidates(work / CANDIDATES, candidates)
    reading = part_of(progress, 0.2, 0.3)
    count = new_dates * len(before.tiles)
    reader = WindowReader(work / "images", making.archive, candidates, making.options, reading, count)
    chosen, recent = _chosen(before, reader, new_dates)
    tiles = [_tile_area(name, polygon, candidates) for name, polygon in before.tiles.items()]
    identity = replace(before.identity, version=version or _next(before.identity.version))
    finishing = Finishing(making, reader, tiles, chosen, recent, compute)
    made = finishing.write(folder, identity, put, part_of(progress, 0.5, 0.5))
    finishing.remember(work / CHOSEN, identity)
    return made


def _before(work: Path) -> _Before:
    if not (work / CHOSEN).is_file() or not (work / _INPUTS).is_file():
        raise InputError(
            f"{work}: no {CHOSEN} found, the work folder of a base expected: make the base with --work"
        )
    inputs = json.loads((work / _INPUTS).read_text(encoding="utf-8"))
    chosen = json.loads((work / CHOSEN).read_text(encoding="utf-8"))
    request = _request(inputs["request"])
    making = Making(
        request,
        BaseOptions(**inputs["options"]),
        shapely.from_wkt(inputs["area"]),
        archive_of(request.source),
    )
    tiles = {name: shapely.from_wkt(polygon) for name, polygon in chosen["tiles"].items()}
    identity = BlockIdentity(chosen["id"], chosen["version"])
    return _Before(making, tiles, chosen["images"], identity)


def _request(document: dict[str, Any]) -> BaseRequest:
    """A request as `inputs.json` has it: paths are texts there."""
    terrain = document["terrain"]
    if terrain is not None:
        places = {name: terrain[name] and Path(terrain[name]) for name in ("dem", "geoid")}
        terrain = TerrainFile(**{**terrain, **places})
    paths = {name: document[name] and Path(document[name]) for name in ("area", "scene", "geoid")}
    box = document["bbox"] and tuple(document["bbox"])
    catalogues = tuple(document["catalogues"])
    return BaseRequest(
        **{**document, **paths, "terrain": terrain, "bbox": box, "catalogues": catalogues}
    )


def _with_newer(making: Making, old: Candidates, before: _Before, progress: Progress) -> Candidates:
    """The candidates with those that catalogues have since the last date of the base."""
    used = {name for of_tile in before.images.values() for name in of_tile}
    newest = max(image.acquired for image in old.images if image.id in used)
    # The heights are in the work folder already.
    heights = making.request.terrain or TerrainFile(Path())
    request = replace(making.request, since=f"{newest:%Y-%m-%d}", terrain=heights)
    found = replace(making, request=request).candidates(progress)
    known = {image.id for image in old.images}
    rows = [row for row, image in enumerate(found.images) if image.id not in known]
    return replace(
        old,
        images=old.images + [found.images[row] for row in rows],
        items=old.items + [found.items[row] for row in rows],
        problems=found.problems,
    )


def _chosen(
    before: _Before, reader: WindowReader, new_dates: int
) -> tuple[dict[str, list[int]], frozenset[str]]:
    """The images of every tile, new ones with them, and the ids of these."""
    images = reader.candidates.images
    number = {image.id: row for row, image in enumerate(images)}
    chosen, recent = {}, set()
    passes: set[str] = set()
    most = int(1.5 * reader.options.dates)
    for name, polygon in before.tiles.items():
        old = [number[one] for one in before.images[name]]
        newest = max((images[row].acquired for row in old), default=None)
        area = _tile_area(name, polygon, reader.candidates)
        later = [row for row in area.images.tolist() if newest is None or images[row].acquired > newest]
        area = replace(area, images=np.array(later, dtype=np.int64))

        def accepted(row: int, area: TileArea = area) -> bool:
            return reader.take(area, row)

        new = choose_dates(area, images, new_dates, accepted, frozenset(passes))
        passes |= {images[row].date for row in new}
        recent |= {images[row].id for row in new}
        kept = sorted(old, key=lambda row: images[row].acquired)[max(0, len(old) + len(new) - most) :]
        chosen[name] = kept + new
    if not recent:
        raise InputError(
            "no newer image is clear enough: the base stays as it is; try again later, or allow more "
            "(--min-clear of the base)"
        )
    return chosen, frozenset(recent)


def _tile_area(name: str, polygon: shapely.Geometry, candidates: Candidates) -> TileArea:
    rows = np.flatnonzero([image.tile == name for image in candidates.images])
    return TileArea(name, polygon, places_in(polygon), rows.astype(np.int64))


def _next(version: str) -> str:
    if not version.isdigit():
        raise InputError(
            f"version {version!r:.40} of the last block is no number: give the next (--version)"
        )
    return str(int(version) + 1)
