"""The quality of a block of the store against references."""

from dataclasses import replace

from amers.app.db import blocks
from amers.app.db.engine import Database
from amers.app.db.points import points_of_block
from amers.app.errors import InputError
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.quality import (
    BlockToAssess,
    QualityReferences,
    RequiredQuality,
    assess_block,
)
from amers.app.usecases.damage import open_chips
from amers.services.formats.block.document_json import parse_block_json
from amers.services.reports.block_quality import BlockQualityReport
from amers.services.types import Progress, no_progress


def assess_stored(
    database: Database,
    storage: Storage,
    reference: str,
    references: QualityReferences,
    required: RequiredQuality,
    *,
    progress: Progress = no_progress,
) -> BlockQualityReport:
    """The quality of a block of the store; the transaction ends before anything is measured.

    Args:
        database, storage: of the installation.
        reference: number, ID or ID@VERSION of the block, in any state.
        references: what it is measured against.
        required: what it shall reach.
        progress: receives the fraction done and a message.

    Raises:
        NotFound: there is no such block.
        InputError: a reference cannot be used, or images were given: the store keeps no image models.
    """
    if references.images:
        raise InputError(
            "images: the store keeps no models of images; compare them with the block's folder: "
            "amers block quality FOLDER --images …"
        )
    progress(0.0, "reading points")
    with database.snapshot() as connection:
        block = lifecycle.find_shown_block(connection, reference)
        metadata = parse_block_json(blocks.find_document(connection, block.number)).metadata
        stored = points_of_block(connection, block.number).points
        points = replace(stored, surface=blocks.find_surface_heights(connection, stored.id))
    chips = open_chips(database, storage)
    try:
        block_to_assess = BlockToAssess(metadata, points, chips, {})
        return assess_block(block_to_assess, references, required, progress)
    finally:
        chips.close()
