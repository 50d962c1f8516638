"""Filters: CQL2, parsed by its library, as expressions of SQLAlchemy made of what is allowed here.

Sources: OGC 21-065r2, Common Query Language (CQL2); OGC 19-079r2, OGC API - Features, Part 3: Filtering.
No part of a filter becomes text of a statement: every literal is a bind parameter, every property is a
column of the collection, every operator comes from one of the tables below. The library's own SQL is
never used: it lets any function name through.
"""

import json
import operator
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sqlalchemy import (
    REAL,
    BigInteger,
    Boolean,
    ColumnElement,
    LargeBinary,
    Numeric,
    Text,
    and_,
    cast,
    func,
    literal,
    not_,
    or_,
)

from amers.app.db.constants import integer_constant
from amers.app.db.features.collection import Collection, Property
from amers.app.db.features.cql2_bounds import MOST_NODES, parse_geometry
from amers.app.db.features.cql2_text import parse_text
from amers.app.db.features.crs import CRS84, Crs
from amers.app.db.features.instants import Moment, Time, parse_moment
from amers.app.db.features.predicates import Condition, geometry_from_wkb
from amers.app.db.schema.base import Double
from amers.app.errors import InvalidParameter

GEOMETRY = ("geometry", "geom")
KEPT_FILTERS = 32
DEEPEST_EXPRESSION = 32
"""Operators in each other. SQLAlchemy compiles them recursively, with a dozen calls for each."""
LARGEST_NUMBER = sys.float_info.max

Expression = ColumnElement[Any]
Predicate = ColumnElement[bool]


def _quotient(left: Expression, right: Expression) -> Expression:
    """Division; unknown for a divisor of zero."""
    return left / func.nullif(right, integer_constant(0), type_=Double)


def _remainder(left: Expression, right: Expression) -> Expression:
    divisor = func.nullif(cast(right, Numeric()), integer_constant(0), type_=Numeric())
    return cast(func.mod(cast(left, Numeric()), divisor), Double)


