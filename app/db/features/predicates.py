"""Conditions in SQL that features of any collection can be asked to meet: a box, a span of time."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from app.db.features.bbox import Box
from app.db.features.collection import Collection


@dataclass(frozen=True)
class Condition:
    """A condition in SQL.

    Attributes:
        sql: over a row `t`.
        parameters: by the names that it uses.
        spatial: whether it keeps to a place, so that the index of geometries serves it.
        box: that it keeps to, if it says so.
        beside: what it says beside the box, in SQL.
    """

    sql: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    spatial: bool = False
    box: Box | None = None
    beside: str = ""

    def __and__(self, other: "Condition") -> "Condition":
        return Condition(
            f"{self.sql} and {other.sql}",
            {**self.parameters, **other.parameters},
            self.spatial or other.spatial,
            self.box or other.box,
            " and ".join(said for said in (self.beside, other.beside) if said),
        )


ANYTHING = Condition("true")


def in_box(collection: Collection, box: Box) -> Condition:
    """The condition that a feature meets a box: by the index, which is coarser, then exactly.

    The exact part is wrapped in `coalesce`, where the planner does not look: it would take four ranges
    of unknown values for very selective, and read all the world to find its first hundred points.
    """
    geometry = collection.geometry
    srid = 4979 if collection.has_height else 4326
    ranges = [(box.west, 180.0), (-180.0, box.east)] if box.east < box.west else [(box.west, box.east)]
    parameters: dict[str, Any] = {"south": box.south, "north": box.north}
    near, exact = [], []
    for i, (west, east) in enumerate(ranges):
        parameters |= {f"west{i}": west, f"east{i}": east}
        envelope = f"st_makeenvelope(%(west{i})s, %(south)s, %(east{i})s, %(north)s, {srid})"
        near.append(f"{geometry} && {envelope}")
        exact.append(
            f"st_x({geometry}) between %(west{i})s and %(east{i})s"
            if collection.geometry_type == "Point"
            else f"st_intersects({geometry}, {envelope})"
        )
    sql = f"({' or '.join(near)}) and coalesce(({' or '.join(exact)})"
    if collection.geometry_type == "Point":
        sql += f" and st_y({geometry}) between %(south)s and %(north)s"
    if collection.has_height and box.low_m > -math.inf:
        parameters |= {"low": box.low_m, "high": box.high_m}
        sql += f" and st_z({geometry}) between %(low)s and %(high)s"
    beside = "" if box.low_m == -math.inf else f"st_z({geometry}) between %(low)s and %(high)s"
    return Condition(f"{sql}, false)", parameters, spatial=True, box=box, beside=beside)


def in_time(collection: Collection, since: datetime | None, until: datetime | None) -> Condition:
    """The condition that a feature's time meets an interval; None for an open end."""
    if collection.interval is None:
        return ANYTHING
    start, end = (collection.queryables[name].expression for name in collection.interval)
    sql = (
        f"({start}::timestamp at time zone 'UTC' <= coalesce(%(until)s::timestamptz, 'infinity')"
        f" and {end}::timestamp at time zone 'UTC' >= coalesce(%(since)s::timestamptz, '-infinity'))"
    )
    return Condition(sql, {"since": since, "until": until}, beside=sql)
