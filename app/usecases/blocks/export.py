"""Points of the store as a block again: what is served inside an outline, to take elsewhere."""

import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from app.auth import Scope
from app.db import blocks, points
from app.db.engine import Connection
from app.db.points import StoredPoints
from app.db.tokens import Token
from app.errors import InputError, NotFound
from app.storage import StoredChips
from app.usecases.processes import Commit, Process, Work
from services.formats.block.document import (
    NAME_PATTERN,
    AccuracyFigure,
    BlockDocument,
    BlockMetadata,
    BlockSpecification,
    Provenance,
    rectangle,
)
from services.formats.block.document_json import parse_block_json
from services.formats.block.writer import write_block
from services.types import (
    Array,
    ChipArray,
    ChipSource,
    ControlPoints,
    Progress,
    no_progress,
    part_of,
    point_chips,
)

MOST_POINTS = 50_000
"""Of an export by request; the command line writes as many as there are."""
FRAME = "frame_sigma_m"
ARCHIVE = "block.zip"


@dataclass(frozen=True)
class ExportBlock:
    """What somebody says to have points as a block.

    Attributes:
        bbox: west, south, east, north in degrees; west greater than east crosses the antimeridian.
        id, version, title: of the new block.
    """

    bbox: tuple[float, float, float, float]
    id: str = "extract"
    version: str = "1"
    title: str = ""


def bbox_outline(bbox: tuple[float, ...]) -> Array:
    """The outline (4, 2) of a box.

    Raises:
        InputError: these are not west, south, east, north in degrees.
    """
    west, south, east, north = bbox if len(bbox) == 4 else (np.nan,) * 4
    if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south < north <= 90):
        raise InputError(f"bbox: {list(bbox)} found, west, south, east, north in degrees expected")
    return rectangle(west, south, east, north)


def export_block(
    connection: Connection,
    chips: ChipSource,
    inputs: ExportBlock,
    folder: Path,
    most: int | None = None,
    progress: Progress = no_progress,
) -> int:
    """Write the points that are served in a box into a new block folder.

    Args:
        chips: of the storage.
        inputs: the box, and what the block is called.
        folder: must not exist.
        most: refuse to write more points.
        progress: told while chips are written.

    Returns:
        How many points were written.

    Raises:
        NotFound: no points are served there.
        InputError: box, names or number of points cannot be used.
    """
    outline = bbox_outline(inputs.bbox)
    if not NAME_PATTERN.fullmatch(inputs.id) or not inputs.version:
        raise InputError(f"id, version: {inputs.id!r:.120} {inputs.version!r:.120} cannot name a block")
    progress(0.0, "reading points")
    stored = points.control_points(connection, outline, None if most is None else most + 1)
    if len(stored.points) == 0:
        raise NotFound(f"no points are served in {list(inputs.bbox)}")
    if most is not None and len(stored.points) > most:
        raise InputError(f"more than {most} points lie in the box, the most that are exported")
    sources = {
        block.number: parse_block_json(blocks.find_document(connection, block.number))
        for block in stored.blocks
    }
    chosen = _with_unique_images(stored)
    typology = blocks.find_typology(connection, stored.points.id)
    write_block(
        folder,
        _metadata(inputs, outline, chosen, stored, sources),
        chosen,
        _reading(chosen, chips),
        {},
        typology=typology,
        progress=part_of(progress, 0.1, 0.9),
    )
    return len(chosen)


