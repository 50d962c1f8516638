"""What the renewal of a block reads: searches of its points by good scenes, and its suspended points."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from uuid import UUID

import numpy as np
from sqlalchemy import select

from amers.app.db.engine import Connection
from amers.app.db.history import NOT_ATTRIBUTABLE
from amers.app.db.schema import point
from amers.app.db.statements import named
from amers.services.quality.vanished import Days, Searches
from amers.services.types import Array, BoolArray, IntArray


@dataclass(frozen=True)
class StoredSearches:
    """m searches of points in scenes that were registered well.

    Attributes:
        scene: (m,) int64, rows of `days`.
        lon_lat_h: (m, 3) the point of each, which may be of an older version of its block.
        found: (m,) whether it was active at the end.
        days: (s,) datetime64[D], when each scene was taken.
    """

    scene: IntArray
    lon_lat_h: Array
    found: BoolArray
    days: Days

    def of_points(self, lon_lat_h: Array) -> Searches:
        """The searches of some points (n, 3): those at exactly their places."""
        row_at = {place.tobytes(): row for row, place in enumerate(lon_lat_h)}
        point = np.array([row_at.get(place.tobytes(), -1) for place in self.lon_lat_h], dtype=np.int64)
        known = point >= 0
        return Searches(self.scene[known], point[known], self.found[known], self.days)


def find_searches(connection: Connection, block_id: str, left_out: Sequence[UUID]) -> StoredSearches:
    """The searches of the points of all versions of a block in the good scenes that count.

    Args:
        block_id: of the block.
        left_out: registrations that are not read.
    """
    parameters = {
        "block_id": block_id,
        "has_block": json.dumps([{"id": block_id}]),
        "left_out": list(left_out),
        "not_attributable": list(NOT_ATTRIBUTABLE),
    }
    rows = connection.execute(named("history.sql", "searches"), parameters).all()
    taken_at = {row.registration_id: row.taken_at for row in rows}
    number = {registration: i for i, registration in enumerate(taken_at)}
    return StoredSearches(
        scene=np.array([number[row.registration_id] for row in rows], dtype=np.int64),
        lon_lat_h=np.array([(row.lon, row.lat, row.h) for row in rows]).reshape(-1, 3),
        found=np.array([row.active for row in rows], dtype=np.bool_),
        days=np.array([moment.date() for moment in taken_at.values()], dtype="datetime64[D]"),
    )


def find_suspended(connection: Connection, number: int) -> IntArray:
    """The ids of the suspended points of a block, ascending."""
    statement = select(point.c.id).where(
        point.c.block_number == number, point.c.suspended_at.is_not(None)
    )
    return np.array(sorted(connection.scalars(statement)), dtype=np.int64)
