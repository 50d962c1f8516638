"""Conditions on the features of any collection: a box, a span of time, a filter."""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import (
    ARRAY,
    ColumnElement,
    Float,
    Text,
    and_,
    any_,
    bindparam,
    cast,
    false,
    func,
    literal,
    or_,
)
from sqlalchemy.types import NullType

from amers.app.db.constants import integer_constant
from amers.app.db.features.bbox import Box
from amers.app.db.features.collection import Collection, Property
from amers.app.db.features.instants import Moment, Time


@dataclass(frozen=True)
class Condition:
    """A box and a predicate, both of which features have to meet.

    The box stands apart because its statements are kept: its numbers are values of bind parameters.

    Attributes:
        box: None for the whole world.
        non_bbox_predicate: what is required beside the box; None: nothing. Its literals are bind
            parameters.
        has_spatial_predicate: whether `non_bbox_predicate` confines features to a place, so that the
            index of geometries serves it.
    """

    box: Box | None = None
    non_bbox_predicate: ColumnElement[bool] | None = None
    has_spatial_predicate: bool = False

    @property
    def spatial(self) -> bool:
        """Whether the index of geometries serves the condition."""
        return self.box is not None or self.has_spatial_predicate

    def __and__(self, other: "Condition") -> "Condition":
        if self.box is not None and other.box is not None:
            raise ValueError("both conditions have a box: intersect the boxes first")
        return Condition(
            self.box or other.box,
            _both(self.non_bbox_predicate, other.non_bbox_predicate),
            self.has_spatial_predicate or other.has_spatial_predicate,
        )


def _both(
    one: ColumnElement[bool] | None, other: ColumnElement[bool] | None
) -> ColumnElement[bool] | None:
    """Two predicates as one; a single one stays the same object, by which its statements are kept."""
    if one is None:
        return other
    return one if other is None else and_(one, other)


ANYTHING = Condition()


@dataclass(frozen=True)
class BoxShape:
    """What the predicate of a box depends on: its number of longitude ranges and its heights."""

    ranges: int
    bounds_height: bool

    @staticmethod
    def of(box: Box, collection: Collection) -> "BoxShape":
        """The shape of a box; heights count only where positions have one."""
        return BoxShape(len(box.longitude_ranges), collection.has_height and box.bounds_height)


def box_predicate(collection: Collection, shape: BoxShape) -> ColumnElement[bool]:
    """The predicate that a feature meets a box: by the index, which is coarser, then exactly.

    A feature without a geometry meets every box; the predicate asks only where some may have none.

    The exact part is wrapped in `coalesce`, which the planner does not look into. It would estimate that
    four comparisons with unknown values are very selective, and read the whole world for a first page.

    Returns:
        A predicate with the bind parameters of `box_parameters`.
    """
    geometry = collection.geometry
    is_point = collection.geometry_type == "Point"
    srid = integer_constant(collection.storage_crs.srid)
    near: list[ColumnElement[bool]] = []
    exact: list[ColumnElement[bool]] = []
    for i in range(shape.ranges):
        west, east = _number(f"west{i}"), _number(f"east{i}")
        envelope = func.st_makeenvelope(west, _number("south"), east, _number("north"), srid)
        near.append(meets_box(geometry, envelope))
        exact.append(
            func.st_x(geometry).between(west, east)
            if is_point
            else func.st_intersects(geometry, envelope)
        )
    parts: list[ColumnElement[bool]] = [or_(*exact)]
    if is_point:
        parts.append(func.st_y(geometry).between(_number("south"), _number("north")))
    if shape.bounds_height:
        parts.append(height_predicate(collection))
    inside = and_(or_(*near), func.coalesce(and_(*parts), false()))
    return or_(geometry.is_(None), inside) if collection.geometry_nullable else inside


def height_predicate(collection: Collection) -> ColumnElement[bool]:
    """The predicate that a point's height is between the bind parameters `low` and `high`."""
    return func.st_z(collection.geometry).between(_number("low"), _number("high"))


def box_parameters(box: Box) -> dict[str, float]:
    """Values of the bind parameters of `box_predicate`."""
    ends = {"south": box.south, "north": box.north, "low": box.low_m, "high": box.high_m}
    for i, (west, east) in enumerate(box.longitude_ranges):
        ends |= {f"west{i}": west, f"east{i}": east}
    return ends


def in_time(collection: Collection, since: Moment | None, until: Moment | None) -> Condition:
    """The condition that a feature's time meets an interval; None for an open end.

    A feature without a time meets every interval, and so does an unknown end of its time on that side.
    """
    if collection.interval is None:
        return ANYTHING
    start, end = (collection.columns[name] for name in collection.interval)
    parts = []
    if until is not None:
        parts.append(_or_unknown(start, Time.of(start) <= Time.of(until)))
    if since is not None:
        parts.append(_or_unknown(end, Time.of(end) >= Time.of(since)))
    return Condition(non_bbox_predicate=and_(*parts)) if parts else ANYTHING


def _or_unknown(item: Property, predicate: ColumnElement[bool]) -> ColumnElement[bool]:
    return or_(item.expression.is_(None), predicate) if item.nullable else predicate


def key_among(collection: Collection, references: tuple[str, ...]) -> Condition:
    """The condition that the key of a feature, as text, is one of some texts."""
    key = cast(collection.key.expression, Text())
    return Condition(non_bbox_predicate=key == any_(literal(list(references), ARRAY(Text()))))


def meets_box(geometry: ColumnElement[Any], envelope: ColumnElement[Any]) -> ColumnElement[bool]:
    """Whether the bounding boxes of two geometries meet, which the index of geometries finds."""
    return geometry.bool_op("&&")(envelope)


def geometry_from_wkb(wkb: ColumnElement[bytes], srid: int) -> ColumnElement[Any]:
    """A geometry of a value in WKB.

    The function `geometry` is PostGIS's cast from bytes. GeoAlchemy2 compiles `st_geomfromwkb` with the
    reference system in the text, which SQLAlchemy would then keep for other values.
    """
    geometry = func.geometry(wkb, type_=NullType())
    return func.st_setsrid(geometry, integer_constant(srid))


def _number(name: str) -> ColumnElement[float]:
    return bindparam(name, None, Float())
