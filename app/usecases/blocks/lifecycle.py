"""The life of a block: check and ingest it (staged), publish, withdraw, restore and prioritise it."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from app.db import block_documents, blocks, superseding
from app.db.blocks import Block
from app.db.engine import Connection
from app.db.ingestion import StoredChipFile, load_contents
from app.db.schema import BlockState
from app.errors import Conflict, InputError, NotFound
from app.storage import Storage, StoredFile
from app.usecases.blocks.listing import find_block as find_block
from app.usecases.blocks.listing import list_blocks as list_blocks
from services.errors import FormatError
from services.formats.block.check import check_block, check_checksums
from services.formats.block.document import AccuracyFigure
from services.formats.block.document_json import BLOCK_JSON, parse_block_json
from services.formats.block.reader import BlockContents, block_member
from services.formats.chips.checksums import ChipHasher
from services.formats.chips.npy_files import read_chip_file
from services.quality.accuracy_statement import AccuracyStatement
from services.quality.block import BlockQuality, block_accuracy, block_quality
from services.types import Progress, no_progress, part_of

MAY_BECOME: dict[BlockState, tuple[BlockState, ...]] = {
    "staged": ("published",),
    "published": ("withdrawn",),
    "withdrawn": ("published",),
}
LARGEST_PRIORITY = 1000
PARALLEL_COPIES = 4


@dataclass(frozen=True)
class Ingested:
    """A block that was ingested, the quality figures of its points, and its accuracy."""

    block: Block
    quality: BlockQuality
    stated: AccuracyStatement


@dataclass(frozen=True)
class BlockReport:
    """The quality of a block.

    Attributes:
        quality: figures computed from its points.
        stated: its accuracy, as every place states it.
        accuracy: figures that its producer states, each with what it was measured against.
    """

    quality: BlockQuality
    stated: AccuracyStatement
    accuracy: tuple[AccuracyFigure, ...]


@dataclass(frozen=True)
class Published:
    """A block that was published.

    Attributes:
        block: the published version.
        superseded: the version of the same block that was published before; None when there was none.
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
    """Check a block folder, then copy its chips into the storage and its rows into the store, staged.

    Nothing is visible before the transaction of the connection is committed. Files that a failed
    ingestion leaves in the storage belong to no row; `remove_unnamed_chips` deletes them.

    Args:
        connection: its transaction begins after the check of the block.
        storage: receives the chips.
        folder: of the block.
        progress: receives the fraction done and a message.
        priority: where blocks overlap, points of the block with the greater priority are served.

    Raises:
        FormatError: the block breaks the format; nothing is changed.
        Conflict: the store already has this version of the block.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected the folder of a block with {BLOCK_JSON}")
    _check_priority(priority)
    contents = check_block(folder, part_of(progress, 0.0, 0.1), chip_checksums=False)
    document = (folder / BLOCK_JSON).read_bytes()
    metadata = contents.document.metadata
    quality = block_quality(contents.points, contents.n_views, metadata.extent)
    with connection.begin_nested():
        blocks.lock_ingestion(connection)
        block = block_documents.insert_block(
            connection,
            contents,
            document=document.decode(),
            checksum=sha256(document).hexdigest(),
            quality=quality,
            priority=priority,
        )
        if block is None:
            raise Conflict(
                f"block {metadata.id} version {metadata.version} is already in the store; "
                "a changed block needs a new version"
            )
        files = _store_chips(storage, folder, contents, part_of(progress, 0.1, 0.5))
        load_contents(connection, block.number, contents, files, part_of(progress, 0.6, 0.4))
    return Ingested(block, quality, block_accuracy(quality, metadata.frame))


def publish_block(connection: Connection, reference: str) -> Published:
    """Publish a block and, in the same step, withdraw the version of it that was published before.

    Where several blocks have a point at one place, the point of the better block is served: see
    `app.db.superseding`.

    Raises:
        NotFound: there is no such block.
        Conflict: it is already published, or the reference fits several versions.
    """
    block, versions = lock_block(connection, reference)
    before = next((v for v in versions if v.state == "published" and v.number != block.number), None)
    _set_state(connection, block, "published")
    if before is not None:
        _set_state(connection, before, "withdrawn")
        superseding.recompute(connection, before.number)
    superseding.recompute(connection, block.number)
    return Published(
        blocks.read_block_row(connection, block.number),
        None if before is None else blocks.read_block_row(connection, before.number),
    )


def withdraw_block(connection: Connection, reference: str) -> Block:
    """Withdraw a published block; it can be restored.

    Raises:
        NotFound: there is no such block.
        Conflict: it is not published, or the reference fits several versions.
    """
    block, _ = lock_block(connection, reference)
    _set_state(connection, block, "withdrawn")
    superseding.recompute(connection, block.number)
    return blocks.read_block_row(connection, block.number)


def restore_block(connection: Connection, reference: str) -> Published:
    """Publish a withdrawn or superseded block again, in place of its published version.

    Raises:
        NotFound: there is no such block.
        Conflict: it was never published or is published, or the reference fits several versions.
    """
    block = find_block(connection, reference)
    if block.state == "staged":
        raise Conflict(
            f"block {block.id}@{block.version} was never published: publish it instead of restoring it"
        )
    return publish_block(connection, str(block.number))


def prioritise_block(connection: Connection, reference: str, priority: int) -> Block:
    """Set the priority of a block among overlapping blocks; it takes effect at once if it is published.

    Raises:
        NotFound: there is no such block.
        Conflict: the reference fits several versions.
        InputError: the priority is out of range.
    """
    _check_priority(priority)
    block, _ = lock_block(connection, reference)
    blocks.set_priority(connection, block.number, priority)
    if block.state == "published":
        superseding.recompute(connection, block.number)
    return blocks.read_block_row(connection, block.number)


def find_published(connection: Connection, reference: str) -> Block:
    """The published block with this number, ID or ID@VERSION; an ID has at most one published version.

    Raises:
        NotFound: there is no such block, or it is not published.
    """
    for block in blocks.find_blocks(connection, reference):
        if block.state == "published":
            return block
    raise NotFound(
        f"no published block {reference:.100}: expected the number, ID or ID@VERSION of one of the store"
    )


def block_report(connection: Connection, block: Block) -> BlockReport:
    """The quality of a block: figures of its points, and the accuracy that its producer states."""
    document = parse_block_json(blocks.find_document(connection, block.number))
    quality, metadata = block_documents.find_quality(connection, block.number), document.metadata
    return BlockReport(quality, block_accuracy(quality, metadata.frame), metadata.accuracy)


def folder_to_ingest(allowed: Path | None, name: str) -> Path:
    """The path of a block folder on the server that a request may ingest.

    Args:
        allowed: the folder AMERS_INGEST_FOLDER; None when it is not set.
        name: path below it.

    Raises:
        InputError: the path does not lead to a folder below the allowed one.
    """
    if allowed is None:
        raise InputError(
            "path: this server ingests no folders on request, because AMERS_INGEST_FOLDER is not set; "
            "upload an archive of the block instead"
        )
    try:
        folder = block_member(allowed, name)
    except FormatError as error:
        raise InputError(f"path: {error}, below AMERS_INGEST_FOLDER") from error
    if not folder.is_dir():
        raise InputError(f"path: {name!r:.200}: no such folder below AMERS_INGEST_FOLDER")
    return folder


def lock_block(connection: Connection, reference: str) -> tuple[Block, list[Block]]:
    """Lock a block against changes by others; returns its present state, and all its versions."""
    superseding.lock_publications(connection)
    number = find_block(connection, reference).number
    versions = blocks.lock_versions(connection, blocks.read_block_row(connection, number).id)
    return next(version for version in versions if version.number == number), versions


def _check_priority(priority: int) -> None:
    if not -LARGEST_PRIORITY <= priority <= LARGEST_PRIORITY:
        raise InputError(
            f"priority: {priority} found, {-LARGEST_PRIORITY} to {LARGEST_PRIORITY} expected"
        )


def _set_state(connection: Connection, block: Block, state: BlockState) -> Block:
    if state not in MAY_BECOME[block.state]:
        raise Conflict(f"block {block.id}@{block.version} is {block.state}: it cannot become {state}")
    return blocks.set_state(connection, block.number, state)


def _store_chips(
    storage: Storage, folder: Path, contents: BlockContents, progress: Progress
) -> list[StoredChipFile]:
    """Copy the chip files into the storage, several in parallel.

    Raises:
        BlockProblems: files have other checksums than the block states; they are not stored.
    """
    names, stated_sha256 = contents.points.chip_files, contents.document.checksums

    def store(name: str) -> tuple[StoredFile, StoredChipFile]:
        path = block_member(folder, name)
        layout = read_chip_file(path, name)
        hasher = ChipHasher(layout)
        file = storage.put_chips(path, stated_sha256[name].lower(), hasher.update)
        dtype, checksums = np.dtype(layout.dtype).name, hasher.checksums().tobytes()
        return file, StoredChipFile(name, file.key, dtype, layout.count, checksums)

    progress(0.0, "storing chips")
    stored: dict[str, tuple[StoredFile, StoredChipFile]] = {}
    with ThreadPoolExecutor(PARALLEL_COPIES) as pool:
        for name, file in zip(names, pool.map(store, names), strict=True):
            stored[name] = file
            progress(len(stored) / len(names), "storing chips")
    check_checksums({name: file.sha256 for name, (file, _) in stored.items()}, contents.document)
    return [chips for _, chips in stored.values()]
