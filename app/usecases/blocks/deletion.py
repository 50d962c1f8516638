"""Deletion of a block with its chips, for good: only its record in the audit trail stays."""

from dataclasses import dataclass

import psycopg

from amers.app.db import block_deletion, blocks
from amers.app.db.blocks import Block
from amers.app.db.engine import Connection, limit_lock_wait
from amers.app.errors import Conflict
from amers.app.usecases import storage_identity
from amers.app.usecases.blocks.publication import lock_block
from amers.app.usecases.garbage_collection import Bin, moment
from amers.app.usecases.installation import Installation

LONGEST_WAIT_S = 5
"""Longest wait for the end of ingestions: one of them may use the files of the block."""


@dataclass(frozen=True)
class Deleted:
    """A block that was deleted.

    Attributes:
        block: as it was.
        n_files: files of chips that went into the trash.
        n_shared_files: files of chips that stay, because other blocks have them too.
    """

    block: Block
    n_files: int
    n_shared_files: int


def delete_block(installation: Installation, reference: str) -> Deleted:
    """Delete a block that is not published, and move its chips into the trash.

    The rows are deleted first: an interruption leaves files without rows, which the sweep removes.
    Registrations keep what they measured at its points.

    Args:
        reference: ID@VERSION. A number, or an ID alone, could mean another block than the caller thinks.

    Raises:
        NotFound: there is no such block.
        Conflict: the reference is no ID@VERSION, the block is published, the storage does not belong to
            the database, or an ingestion is under way.
    """
    database, storage = installation.database, installation.storage
    storage_identity.require_match(database, storage)
    with database.transaction() as connection:
        _exclude_ingestions(connection)
        block, _ = lock_block(connection, reference)
        _check(block, reference)
        keys = block_deletion.chip_keys(connection, block.number)
        block_deletion.delete_block(connection, block.number)
    with database.transaction() as connection:
        blocks.lock_sweep(connection)
        own_keys = keys - blocks.storage_keys(connection)
        at = moment(connection) if installation.settings.trash_days > 0 else None
        Bin(storage, at).remove(sorted(own_keys))
    return Deleted(block, len(own_keys), len(keys) - len(own_keys))


def _check(block: Block, reference: str) -> None:
    name = f"{block.id}@{block.version}"
    if reference != name:
        raise Conflict(f"block {reference:.100} is {name}: name it so to delete it")
    if block.state == "published":
        raise Conflict(f"block {name} is published: withdraw it before it is deleted")


def _exclude_ingestions(connection: Connection) -> None:
    limit_lock_wait(connection, LONGEST_WAIT_S)
    try:
        blocks.lock_sweep(connection)
    except psycopg.errors.LockNotAvailable:
        raise Conflict("a block is being ingested: delete this one when that has ended") from None
