"""The life of a block: ingested and checked, staged, published, withdrawn."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from app.db import blocks, superseding
from app.db.blocks import Block, BlockState
from app.db.engine import Connection
from app.db.ingestion import StoredChipFile, load_contents
from app.errors import Conflict, InputError, NotFound
from app.storage import Storage, StoredFile
from services.errors import FormatError
from services.formats.block.check import check_block, check_checksums
from services.formats.block.document import AccuracyFigure
from services.formats.block.document_json import BLOCK_JSON, parse_block_json
from services.formats.block.reader import BlockContents, block_member
from services.formats.chips.npy_files import ChipFile, read_chip_file
from services.quality.block import BlockQuality, block_quality
from services.types import Progress, no_progress, part_of

MAY_BECOME: dict[BlockState, tuple[BlockState, ...]] = {
    "staged": ("published",),
    "published": ("withdrawn",),
    "withdrawn": ("published",),
}
CHIPS = "chips"
LARGEST_PRIORITY = 1000
FILES_AT_ONCE = 4


@dataclass(frozen=True)
class Ingested:
    """What an ingestion left in the store."""

    block: Block
    quality: BlockQuality


@dataclass(frozen=True)
class BlockReport:
    """How good a block is.

    Attributes:
        quality: of its points, told from themselves.
        accuracy: as its producer states it, with what it was measured against.
    """

    quality: BlockQuality
    accuracy: tuple[AccuracyFigure, ...]


@dataclass(frozen=True)
class Published:
    """A block that became visible.

    Attributes:
        superseded: the version of the same block that was visible before and no longer is.
    """

    block: Block
    superseded: Block | None


def ingest_block(
    connection: Connection,
    storage: Storage,
    folder: Path,
    progress: Progress = no_progress,
    priority: int = 0,
) -> Ingested:
    """Check a block folder, put its chips into the storage and its rows into the store, staged.

    Nothing is visible before the transaction of the connection is committed. Files that a broken
    ingestion leaves in the storage belong to no row; `sweep_storage` removes them.

    Args:
        connection: no transaction is opened before the block is checked.
        storage: where the chips go.
        folder: of the block.
        progress: told on the way.
        priority: against other blocks over the same place; the greater one wins.

    Raises:
        FormatError: the block is not what it should be; nothing is changed.
        Conflict: that version of the block is in the store already.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    _check_priority(priority)
    contents = check_block(folder, part_of(progress, 0.0, 0.1), chip_checksums=False)
    document = (folder / BLOCK_JSON).read_bytes()
    metadata = contents.document.metadata
    quality = block_quality(contents.points, contents.n_views, metadata.extent)
    with connection.transaction():
        blocks.lock_ingestion(connection)
        block = blocks.insert_block(
            connection, contents, document.decode(), sha256(document).hexdigest(), quality, priority
        )
        if block is None:
            raise Conflict(f"block {metadata.id} version {metadata.version} is in the store already")
        files = _store_chips(storage, folder, contents, part_of(progress, 0.1, 0.5))
        load_contents(connection, block.number, contents, files, part_of(progress, 0.6, 0.4))
    return Ingested(block, quality)


def publish_block(connection: Connection, reference: str) -> Published:
    """Make a block visible, and the version of it that was visible before no longer, in one step.

    Where several blocks have a point at one place, the point of the better block is served: see
    `app.db.superseding`.

    Raises:
        NotFound: there is no such block.
        Conflict: it is published already, or the reference means several versions.
    """
    block, versions = _to_change(connection, reference)
    before = next((v for v in versions if v.state == "published" and v.number != block.number), None)
    _change(connection, block, "published")
    if before is not None:
        _change(connection, before, "withdrawn")
        superseding.recompute(connection, before.number)
    superseding.recompute(connection, block.number)
    return Published(
        blocks.read_block_row(connection, block.number),
        None if before is None else blocks.read_block_row(connection, before.number),
    )


def withdraw_block(connection: Connection, reference: str) -> Block:
    """Make a block invisible; it can be restored.

    Raises:
        NotFound: there is no such block.
        Conflict: it is not published, or the reference means several versions.
    """
    block, _ = _to_change(connection, reference)
    _change(connection, block, "withdrawn")
    superseding.recompute(connection, block.number)
    return blocks.read_block_row(connection, block.number)


def restore_block(connection: Connection, reference: str) -> Published:
    """Make a block visible again that was withdrawn or superseded, in place of its visible version.

    Raises:
        NotFound: there is no such block.
        Conflict: it was never published or is published, or the reference means several versions.
    """
    block = find_block(connection, reference)
    if block.state == "staged":
        raise Conflict(
            f"block {block.id}@{block.version} was never published: there is nothing to restore"
        )
    return publish_block(connection, str(block.number))


def prioritise_block(connection: Connection, reference: str, priority: int) -> Block:
    """Let a block win or lose against other blocks over the same place, at once if it is published.

    Raises:
        NotFound: there is no such block.
        Conflict: the reference means several versions.
        InputError: the priority is out of range.
    """
    _check_priority(priority)
    block, _ = _to_change(connection, reference)
    blocks.set_priority(connection, block.number, priority)
    if block.state == "published":
        superseding.recompute(connection, block.number)
    return blocks.read_block_row(connection, block.number)


