"""The row of a block with its document and the figures of its quality: inserted, and read again."""

import json

import numpy as np
import shapely
from sqlalchemy import Text, cast, func, literal, select
from sqlalchemy.dialects.postgresql import JSONB, insert

from amers.app.db.blocks import COLUMNS, Block, block_of_row
from amers.app.db.engine import Connection
from amers.app.db.schema import block
from amers.services.formats.block.reader import BlockContents
from amers.services.quality.accuracy_statement import StatedAccuracy
from amers.services.quality.block import (
    BlockQuality,
    block_accuracy,
    parse_quality_document,
    quality_document,
)


def insert_block(
    connection: Connection,
    contents: BlockContents,
    *,
    document: str,
    checksum: str,
    quality: BlockQuality,
    priority: int = 0,
) -> Block | None:
    """A new block, staged, without its points.

    Args:
        document: the text of its block.json.
        checksum: sha256 of the document.
        priority: against other blocks at the same place.

    Returns:
        None when there is a block of that id and version.
    """
    metadata = contents.document.metadata
    accuracy = block_accuracy(quality, metadata.frame)
    statement = (
        insert(block)
        .values(
            id=metadata.id,
            version=metadata.version,
            title=metadata.title,
            state="staged",
            extent=func.ST_GeomFromWKB(shapely.to_wkb(shapely.Polygon(metadata.extent)), 4326),
            n_points=len(contents.points),
            n_views=len(contents.points.views.gsd_m),
            metadata=cast(literal(document, Text), JSONB),
            quality=cast(literal(json.dumps(quality_document(quality)), Text), JSONB),
            checksum=checksum,
            priority=priority,
            **_figures("relative", accuracy.relative_to_control_points),
            **_figures("on_the_earth", accuracy.on_the_earth),
        )
        .on_conflict_do_nothing(index_elements=[block.c.id, block.c.version])
        .returning(*COLUMNS)
    )
    row = connection.execute(statement).first()
    return None if row is None else block_of_row(row)


def find_quality(connection: Connection, number: int) -> BlockQuality:
    """The quality figures of a block."""
    quality = connection.execute(select(block.c.quality).where(block.c.number == number)).scalar_one()
    return parse_quality_document(quality)


def _figures(name: str, stated: StatedAccuracy) -> dict[str, float | None]:
    """The columns of an accuracy; null where it is unknown."""
    figures = {f"{name}_ce90_m": stated.ce90_m, f"{name}_le90_m": stated.le90_m}
    return {column: None if np.isnan(value) else value for column, value in figures.items()}
