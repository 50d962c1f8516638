"""Make a base: search, choose and read images of an archive, find points that last, write a block."""

import json
import math
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from amers.app.usecases.base.made import BaseSource, MadeBase, report_folder, write_base_report
from amers.app.usecases.base.request import BaseOptions, BaseRequest, archive_of, area_km2, area_of
from amers.app.usecases.base.search import (
    BasePlan,
    Candidates,
    chosen_dates,
    find_candidates,
    plan_base,
    read_area,
    read_candidates,
    spacing_m,
    write_candidates,
)
from amers.app.usecases.base.tile_points import (
    PlacedDates,
    opened_tiles,
    placed_dates,
    points_of_tiles,
)
from amers.app.usecases.base.windows import WindowReader, read_terrain_windows
from amers.app.usecases.executors import ComputeOptions, open_executor
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.new_block import (
    BlockIdentity,
    block_metadata,
    fewest_views,
    points_per_km2,
    refuse_existing,
)
from amers.app.usecases.registration.result_folder import older_result
from amers.app.usecases.terrain_file import TerrainFile, read_terrain
from amers.services.formats.addresses import without_query
from amers.services.formats.block.document import AccuracyFigure, BlockMetadata, BlockSpecification
from amers.services.formats.block.writer import write_block
from amers.services.formats.work_folder import WorkFolder
from amers.services.geodesy import box_around
from amers.services.imagery.archives import COPERNICUS_DEM, Archive
from amers.services.production.date_choice import TileArea
from amers.services.production.joined_points import TilePoints, joined_points
from amers.services.production.ortho_production import GroundHeights
from amers.services.tasks import Effort, Work
from amers.services.types import ControlPoints, Frame, Progress, no_progress, part_of

CANDIDATES, CHOSEN = "candidates.json", "chosen.json"
"""Files of a work folder: what catalogues have, and what the last block was made of."""
_OPTIONS, _HERE = BaseOptions(), WorkPlace()

PutBlock = Callable[[Path], object]
"""Moves a whole block, which lies beside its folder, into it: one that is published, for example."""


@dataclass(frozen=True)
class Making:
    """A request with what it means.

    Attributes:
        request: where, and of what.
        options: of dates and points.
        area: the region.
        archive: of the images.
    """

    request: BaseRequest
    options: BaseOptions
    area: shapely.Geometry
    archive: Archive

    def candidates(self, progress: Progress) -> Candidates:
        """What the catalogues have."""
        return find_candidates(self.request, self.archive, self.area, self.options, progress)

    def plan(self, candidates: Candidates) -> BasePlan:
        """Which of it is read."""
        reads_terrain = self.request.terrain is None
        return plan_base(candidates, self.area, self.archive, self.options, reads_terrain=reads_terrain)

    def heights(self, candidates: Candidates, tiles: Sequence[TileArea], kept: Path) -> GroundHeights:
        """The heights of the ground, of the files of the user or of the catalogues."""
        sigma_m, up_m = self.options.height_sigma_m, self.options.frame_sigma_up_m
        if self.request.terrain is not None:
            terrain = read_terrain(self.request.terrain, sigma_m)
            return GroundHeights(terrain, frame_sigma_m=math.nan if up_m is None else up_m)
        area = shapely.union_all([read_area(tile, self.archive) for tile in tiles])
        folder = read_terrain_windows(candidates, area, kept / "terrain")
        stated = COPERNICUS_DEM.accuracy[0]
        file = TerrainFile(folder, "EGM2008", self.request.geoid)
        terrain = read_terrain(file, sigma_m or stated.own_m)
        return GroundHeights(terrain, frame_sigma_m=up_m or stated.common_m)


def plan(
    request: BaseRequest, options: BaseOptions = _OPTIONS, progress: Progress = no_progress
) -> tuple[BasePlan, Candidates]:
    """What a base will take; only catalogues are read.

    Raises:
        InputError: the region, the archive or a catalogue cannot be used.
    """
    making = Making(request, options, area_of(request), archive_of(request.source))
    candidates = making.candidates(progress)
    return making.plan(candidates), candidates


