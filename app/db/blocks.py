"""Blocks: a version of points, published or not as a whole, with its images and files of chips."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from sqlalchemy import (
    ARRAY,
    ColumnElement,
    Integer,
    LargeBinary,
    Row,
    Select,
    Text,
    and_,
    any_,
    cast,
    func,
    or_,
    select,
    update,
)
from sqlalchemy.dialects.postgresql import JSONB

from amers.app.db.block_list import BlockSummary
from amers.app.db.constants import text_constant
from amers.app.db.engine import Connection
from amers.app.db.rows import among, columns_of
from amers.app.db.schema import BlockState, block, chip_file, now, point
from amers.app.db.schema.base import Double
from amers.services.types import Array, IntArray, SurfaceHeights

ID_BITS = 26
"""A point's id is the number of its block times 2^26 plus its id in the block."""

_FRAME_SIGMA_PATH = '$."amers:accuracy"."absolute"[*] ? (@.name == "frame_sigma_m").value'
FRAME_SIGMA_M = cast(
    func.jsonb_path_query_first(block.c.metadata, text_constant(_FRAME_SIGMA_PATH), type_=JSONB), Double
)
"""Standard deviation a coordinate of the frame of a block on the Earth; null if unstated."""

FRAME = func.jsonb_path_query_first(block.c.metadata, text_constant('$."amers:frame"'), type_=JSONB)
"""The frame of a block on the Earth, as its document states it; null if unstated."""

INGESTION_LOCK = 0x616D657273
"""Advisory lock held by ingestions (shared) and by the sweep of unnamed files (exclusive)."""


@dataclass(frozen=True)
class Block(BlockSummary):
    """One version of a block.

    Attributes:
        checksum: sha256 of its block.json.
        outline: (m, 2) lon, lat, not closed.
    """

    checksum: str
    outline: Array


COLUMNS = columns_of(Block, block, outline=func.ST_AsBinary(block.c.extent, type_=LargeBinary))


def published_numbers() -> Select[Any]:
    """SELECT of the numbers of the published blocks."""
    return select(block.c.number).where(block.c.state == text_constant("published"))


def in_published_block() -> ColumnElement[bool]:
    """The predicate that the block of a point is published.

    The numbers are one array, read once, so that the planner reads the points by their own indexes.
    """
    numbers = func.array(published_numbers().scalar_subquery(), type_=ARRAY(Integer))
    return point.c.block_number == any_(numbers)


def lock_ingestion(connection: Connection) -> None:
    """Keep the sweep away until the end of the transaction; ingestions do not exclude each other."""
    connection.execute(select(func.pg_advisory_xact_lock_shared(INGESTION_LOCK)))


def lock_sweep(connection: Connection) -> None:
    """Wait for the ingestions under way and keep new ones away until the end of the transaction."""
    connection.execute(select(func.pg_advisory_xact_lock(INGESTION_LOCK)))


def find_blocks(connection: Connection, reference: str) -> list[Block]:
    """The blocks that a reference may mean: a number, ID@VERSION, or an ID with all its versions."""
    name, _, version = reference.partition("@")
    of_name = block.c.id == name
    statement = select(*COLUMNS).where(
        or_(
            cast(block.c.number, Text) == reference,
            and_(of_name, block.c.version == version) if version else of_name,
        )
    )
    return _blocks(connection.execute(statement.order_by(block.c.number)))


def find_document(connection: Connection, number: int) -> str:
    """The block.json of a block."""
    statement = select(cast(block.c.metadata, Text)).where(block.c.number == number)
    return str(connection.execute(statement).scalar_one())


def lock_versions(connection: Connection, name: str) -> list[Block]:
    """All versions of a block, locked until the end of the transaction."""
    statement = select(*COLUMNS).where(block.c.id == name).order_by(block.c.number).with_for_update()
    return _blocks(connection.execute(statement))


def set_state(connection: Connection, number: int, state: BlockState) -> Block:
    """Change the state of a block; returns the block."""
    statement = (
        update(block)
        .where(block.c.number == number)
        .values(state=state, state_changed_at=now)
        .returning(*COLUMNS)
    )
    return block_of_row(connection.execute(statement).one())


def set_priority(connection: Connection, number: int, priority: int) -> None:
    """Change the priority of a block: its points win over those of blocks with a smaller one."""
    connection.execute(update(block).where(block.c.number == number).values(priority=priority))


def read_block_row(connection: Connection, number: int) -> Block:
    """A block that exists, in its present state."""
    return block_of_row(connection.execute(select(*COLUMNS).where(block.c.number == number)).one())


def find_typology(connection: Connection, point_ids: IntArray) -> list[str | None]:
    """The typology of each of some points, in the order given; they must exist."""
    ids = point_ids.tolist()
    rows = connection.execute(select(point.c.id, point.c.typology).where(among(point.c.id, ids)))
    typology = {row.id: row.typology for row in rows}
    return [typology[point_id] for point_id in ids]


def find_surface_heights(connection: Connection, point_ids: IntArray) -> SurfaceHeights | None:
    """The surface at each of some points, in the order given; None where none of them states it."""
    stated = point.c.surface_height_m.is_not(None)
    columns = (point.c.id, point.c.surface_height_m, point.c.surface_sigma_m)
    rows = connection.execute(select(*columns).where(among(point.c.id, point_ids.tolist()), stated))
    known = {row.id: (row.surface_height_m, row.surface_sigma_m) for row in rows}
    if not known:
        return None
    height_m, sigma_m = np.array([known.get(i, (np.nan, np.nan)) for i in point_ids.tolist()]).T
    return SurfaceHeights(height_m, sigma_m)


def storage_keys(connection: Connection) -> set[str]:
    """The keys in the storage of the files of chips of all blocks."""
    return set(connection.scalars(select(chip_file.c.storage_key)))


def _blocks(rows: Iterable[Row[Any]]) -> list[Block]:
    return [block_of_row(row) for row in rows]


def block_of_row(row: Row[Any]) -> Block:
    """The block of a row of `COLUMNS`."""
    outline = shapely.get_coordinates(shapely.from_wkb(row.outline))[:-1]
    return Block(**{**row._mapping, "outline": outline})
