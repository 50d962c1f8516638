"""The life of a block: check and ingest it, report its quality; its publication is in `publication`."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from amers.app.db import block_documents, blocks
from amers.app.db.blocks import Block
from amers.app.db.engine import Connection
from amers.app.db.ingestion import StoredChipFile, load_contents
from amers.app.errors import Conflict, InputError
from amers.app.storage import Storage, StoredFile
from amers.app.usecases.blocks.lookup import find_block as find_block
from amers.app.usecases.blocks.lookup import find_shown_block as find_shown_block
from amers.app.usecases.blocks.publication import Published as Published
from amers.app.usecases.blocks.publication import check_priority
from amers.app.usecases.blocks.publication import find_published as find_published
from amers.app.usecases.blocks.publication import prioritise_block as prioritise_block
from amers.app.usecases.blocks.publication import publish_block as publish_block
from amers.app.usecases.blocks.publication import restore_block as restore_block
from amers.app.usecases.blocks.publication import withdraw_block as withdraw_block
from amers.services.errors import FormatError
from amers.services.formats.block.check import check_block, check_checksums
from amers.services.formats.block.document import AccuracyFigure
from amers.services.formats.block.document_json import BLOCK_JSON, parse_block_json
from amers.services.formats.block.reader import BlockContents, block_member
from amers.services.formats.chips.checksums import ChipHasher
from amers.services.formats.chips.npy_files import read_chip_file
from amers.services.quality.accuracy_statement import AccuracyStatement
from amers.services.quality.block import BlockQuality, block_accuracy, block_quality
from amers.services.types import Progress, no_progress, part_of

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
        priority: priority of the block: where blocks overlap, points of the block with the higher
            priority are served.

    Raises:
        FormatError: the block breaks the format; nothing is changed.
        Conflict: the store already has this version of the block.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected the folder of a block with {BLOCK_JSON}")
    check_priority(priority)
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