def make_base(
    request: BaseRequest,
    folder: Path,
    identity: BlockIdentity,
    options: BaseOptions = _OPTIONS,
    *,
    place: WorkPlace = _HERE,
    put: PutBlock | None = None,
    progress: Progress = no_progress,
) -> MadeBase:
    """Make a base and write its block; an interrupted one goes on when it is made again.

    Args:
        request: where, and of what.
        folder: of the block; must not exist.
        identity: of the block.
        options: of dates and points.
        place: of the work; its folder keeps what was read.
        put: moves the whole block into its folder.
        progress: receives the fraction done and a message.

    Raises:
        InputError: something that was given cannot be used, or the folder exists.
        ComputationError: the images have too few points in common.
    """
    refuse_existing(folder)
    older_result(report_folder(folder))
    making = Making(request, options, area_of(request), archive_of(request.source))
    kept = place.folder or folder.with_name(f"{folder.name}.work")
    WorkFolder(kept, _inputs(making))
    (kept / "images").mkdir(exist_ok=True)
    if not (kept / CANDIDATES).is_file():
        write_candidates(kept / CANDIDATES, making.candidates(part_of(progress, 0.0, 0.1)))
    candidates = read_candidates(kept / CANDIDATES, making.archive)
    planned = making.plan(candidates)
    reading = part_of(progress, 0.1, 0.4)
    reader = WindowReader(
        kept / "images", making.archive, candidates, options, reading, len(planned.dates)
    )
    chosen = chosen_dates(candidates, planned.tiles, options, reader.take)
    finishing = Finishing(making, reader, planned.tiles, chosen, frozenset(), place.compute)
    made = finishing.write(folder, identity, put, part_of(progress, 0.5, 0.5))
    if place.folder is None:
        shutil.rmtree(kept)
    else:
        finishing.remember(kept / CHOSEN, identity)
    return made


@dataclass(frozen=True)
class Finishing:
    """A base whose images are read.

    Attributes:
        making: its request.
        reader: of its images.
        tiles: parts of the region.
        chosen: numbers of the images of every tile.
        recent: ids of images that must show a point for it to stay.
        compute: where tasks are computed.
    """

    making: Making
    reader: WindowReader
    tiles: list[TileArea]
    chosen: dict[str, list[int]]
    recent: frozenset[str]
    compute: ComputeOptions

    def write(
        self, folder: Path, identity: BlockIdentity, put: PutBlock | None, progress: Progress
    ) -> MadeBase:
        """Make the points, write the block beside its folder, and put it there.

        Raises:
            InputError: heights cannot be used.
            ComputationError: the images have too few points in common.
        """
        making, reader = self.making, self.reader
        with ExitStack() as stack:
            executor, ahead = stack.enter_context(open_executor(self.compute))
            work = Work(executor, ahead=ahead)
            tiles = opened_tiles(self.tiles, self.chosen, reader, stack)
            heights = making.heights(reader.candidates, self.tiles, reader.folder.parent)
            gsd_m = making.archive.gsd_m
            placed = placed_dates(tiles, heights, gsd_m, work, part_of(progress, 0.0, 0.2))
            searching = part_of(progress, 0.2, 0.6)
            parts = points_of_tiles(placed, heights, reader, self.recent, work=work, progress=searching)
            frame = Frame.from_sigmas(placed.frames.sigma_m, heights.frame_sigma_m)
            least_m = 0.7 * spacing_m(making.options, making.archive, area_km2(making.area))
            points, chips = joined_points(parts, heights, frame, least_m)
            made = _made(making, points, placed, reader, parts, effort=work.effort)
            metadata = _metadata(identity, making, made, parts[0].production.gsds_m)
            whole = folder.with_name(f"{folder.name}.whole")
            shutil.rmtree(whole, ignore_errors=True)
            write_block(whole, metadata, points, chips, {}, progress=part_of(progress, 0.8, 0.2))
        # Before the block, whose folder would refuse the run that makes up for a missing report.
        unused = len(reader.candidates.problems)
        source = BaseSource(making.area, making.archive, catalogues_of(making.request), unused)
        write_base_report(folder, identity.id, made, source)
        if put is None:
            whole.rename(folder)
        else:
            put(whole)
        return made

    def remember(self, path: Path, identity: BlockIdentity) -> None:
        """Keep what an update needs: tiles, images, name and version."""
        images = self.reader.candidates.images
        document = {
            "id": identity.id,
            "version": identity.version,
            "tiles": {tile.tile: shapely.to_wkt(tile.polygon, 9) for tile in self.tiles},
            "images": {name: [images[n].id for n in of_tile] for name, of_tile in self.chosen.items()},
        }
        partial = path.with_suffix(".partial")
        partial.write_text(json.dumps(document), encoding="utf-8")
        partial.rename(path)


