"""Blocks: a version of points, published or not as a whole, with its images and files of chips."""

import json
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

import shapely

from app.db.engine import Connection
from services.formats.block.reader import BlockContents
from services.quality.block import BlockQuality, parse_quality_document, quality_document
from services.types import Array, IntArray

BlockState = Literal["staged", "published", "withdrawn"]

ID_BITS = 26
"""A point's id is the number of its block times 2^26 plus its id in the block."""

PUBLISHED = "select number from block where state = 'published'"

INGESTION_LOCK = 0x616D657273
"""Advisory lock held by ingestions (shared) and by the sweep of unnamed files (exclusive)."""

COLUMNS = (
    "number, id, version, title, state, priority, n_points, n_unserved, n_views, checksum, "
    "created_at, state_changed_at, st_asbinary(extent) as outline"
)


@dataclass(frozen=True)
class Block:
    """One version of a block.

    Attributes:
        number: of this version in this database.
        id, version: as its producer names it.
        priority: of blocks over one place, the points of the greater one are served.
        n_unserved: how many of its points are not served: a better block has them, or they are
            suspended.
        outline: (m, 2) lon, lat, not closed.
        checksum: sha256 of its block.json.
    """

    number: int
    id: str
    version: str
    title: str
    state: BlockState
    priority: int
    n_points: int
    n_unserved: int
    n_views: int
    checksum: str
    created_at: datetime
    state_changed_at: datetime
    outline: Array


def lock_ingestion(connection: Connection) -> None:
    """Keep the sweep away until the end of the transaction; ingestions do not keep each other away."""
    connection.execute("select pg_advisory_xact_lock_shared(%s)", [INGESTION_LOCK])


def lock_sweep(connection: Connection) -> None:
    """Wait for the ingestions under way and keep new ones away until the end of the transaction."""
    connection.execute("select pg_advisory_xact_lock(%s)", [INGESTION_LOCK])


def insert_block(
    connection: Connection,
    contents: BlockContents,
    document: str,
    checksum: str,
    quality: BlockQuality,
    priority: int = 0,
) -> Block | None:
    """A new block, staged, without its points.

    Args:
        contents: what it holds.
        document: the text of its block.json.
        checksum: sha256 of the same.
        quality: its figures.
        priority: against other blocks over the same place.

    Returns:
        None when there is a block of that id and version.
    """
    metadata = contents.document.metadata
    row = connection.execute(
        f"""insert into block
                (id, version, title, state, extent, n_points, n_views, metadata, quality, checksum,
                 priority)
            values (%s, %s, %s, 'staged', st_geomfromwkb(%s, 4326), %s, %s, %s::jsonb, %s::jsonb, %s, %s)
            on conflict (id, version) do nothing returning {COLUMNS}""",
        [
            metadata.id,
            metadata.version,
            metadata.title,
            shapely.to_wkb(shapely.Polygon(metadata.extent)),
            len(contents.points),
            len(contents.points.views.gsd_m),
            document,
            json.dumps(quality_document(quality)),
            checksum,
            priority,
        ],
    ).fetchone()
    return _block(row) if row else None


def find_blocks(connection: Connection, reference: str) -> list[Block]:
    """The blocks a reference may mean: a number, ID@VERSION, or an ID with all its versions."""
    name, _, version = reference.partition("@")
    rows = connection.execute(
        f"""select {COLUMNS} from block
            where number::text = %s or (id = %s and (%s = '' or version = %s)) order by number""",
        [reference, name, version, version],
    ).fetchall()
    return [_block(row) for row in rows]


def list_blocks(connection: Connection, states: tuple[BlockState, ...]) -> list[Block]:
    """The blocks in some states, the newest first."""
    rows = connection.execute(
        f"select {COLUMNS} from block where state = any(%s) order by number desc", [list(states)]
    ).fetchall()
    return [_block(row) for row in rows]


def find_quality(connection: Connection, number: int) -> BlockQuality:
    """The quality figures of a block."""
    row = connection.execute("select quality from block where number = %s", [number]).fetchone()
    assert row is not None
    return parse_quality_document(row["quality"])


def find_document(connection: Connection, number: int) -> str:
    """The block.json of a block."""
    row = connection.execute(
        "select metadata::text as text from block where number = %s", [number]
    ).fetchone()
    assert row is not None
    return str(row["text"])


def lock_versions(connection: Connection, name: str) -> list[Block]:
    """All versions of a block, locked until the end of the transaction."""
    rows = connection.execute(
        f"select {COLUMNS} from block where id = %s order by number for update", [name]
    ).fetchall()
    return [_block(row) for row in rows]


def set_state(connection: Connection, number: int, state: BlockState) -> Block:
    """Put a block into a state."""
    row = connection.execute(
        f"update block set state = %s, state_changed_at = now() where number = %s returning {COLUMNS}",
        [state, number],
    ).fetchone()
    assert row is not None
    return _block(row)


def set_priority(connection: Connection, number: int, priority: int) -> None:
    """Let the points of a block win over those of blocks of a smaller priority."""
    connection.execute("update block set priority = %s where number = %s", [priority, number])


def read_block_row(connection: Connection, number: int) -> Block:
    """A block that is known to exist, as it stands now."""
    row = connection.execute(f"select {COLUMNS} from block where number = %s", [number]).fetchone()
    assert row is not None
    return _block(row)


def find_typology(connection: Connection, point_ids: IntArray) -> list[str | None]:
    """What kind of detail each of some points is, in the order given; they must exist."""
    rows = connection.execute(
        "select id, typology from point where id = any(%s)", [point_ids.tolist()]
    ).fetchall()
    found = {row["id"]: row["typology"] for row in rows}
    return [found[point_id] for point_id in point_ids.tolist()]


def storage_keys(connection: Connection) -> set[str]:
    """Where the storage has the files of chips of all blocks."""
    return {row["storage_key"] for row in connection.execute("select storage_key from chip_file")}


def _block(row: dict[str, Any]) -> Block:
    outline = shapely.get_coordinates(shapely.from_wkb(bytes(row["outline"])))[:-1]
    return Block(**{**row, "outline": outline})
