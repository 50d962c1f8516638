"""Blocks that are served."""

from pathlib import Path

from amers.app.db.blocks import Block
from amers.app.db.engine import Connection
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle


def serve_block(connection: Connection, storage: Storage, folder: Path) -> Block:
    """A block, ingested and published, as it was ingested; commit for others to see."""
    block = lifecycle.ingest_block(connection, storage, folder).block
    lifecycle.publish_block(connection, str(block.number))
    return block
