"""Export the served points of a box as a new block: select them in the store, write a block folder."""

import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from amers.app.auth import Scope
from amers.app.db import blocks, points
from amers.app.db.engine import Connection
from amers.app.db.points import StoredPoints
from amers.app.db.tokens import Token
from amers.app.errors import InputError, NotFound
from amers.app.usecases.damage import open_chips
from amers.app.usecases.processes import Commit, Process, Work
from amers.app.usecases.results import store_results
from amers.services.formats.block.document import (
    NAME_PATTERN,
    AccuracyFigure,
    BlockMetadata,
    BlockSpecification,
    Provenance,
    rectangle,
)
from amers.services.formats.block.document_json import parse_block_json
from amers.services.formats.block.writer import write_block
from amers.services.quality.frames import shared_frame
from amers.services.types import (
    Array,
    ChipArray,
    ChipSource,
    ControlPoints,
    Frame,
    Progress,
    no_progress,
    part_of,
    point_chips,
)

MOST_POINTS = 50_000
"""Limit of an export on request; the command line has none."""
FRAME_FIGURE = "frame_sigma_m"
ARCHIVE = "block.zip"


@dataclass(frozen=True)
class ExportBlock:
    """The inputs of an export.

    Attributes:
        bbox: west, south, east, north in degrees; west greater than east crosses the antimeridian.
        id, version, title: of the new block.
    """

    bbox: tuple[float, float, float, float]
    id: str = "extract"
    version: str = "1"
    title: str = ""


@dataclass(frozen=True)
class SelectedPoints:
    """Points of the store that make a new block.

    Attributes:
        metadata: id of the new block.
        points: with the keys of their chip files in the storage.
        typology: what each point is on the ground; None where unknown.
    """

    metadata: BlockMetadata
    points: ControlPoints
    typology: Sequence[str | None]


def bbox_outline(bbox: tuple[float, ...]) -> Array:
    """The outline (4, 2) of a box.

    Raises:
        InputError: the numbers are not west, south, east, north in degrees.
    """
    west, south, east, north = bbox if len(bbox) == 4 else (np.nan,) * 4
    if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south < north <= 90):
        raise InputError(f"bbox: {list(bbox)} found, west, south, east, north in degrees expected")
    return rectangle(west, south, east, north)


def select_points(
    connection: Connection, inputs: ExportBlock, most: int | None = None
) -> SelectedPoints:
    """Read the points that are served in a box, and describe the block that they make.

    Args:
        connection: of a snapshot: the points and their blocks are read by several statements.
        inputs: the box, and the name of the block.
        most: the limit of the number of points; None for no limit.

    Raises:
        NotFound: no points are served in the box.
        InputError: the box or the name cannot be used, or the points exceed the limit.
    """
    outline = bbox_outline(inputs.bbox)
    if not NAME_PATTERN.fullmatch(inputs.id) or not inputs.version:
        raise InputError(
            f"id, version: {inputs.id!r:.120} {inputs.version!r:.120} cannot name a block; expected a "
            "letter, then letters, digits, dots, dashes or underscores, and a version"
        )
    stored = points.control_points(connection, outline, None if most is None else most + 1)
    if len(stored.points) == 0:
        raise NotFound(
            f"bbox: no points are served in {list(inputs.bbox)}; choose a box on a published block"
        )
    if most is not None and len(stored.points) > most:
        raise InputError(f"bbox: more than {most} points lie in the box; choose a smaller box")
    sources = [
        parse_block_json(blocks.find_document(connection, block.number)).metadata
        for block in stored.blocks
    ]
    selected = replace(
        _with_unique_images(stored), surface=blocks.find_surface_heights(connection, stored.points.id)
    )
    typology = blocks.find_typology(connection, stored.points.id)
    return SelectedPoints(_metadata(inputs, outline, selected, stored, sources), selected, typology)


def write_selected(
    selected: SelectedPoints, chips: ChipSource, folder: Path, progress: Progress = no_progress
) -> int:
    """Write points with their chips into a new block folder; returns the number of points.

    Args:
        selected: the points.
        chips: of the storage.
        folder: must not exist.
        progress: receives the fraction done and a message.

    Raises:
        DamagedFile: chips are missing or do not have their checksums; nothing is written.
    """
    write_block(
        folder,
        selected.metadata,
        selected.points,
        _chip_reader(selected.points, chips),
        {},
        typology=selected.typology,
        progress=progress,
    )
    return len(selected.points)