COMPARISONS: Mapping[str, Callable[[Any, Any], Predicate]] = {
    "=": operator.eq,
    "<>": operator.ne,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
ARITHMETIC: Mapping[str, Callable[[Expression, Expression], Expression]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": _quotient,
    "div": lambda left, right: func.trunc(_quotient(left, right), type_=Double),
    "^": lambda left, right: func.power(left, right, type_=Double),
    "%": _remainder,
}
SPATIAL: Mapping[str, Callable[[Expression, Expression], Predicate]] = {
    "s_intersects": func.st_intersects,
    "s_equals": func.st_equals,
    "s_disjoint": func.st_disjoint,
    "s_touches": func.st_touches,
    "s_within": func.st_within,
    "s_overlaps": func.st_overlaps,
    "s_crosses": func.st_crosses,
    "s_contains": func.st_contains,
}
# Of two intervals: the start and end of a, the start and end of b.
TEMPORAL: Mapping[str, Callable[[Time, Time, Time, Time], Predicate]] = {
    "t_after": lambda a, a_end, b, b_end: a > b_end,
    "t_before": lambda a, a_end, b, b_end: a_end < b,
    "t_contains": lambda a, a_end, b, b_end: and_(a < b, a_end > b_end),
    "t_disjoint": lambda a, a_end, b, b_end: or_(a_end < b, a > b_end),
    "t_during": lambda a, a_end, b, b_end: and_(a > b, a_end < b_end),
    "t_equals": lambda a, a_end, b, b_end: and_(a == b, a_end == b_end),
    "t_finishedby": lambda a, a_end, b, b_end: and_(a < b, a_end == b_end),
    "t_finishes": lambda a, a_end, b, b_end: and_(a > b, a_end == b_end),
    "t_intersects": lambda a, a_end, b, b_end: and_(a <= b_end, a_end >= b),
    "t_meets": lambda a, a_end, b, b_end: a_end == b,
    "t_metby": lambda a, a_end, b, b_end: a == b_end,
    "t_overlappedby": lambda a, a_end, b, b_end: and_(a > b, a < b_end, a_end > b_end),
    "t_overlaps": lambda a, a_end, b, b_end: and_(a < b, a_end > b, a_end < b_end),
    "t_startedby": lambda a, a_end, b, b_end: and_(a == b, a_end > b_end),
    "t_starts": lambda a, a_end, b, b_end: and_(a == b, a_end < b_end),
}


@lru_cache(KEPT_FILTERS)
def translate_text(text: str, collection: Collection, crs: Crs) -> Condition:
    """A filter in CQL2 text as a condition, kept for the next box or page with the same filter.

    Args:
        crs: of the coordinates in the filter.

    Raises:
        InvalidParameter: as `parse_text` and `translate`.
    """
    return translate(parse_text(text), collection, crs)


def translate(expression: Any, collection: Collection, crs: Crs) -> Condition:
    """A filter as a condition.

    Args:
        expression: CQL2 JSON.
        collection: whose properties it may name.
        crs: of the coordinates in it.

    Raises:
        InvalidParameter: the filter names something that the collection does not have, or compares
            values that cannot be compared.
    """
    predicate = _Translator(collection, crs).boolean(expression)
    return Condition(non_bbox_predicate=predicate, has_spatial_predicate=_is_spatial(expression))


def geometry_condition(collection: Collection, geometry: Any, where: str) -> Condition:
    """The condition that a feature meets a GeoJSON geometry, longitude first.

    Raises:
        InvalidParameter: the geometry cannot be used; the message names `where` it stood.
    """
    shape = _geometry_literal(collection, parse_geometry(geometry, CRS84, where))
    return Condition(
        non_bbox_predicate=func.st_intersects(collection.geometry, shape), has_spatial_predicate=True
    )


@dataclass(frozen=True)
class _Value:
    """A scalar of a filter: its expression and kind, and the property or the literal behind it."""

    expression: Expression
    kind: str
    property: Property | None = None
    literal: Any = None
    is_date: bool = False

    def operand(self) -> Expression | Time:
        """What it is compared by."""
        return Time(self.expression, self.is_date) if self.kind == "time" else self.expression


class _Translator:
    """One translation; it counts the parts of the filter and how deep they stand in each other."""

    def __init__(self, collection: Collection, crs: Crs) -> None:
        self.collection = collection
        self.crs = crs
        self.nodes = 0
        self.depth = 0
        self.operators: tuple[tuple[Mapping[str, Any], Callable[[str, Any], Predicate]], ...] = (
            ({"and": and_, "or": or_}, self._junction),
            ({"not": not_}, self._not),
            (COMPARISONS, self._comparison),
            ({"like": ...}, self._like),
            ({"between": ...}, self._between),
            ({"in": ...}, self._in),
            ({"isnull": ...}, self._is_null),
            (SPATIAL, self._spatial),
            (TEMPORAL, self._temporal),
        )

    def boolean(self, node: Any) -> Predicate:
        """A condition of the filter as a predicate."""
        self._add_nodes(1)
        if isinstance(node, bool):
            return literal(node, Boolean())
        if not isinstance(node, dict) or not isinstance(node.get("op"), str):
            return self._boolean_property(node)
        op, args = node["op"].lower(), node.get("args")
        if not isinstance(args, list):
            raise InvalidParameter(f"filter: {op:.40}: a list of arguments expected")
        for operators, translate in self.operators:
            if op in operators:
                self._enter()
                predicate = translate(op, args)
                self.depth -= 1
                return predicate
        raise InvalidParameter(f"filter: no operator or function {node['op']!r:.60} here")

    def _add_nodes(self, count: int) -> None:
        self.nodes += count
        if self.nodes > MOST_NODES:
            raise InvalidParameter(
                f"filter: more than {MOST_NODES} conditions, functions and values of lists: split it"
            )

    def _enter(self) -> None:
        self.depth += 1
        if self.depth > DEEPEST_EXPRESSION:
            raise InvalidParameter(
                f"filter: operators more than {DEEPEST_EXPRESSION} deep in each other: split the filter"
            )

    def _boolean_property(self, node: Any) -> Predicate:
        if isinstance(node, dict) and "property" in node:
            item = self._property(node["property"])
            if item.type == "boolean":
                return item.expression
            raise InvalidParameter(f"filter: {item.name} is not true or false: compare it with a value")
        raise InvalidParameter(f"filter: a condition expected, {json.dumps(node)!s:.60} found")

    def _junction(self, op: str, args: list[Any]) -> Predicate:
        _count(op, args, 1, MOST_NODES)
        parts = [self.boolean(arg) for arg in args]
        return and_(*parts) if op == "and" else or_(*parts)

    def _not(self, op: str, args: list[Any]) -> Predicate:
        _count(op, args, 1)
        return not_(self.boolean(args[0]))

    def _comparison(self, op: str, args: list[Any]) -> Predicate:
        _count(op, args, 2)
        return COMPARISONS[op](*self._pair(args[0], args[1]))

    def _between(self, op: str, args: list[Any]) -> Predicate:
        _count(op, args, 3)
        value, low = self._pair(args[0], args[1])
        same_value, high = self._pair(args[0], args[2])
        return and_(value >= low, same_value <= high)

    def _in(self, op: str, args: list[Any]) -> Predicate:
        _count(op, args, 2)
        if not isinstance(args[1], list) or not args[1]:
            raise InvalidParameter("filter: in: a list of values expected")
        self._add_nodes(len(args[1]))
        return or_(*(operator.eq(*self._pair(args[0], value)) for value in args[1]))

    def _like(self, op: str, args: list[Any]) -> Predicate:
        _count(op, args, 2)
        left, right = self._scalar(args[0]), self._scalar(args[1])
        if (left.kind, right.kind) != ("text", "text"):
            raise InvalidParameter("filter: like: texts expected")
        pattern = right.literal
        if pattern is None or (len(pattern) - len(pattern.rstrip("\\"))) % 2:
            raise InvalidParameter("filter: like: a pattern that does not end with one \\ expected")
        return left.expression.like(right.expression)

    def _is_null(self, op: str, args: list[Any]) -> Predicate:
        _count(op, args, 1)
        if isinstance(args[0], dict) and args[0].get("property") in GEOMETRY:
            return self.collection.geometry.is_(None)
        return self._scalar(args[0]).expression.is_(None)

    def _pair(self, left_node: Any, right_node: Any) -> tuple[Any, Any]:
        """Two scalars that can be compared, each literal in the type of the other side."""
        left, right = self._scalar(left_node), self._scalar(right_node)
        left, right = self._in_type_of(right, left), self._in_type_of(left, right)
        if left.kind != right.kind:
            raise InvalidParameter(
                f"filter: {_name(left_node)} is {left.kind} and {_name(right_node)} is {right.kind}:"
                " they cannot be compared"
            )
        return left.operand(), right.operand()

    def _in_type_of(self, other: _Value, value: _Value) -> _Value:
        """A literal in the type of the property beside it: 0.7 of single precision, a date of a text."""
        item = other.property
        if item is None or value.literal is None:
            return value
        if item.type == "real" and value.kind == "number":
            return _Value(cast(value.expression, REAL()), "number")
        if item.is_time and value.kind == "text":
            return _time(parse_moment(value.literal, "filter"))
        return value

    def _scalar(self, node: Any) -> _Value:
        if isinstance(node, bool):
            return _Value(literal(node, Boolean()), "boolean")
        if isinstance(node, int | float):
            return self._number(node)
        if isinstance(node, str):
            if "\0" in node:
                raise InvalidParameter("filter: a text holds a character NUL")
            return _Value(cast(literal(node, Text()), Text()), "text", literal=node)
        if not isinstance(node, dict):
            raise InvalidParameter(f"filter: a value expected, {json.dumps(node)!s:.60} found")
        if "property" in node:
            item = self._property(node["property"])
            return _Value(item.expression, _kind(item), property=item, is_date=item.type == "date")
        if "date" in node or "timestamp" in node:
            return _time_literal(node)
        self._enter()
        value = self._function(node)
        self.depth -= 1
        return value

    def _number(self, node: int | float) -> _Value:
        # A whole number of JSON may have any number of digits.
        if not abs(node) <= LARGEST_NUMBER:
            raise InvalidParameter(f"filter: a number below {LARGEST_NUMBER:.1e} expected")
        # Whole numbers stay whole, so that the index of the key serves them.
        if float(node).is_integer() and abs(node) < 2**53:
            return _Value(literal(int(node), BigInteger()), "number", literal=node)
        return _Value(cast(literal(float(node), Double), Double), "number", literal=node)

    def _function(self, node: dict[str, Any]) -> _Value:
        op, args = node.get("op"), node.get("args")
        if not isinstance(op, str) or not isinstance(args, list):
            raise InvalidParameter(f"filter: a value expected, {json.dumps(node)!s:.60} found")
        self._add_nodes(1)
        op = op.lower()
        if op == "casei":
            _count(op, args, 1)
            inner = self._scalar(args[0])
            if inner.kind != "text":
                raise InvalidParameter("filter: casei: a text expected")
            return _Value(func.lower(inner.expression, type_=Text()), "text", literal=inner.literal)
        if op not in ARITHMETIC:
            raise InvalidParameter(f"filter: no operator or function {node['op']!r:.60} here")
        if op == "-" and len(args) == 1:
            args = [0, *args]
        _count(op, args, 2)
        sides = [self._scalar(arg) for arg in args]
        if any(side.kind != "number" for side in sides):
            raise InvalidParameter(f"filter: {op}: numbers expected")
        left, right = (cast(side.expression, Double) for side in sides)
        return _Value(ARITHMETIC[op](left, right), "number")

    def _spatial(self, op: str, args: list[Any]) -> Predicate:
        _count(op, args, 2)
        if op != "s_intersects" and any(_is_collection(arg) for arg in args):
            raise InvalidParameter(f"filter: {op}: a GeometryCollection has no such relation")
        # PostGIS itself asks the index first, for all relations that an index can serve.
        return SPATIAL[op](self._geometry(args[0]), self._geometry(args[1]))

    def _geometry(self, node: Any) -> Expression:
        if isinstance(node, dict) and "property" in node:
            if node["property"] not in GEOMETRY:
                raise InvalidParameter(f"filter: {node['property']!r:.60} is not a geometry")
            return self.collection.geometry
        return _geometry_literal(self.collection, parse_geometry(node, self.crs, "filter"))

    def _temporal(self, op: str, args: list[Any]) -> Predicate:
        _count(op, args, 2)
        return TEMPORAL[op](*self._interval(args[0]), *self._interval(args[1]))

    def _interval(self, node: Any) -> tuple[Time, Time]:
        if isinstance(node, dict) and "interval" in node:
            ends = node["interval"]
            if not isinstance(ends, list) or len(ends) != 2:
                raise InvalidParameter("filter: an interval has two ends")
            return self._end(ends[0], Time.unbounded("-")), self._end(ends[1], Time.unbounded())
        instant = self._end(node, Time.unbounded())
        return instant, instant

    def _end(self, node: Any, unbounded: Time) -> Time:
        if node == "..":
            return unbounded
        value = _time(parse_moment(node, "filter")) if isinstance(node, str) else self._scalar(node)
        if value.kind != "time":
            raise InvalidParameter(f"filter: {_name(node)} is {value.kind}, a time expected")
        return Time(value.expression, value.is_date)

    def _property(self, name: Any) -> Property:
        item = self.collection.queryables.get(name) if isinstance(name, str) else None
        if item is None:
            names = ", ".join([*self.collection.queryables, GEOMETRY[0]])
            raise InvalidParameter(
                f"filter: no property {name!r:.60} in {self.collection.id}: there are {names}"
            )
        return item


def _geometry_literal(collection: Collection, wkb: bytes) -> Expression:
    return geometry_from_wkb(literal(wkb, LargeBinary()), collection.storage_crs.srid)


def _kind(item: Property) -> str:
    if item.is_time:
        return "time"
    return "number" if item.is_number else item.type


def _time(moment: Moment) -> _Value:
    time = Time.of(moment)
    return _Value(time.expression, "time", is_date=time.is_date)


def _time_literal(node: dict[str, Any]) -> _Value:
    """The value of a literal: a date in `DATE(…)`, an instant in `TIMESTAMP(…)`."""
    name = "date" if "date" in node else "timestamp"
    value = _time(parse_moment(node[name], "filter"))
    if value.is_date != (name == "date"):
        expected = "2024-05-06" if name == "date" else "2024-05-06T07:08:09Z"
        raise InvalidParameter(
            f"filter: {name.upper()}: {node[name]!r:.60} found, such as {expected} expected"
        )
    return value


def _is_collection(node: Any) -> bool:
    return isinstance(node, dict) and node.get("type") == "GeometryCollection"


def _is_spatial(node: Any) -> bool:
    """Whether everything that meets the filter lies in a place the index can find."""
    if not isinstance(node, dict):
        return False
    if node.get("op") == "and":
        return any(_is_spatial(arg) for arg in node["args"])
    return node.get("op") in SPATIAL and node["op"] != "s_disjoint"


def _count(op: str, args: list[Any], low: int, high: int | None = None) -> None:
    if not low <= len(args) <= (low if high is None else high):
        raise InvalidParameter(f"filter: {op}: {len(args)} arguments found, {low} expected")


def _name(node: Any) -> str:
    return str(node["property"]) if isinstance(node, dict) and "property" in node else repr(node)[:60]