def catalogues_of(request: BaseRequest) -> tuple[str, ...]:
    """The catalogues of a request without signatures."""
    return tuple(without_query(one) for one in request.catalogues)


def _inputs(making: Making) -> dict[str, Any]:
    """What the content of a work folder depends on; signatures of addresses change."""
    request = asdict(making.request)
    request["catalogues"] = list(catalogues_of(making.request))
    return {
        "request": request,
        "options": asdict(making.options),
        "archive": asdict(making.archive),
        "area": shapely.to_wkt(making.area),
    }


def _made(
    making: Making,
    points: ControlPoints,
    placed: PlacedDates,
    reader: WindowReader,
    parts: list[TilePoints],
    *,
    effort: dict[str, Effort],
) -> MadeBase:
    local_m = np.array([part.production.local_sigma_m for part in parts])
    images = [image for tile in placed.tiles for image in tile.images]
    years = sorted({image.acquired.year for image in images})
    span = str(years[0]) if years[0] == years[-1] else f"{years[0]}-{years[-1]}"
    attribution = making.archive.attribution.replace("{years}", span)
    if making.request.terrain is None:
        attribution += f"; heights: {COPERNICUS_DEM.attribution}"
    return MadeBase(
        points=points,
        placed=placed,
        area_km2=area_km2(making.area),
        left_out=reader.left_out + placed.left_out,
        bytes=reader.bytes,
        pixels=reader.pixels,
        full_pixels=reader.full_pixels,
        local_sigma_m=float(np.nanmax(local_m)) if np.isfinite(local_m).any() else math.nan,
        clear={image.id: reader.clear_of(image.id) for image in images},
        attribution=attribution,
        effort=effort,
    )


def _metadata(
    identity: BlockIdentity, making: Making, made: MadeBase, gsds_m: tuple[float, ...]
) -> BlockMetadata:
    points, placed, archive = made.points, made.placed, making.archive
    title = identity.title or f"{identity.id}. {made.attribution.partition(';')[0]}"
    return block_metadata(
        replace(identity, title=title),
        [scene.acquisition for tile in placed.tiles for scene in tile.scenes],
        points,
        description=(
            f"{len(points)} ground control points with chips, from {made.images} images of "
            f"{archive.name} on {len(placed.dates)} dates. {made.attribution}"
        ),
        outline=box_around(points.lon_lat_h),
        specification=BlockSpecification(
            gsds_m, fewest_views(points), points_per_km2(making.options.spacing_m)
        ),
        options={
            **asdict(making.options),
            "archive": archive.name,
            "catalogues": list(catalogues_of(making.request)),
            "attribution": made.attribution,
            "terms": archive.terms,
        },
        accuracy=_accuracy(made, archive),
    )


def _accuracy(made: MadeBase, archive: Archive) -> tuple[AccuracyFigure, ...]:
    """The stated accuracies of a base, with what they were compared with."""
    frames, count = made.placed.frames, len(made.placed.dates)
    against = f"the statement of the producer of {archive.name}, not exceeded by the dates"
    if frames.sigma_m > frames.stated_m:
        against = f"the disagreement of {count} dates of {max(1, frames.orbits)} orbits"
    figures = [
        AccuracyFigure("absolute", "frame_sigma_m", frames.sigma_m, count, against),
        AccuracyFigure("absolute", "dates_apart_m", frames.apart_m, count, "each other, at most"),
    ]
    if math.isfinite(made.local_sigma_m):
        disagreement = "the disagreement of the images, after one shift of each"
        name = "local_sigma_m"
        figures.append(
            AccuracyFigure("relative", name, made.local_sigma_m, len(made.points), disagreement)
        )
    return tuple(figures)