def _metadata(
    inputs: ExportBlock,
    outline: Array,
    selected: ControlPoints,
    stored: StoredPoints,
    sources: Sequence[BlockMetadata],
) -> BlockMetadata:
    names = tuple(f"{block.id}@{block.version}" for block in stored.blocks)
    views = selected.views
    images_per_point = [
        len(set(views.image[first:end].tolist()))
        for first, end in zip(views.start[:-1], views.start[1:], strict=True)
    ]
    frame = shared_frame(selected, np.ones(len(selected), dtype=np.bool_))
    epochs = {source.epoch for source in sources}
    return BlockMetadata(
        id=inputs.id,
        version=inputs.version,
        title=inputs.title or f"Points of {', '.join(names)}",
        description="Points served in a box. Covariances are relative to the frame of the block that "
        f"each point comes from: {', '.join(names)}.",
        license=" AND ".join(sorted({source.license for source in sources})),
        extent=outline,
        created=datetime.now(UTC),
        specification=BlockSpecification(
            gsds_m=tuple(np.unique(views.gsd_m).tolist()), min_views=min(images_per_point)
        ),
        provenance=Provenance("amers", "export", names, {"bbox": list(inputs.bbox)}),
        epoch=epochs.pop() if len(epochs) == 1 else None,
        accuracy=sources[0].accuracy if len(sources) == 1 else _frame_figure(frame),
        frame=frame,
    )


def _frame_figure(frame: Frame) -> tuple[AccuracyFigure, ...]:
    """The frame of points of several blocks as a figure, if all blocks state theirs."""
    sigma_m = float(np.sqrt(np.diagonal(frame.covariance_m2)[:2].max()))
    if not np.isfinite(sigma_m):
        return ()
    return (AccuracyFigure("absolute", FRAME_FIGURE, sigma_m, 0, "as stated by the source blocks"),)


def _with_unique_images(stored: StoredPoints) -> ControlPoints:
    """The points with only the images they use, each under a name that no other image has."""
    views = stored.points.views
    used, image = np.unique(views.image, return_inverse=True)
    block_of_view = np.repeat(stored.points.id, np.diff(views.start)) >> blocks.ID_BITS
    block_of_image = np.zeros(len(used), dtype=np.int64)
    block_of_image[image] = block_of_view
    block_ids = {block.number: block.id for block in stored.blocks}
    names = [views.images[row].image_id for row in used]
    images = tuple(
        replace(views.images[row], image_id=f"{block_ids[int(block_of_image[i])]}.{names[i]}")
        if names.count(names[i]) > 1
        else views.images[row]
        for i, row in enumerate(used)
    )
    return replace(stored.points, views=replace(views, image=image.astype(np.int64), images=images))


def _chip_reader(selected: ControlPoints, chips: ChipSource) -> Callable[[int], ChipArray]:
    """Reads the chips of the point of a row; 8-bit chips become 16-bit if some of the chips have 16."""
    dtypes = {chips.read(file, 0, 1).dtype for file in selected.chip_files}
    dtype = max(dtypes, key=lambda kind: kind.itemsize)

    def read(row: int) -> ChipArray:
        point: ChipArray = point_chips(selected, chips, row).astype(dtype, copy=False)
        return point

    return read


def _check(connection: Connection, caller: Token, inputs: ExportBlock) -> None:
    bbox_outline(inputs.bbox)


def _run(work: Work) -> Commit:
    """Export into an archive in the storage; no transaction is open while files are written."""
    work.progress(0.0, "reading points")
    with work.database.snapshot() as connection:
        selected = select_points(connection, work.inputs, MOST_POINTS)
    chips = open_chips(work.database, work.storage)
    try:
        with TemporaryDirectory(prefix="amers-export-") as scratch:
            folder = Path(scratch) / "block"
            n_points = write_selected(selected, chips, folder, part_of(work.progress, 0.1, 0.7))
            archive = Path(scratch) / ARCHIVE
            # Stored, not compressed: chips are close to noise, and the block has its checksums.
            with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as packed:
                for path in sorted(folder.rglob("*")):
                    packed.write(path, path.relative_to(folder.parent))
            keys = store_results(work, {ARCHIVE: archive})
    finally:
        chips.close()

    def commit(connection: Connection) -> dict[str, Any]:
        return {"points": n_points, "files": keys}

    return commit


EXPORT_BLOCK = Process(
    id="export-block",
    title="Export points as a block",
    description="Write the served points of a bounding box, with their chips, as a block that "
    "can be downloaded.",
    scope=Scope.READ,
    inputs=ExportBlock,
    outputs={ARCHIVE: "The block: a zip of its folder."},
    check=_check,
    run=_run,
    values={"points": {"type": "integer", "title": "Points written"}},
)
