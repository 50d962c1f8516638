"""The list of all blocks, read by the driver alone: a command that lists needs none of the tables."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from psycopg.rows import dict_row

from amers.app.db.session import DriverConnection
from amers.app.db.sql_files import sql_file
from amers.app.db.states import BlockState
from amers.services.formats.block.frame_json import parse_frame
from amers.services.types import Frame


@dataclass(frozen=True)
class BlockSummary:
    """One version of a block, as lists show it.

    Attributes:
        number: of this version in this database.
        id, version: the names of its producer.
        priority: where blocks overlap, the points of the block with the greater priority are served.
        n_unserved: how many of its points are not served: a better block has them, or they are
            suspended.
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
    created_at: datetime
    state_changed_at: datetime


@dataclass(frozen=True)
class ListedBlock:
    """A block, and what its accuracy follows from.

    Attributes:
        sigma_horizontal_m, sigma_up_m: standard deviations of its median point, a coordinate, in its
            frame.
        frame: on the Earth.
        box: west, south, east, north of its outline, degrees; in one piece across the antimeridian.
        renewal: what its document says of its renewal; None for a block that renews none.
    """

    block: BlockSummary
    sigma_horizontal_m: float
    sigma_up_m: float
    frame: Frame
    box: tuple[float, float, float, float]
    renewal: dict[str, Any] | None


def list_blocks(connection: DriverConnection) -> list[ListedBlock]:
    """All blocks, the newest first."""
    cursor = connection.cursor(row_factory=dict_row)
    return [
        ListedBlock(
            sigma_horizontal_m=row.pop("sigma_horizontal_m"),
            sigma_up_m=row.pop("sigma_up_m"),
            frame=parse_frame(row.pop("frame"), row.pop("frame_sigma_m")),
            box=row.pop("box"),
            renewal=row.pop("renewal"),
            block=BlockSummary(**row),
        )
        for row in cursor.execute(sql_file("block_list.sql").encode())
    ]