def _metadata(
    inputs: ExportBlock,
    outline: Array,
    chosen: ControlPoints,
    stored: StoredPoints,
    sources: Mapping[int, BlockDocument],
) -> BlockMetadata:
    said = [document.metadata for document in sources.values()]
    names = tuple(f"{block.id}@{block.version}" for block in stored.blocks)
    seen = [
        len(set(chosen.views.image[a:b].tolist()))
        for a, b in zip(chosen.views.start[:-1], chosen.views.start[1:], strict=True)
    ]
    epochs = {one.epoch for one in said}
    return BlockMetadata(
        id=inputs.id,
        version=inputs.version,
        title=inputs.title or f"Points of {', '.join(names)}",
        description="Points served in a box. Covariances are relative to the frame of the block that "
        f"each point comes from: {', '.join(names)}.",
        license=" AND ".join(sorted({one.license for one in said})),
        extent=outline,
        created=datetime.now(UTC),
        specification=BlockSpecification(
            gsds_m=tuple(np.unique(chosen.views.gsd_m).tolist()), min_views=min(seen)
        ),
        provenance=Provenance("amers", "export", names, {"bbox": list(inputs.bbox)}),
        epoch=epochs.pop() if len(epochs) == 1 else None,
        accuracy=said[0].accuracy if len(said) == 1 else _worst_frame(stored),
    )


def _worst_frame(stored: StoredPoints) -> tuple[AccuracyFigure, ...]:
    """The frame of the points of several blocks, if each of these says how well its own is known."""
    sigmas = [block.frame_sigma_m for block in stored.blocks]
    if any(sigma is None for sigma in sigmas):
        return ()
    worst = max(sigma for sigma in sigmas if sigma is not None)
    return (AccuracyFigure("absolute", FRAME, worst, 0, "as stated by the worst of the source blocks"),)


def _with_unique_images(stored: StoredPoints) -> ControlPoints:
    """The points with the images that they name, each by a name that no other has."""
    views = stored.points.views
    used, image = np.unique(views.image, return_inverse=True)
    owner = np.repeat(stored.points.id, np.diff(views.start)) >> blocks.ID_BITS
    number = np.zeros(len(used), dtype=np.int64)
    number[image] = owner
    of_block = {block.number: block.id for block in stored.blocks}
    names = [views.images[row].image_id for row in used]
    images = tuple(
        replace(views.images[row], image_id=f"{of_block[int(number[i])]}.{names[i]}")
        if names.count(names[i]) > 1
        else views.images[row]
        for i, row in enumerate(used)
    )
    return replace(stored.points, views=replace(views, image=image.astype(np.int64), images=images))


def _reading(chosen: ControlPoints, chips: ChipSource) -> Callable[[int], ChipArray]:
    """Chips of the point of a row, all of one type: 8 bits become 16 where some have 16."""
    kinds = {chips.read(file, 0, 1).dtype for file in chosen.chip_files}
    dtype = max(kinds, key=lambda kind: kind.itemsize)

    def read(row: int) -> ChipArray:
        found: ChipArray = point_chips(chosen, chips, row).astype(dtype, copy=False)
        return found

    return read


def _check(connection: Connection, caller: Token, inputs: ExportBlock) -> None:
    bbox_outline(inputs.bbox)


def _run(work: Work) -> Commit:
    chips = StoredChips(work.storage)
    try:
        with TemporaryDirectory(prefix="amers-export-") as scratch:
            folder = Path(scratch) / "block"
            with work.database.transaction() as connection:
                written = export_block(
                    connection,
                    chips,
                    work.inputs,
                    folder,
                    MOST_POINTS,
                    part_of(work.progress, 0.0, 0.8),
                )
            archive = Path(scratch) / ARCHIVE
            # Stored, not deflated: chips are noise to a compressor, and the block has its checksums.
            with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as packed:
                for path in sorted(folder.rglob("*")):
                    packed.write(path, path.relative_to(folder.parent))
            key = f"{work.attempt_folder}/{ARCHIVE}"
            work.storage.put_file(key, archive)
    finally:
        chips.close()

    def commit(connection: Connection) -> dict[str, Any]:
        return {"points": written, "files": {ARCHIVE: key}}

    return commit


EXPORT_BLOCK = Process(
    id="export-block",
    title="Export points as a block",
    description="Write the points served in a box, with their chips, as a block to take elsewhere.",
    scope=Scope.READ,
    inputs=ExportBlock,
    outputs={ARCHIVE: "The block, a zip of its folder."},
    check=_check,
    run=_run,
    values={"points": {"type": "integer", "title": "Points that were written"}},
)