def find_block(connection: Connection, reference: str) -> Block:
    """The block that a number, ID or ID@VERSION means.

    Raises:
        NotFound: there is no such block.
        Conflict: an ID has several versions.
    """
    found = blocks.find_blocks(connection, reference)
    if not found:
        raise NotFound(f"no block {reference:.100}")
    if len(found) > 1:
        versions = ", ".join(f"{block.id}@{block.version}" for block in found)
        raise Conflict(f"block {reference} has {len(found)} versions, name one: {versions}")
    return found[0]


def find_published(connection: Connection, reference: str) -> Block:
    """The published block that a number, ID or ID@VERSION means; an ID never has two published versions.

    Raises:
        NotFound: there is no such block, or it is not published.
    """
    found = [block for block in blocks.find_blocks(connection, reference) if block.state == "published"]
    if not found:
        raise NotFound(f"no block {reference:.100}")
    return found[0]


def published_bounds(connection: Connection) -> tuple[float, ...] | None:
    """West, south, east, north of all published blocks, None without any."""
    outlines = [block.outline for block in blocks.list_blocks(connection, ("published",))]
    if not outlines:
        return None
    corners = np.concatenate(outlines)
    if np.abs(corners[:, 0]).max() > 180.0:
        corners[:, 0] = np.clip(corners[:, 0], -180.0, 180.0)
        corners = np.concatenate([corners, [[-180.0, corners[0, 1]], [180.0, corners[0, 1]]]])
    return (*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist())


def list_blocks(
    connection: Connection, states: tuple[BlockState, ...] = ("staged", "published", "withdrawn")
) -> list[Block]:
    """The blocks in some states, the newest first."""
    return blocks.list_blocks(connection, states)


def find_quality(connection: Connection, reference: str) -> BlockQuality:
    """The quality figures of a block.

    Raises:
        NotFound: there is no such block.
        Conflict: the reference means several versions.
    """
    block = find_block(connection, reference)
    return blocks.find_quality(connection, block.number)


def block_report(connection: Connection, block: Block) -> BlockReport:
    """How good a block is: our figures of its points, and what its producer measured."""
    document = parse_block_json(blocks.find_document(connection, block.number))
    return BlockReport(blocks.find_quality(connection, block.number), document.metadata.accuracy)


def folder_to_ingest(allowed: Path | None, name: str) -> Path:
    """A folder on the server that may be ingested by request.

    Args:
        allowed: the folder that holds such folders, None when there is none.
        name: path below it.

    Raises:
        InputError: the path is not below the allowed folder.
    """
    if allowed is None:
        raise InputError("this server ingests no folders by request: AMERS_INGEST_FOLDER is not set")
    try:
        folder = block_member(allowed, name)
    except FormatError as error:
        raise InputError(f"path: {error}, below AMERS_INGEST_FOLDER") from error
    if not folder.is_dir():
        raise InputError(f"path: {name!r:.200}: no such folder below AMERS_INGEST_FOLDER")
    return folder


def sweep_storage(connection: Connection, storage: Storage) -> list[str]:
    """Remove files of chips that no row names, left by broken ingestions; returns their keys.

    Waits for the ingestions under way.
    """
    blocks.lock_sweep(connection)
    unnamed = sorted(set(storage.keys(CHIPS)) - blocks.storage_keys(connection))
    for key in unnamed:
        storage.delete(key)
    return unnamed


def _to_change(connection: Connection, reference: str) -> tuple[Block, list[Block]]:
    """A block as it stands once nobody else is changing it, and all versions of it."""
    superseding.lock_publications(connection)
    number = find_block(connection, reference).number
    versions = blocks.lock_versions(connection, blocks.read_block_row(connection, number).id)
    return next(version for version in versions if version.number == number), versions


def _check_priority(priority: int) -> None:
    if not -LARGEST_PRIORITY <= priority <= LARGEST_PRIORITY:
        raise InputError(
            f"priority: {priority} found, {-LARGEST_PRIORITY} to {LARGEST_PRIORITY} expected"
        )


def _change(connection: Connection, block: Block, state: BlockState) -> Block:
    if state not in MAY_BECOME[block.state]:
        raise Conflict(f"block {block.id}@{block.version} is {block.state}: it cannot become {state}")
    return blocks.set_state(connection, block.number, state)


def _store_chips(
    storage: Storage, folder: Path, contents: BlockContents, progress: Progress
) -> list[StoredChipFile]:
    """Copy the files of chips, some at once; what arrives must be what the block promises.

    Raises:
        BlockProblems: files have other checksums; they are not stored.
    """
    names, promised = contents.points.chip_files, contents.document.checksums

    def store(name: str) -> tuple[StoredFile, ChipFile]:
        path = block_member(folder, name)
        layout = read_chip_file(path, name)
        return storage.put_chips(path, promised[name].lower()), layout

    progress(0.0, "storing chips")
    stored: dict[str, tuple[StoredFile, ChipFile]] = {}
    with ThreadPoolExecutor(FILES_AT_ONCE) as pool:
        for name, file in zip(names, pool.map(store, names), strict=True):
            stored[name] = file
            progress(len(stored) / len(names), "storing chips")
    check_checksums({name: file.sha256 for name, (file, _) in stored.items()}, contents.document)
    return [
        StoredChipFile(name, file.key, np.dtype(layout.dtype).name, layout.count)
        for name, (file, layout) in stored.items()
    ]
