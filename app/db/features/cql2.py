"""Filters: CQL2 parsed by its library, and made into SQL with parameters from what we allow.

Sources: OGC 21-065r2, Common Query Language (CQL2); OGC 19-079r2, OGC API - Features, Part 3: Filtering.
The library's own SQL is never used: it lets any function name through.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from app.db.features.collection import Collection, Property
from app.db.features.cql2_bounds import MOST_NODES, parse_geometry, parse_instant
from app.db.features.crs import CRS84, Crs
from app.db.features.predicates import Condition
from app.errors import InvalidParameter

GEOMETRY = ("geometry", "geom")
COMPARISONS = ("=", "<>", "<", "<=", ">", ">=")
ARITHMETIC = {
    "+": "({0} + {1})",
    "-": "({0} - {1})",
    "*": "({0} * {1})",
    "/": "({0} / nullif({1}, 0))",
    "div": "trunc({0} / nullif({1}, 0))",
    "^": "power({0}, {1})",
    "%": "mod(({0})::numeric, nullif(({1})::numeric, 0))::float8",
}
SPATIAL = {
    "s_intersects": "st_intersects",
    "s_equals": "st_equals",
    "s_disjoint": "st_disjoint",
    "s_touches": "st_touches",
    "s_within": "st_within",
    "s_overlaps": "st_overlaps",
    "s_crosses": "st_crosses",
    "s_contains": "st_contains",
}
# Of two intervals, a from {0} to {1} and b from {2} to {3}.
TEMPORAL = {
    "t_after": "{0} > {3}",
    "t_before": "{1} < {2}",
    "t_contains": "{0} < {2} and {1} > {3}",
    "t_disjoint": "({1} < {2} or {0} > {3})",
    "t_during": "{0} > {2} and {1} < {3}",
    "t_equals": "{0} = {2} and {1} = {3}",
    "t_finishedby": "{0} < {2} and {1} = {3}",
    "t_finishes": "{0} > {2} and {1} = {3}",
    "t_intersects": "{0} <= {3} and {1} >= {2}",
    "t_meets": "{1} = {2}",
    "t_metby": "{0} = {3}",
    "t_overlappedby": "{0} > {2} and {0} < {3} and {1} > {3}",
    "t_overlaps": "{0} < {2} and {1} > {2} and {1} < {3}",
    "t_startedby": "{0} = {2} and {1} > {3}",
    "t_starts": "{0} = {2} and {1} < {3}",
}


def translate(expression: Any, collection: Collection, crs: Crs, prefix: str = "f") -> Condition:
    """A filter as SQL.

    Args:
        expression: CQL2 JSON.
        collection: whose properties it may name.
        crs: of the coordinates in it.
        prefix: of the names of its parameters.

    Raises:
        InvalidParameter: it names what there is not, or compares what cannot be compared.
    """
    translator = _Translator(collection, crs, prefix)
    sql = translator.boolean(expression)
    return Condition(f"({sql})", translator.parameters, _is_spatial(expression), beside=f"({sql})")


def geometry_condition(collection: Collection, geometry: Any, where: str) -> Condition:
    """The condition that a feature meets a GeoJSON geometry, longitude first.

    Raises:
        InvalidParameter: it is not a geometry that can be used; naming `where` it stood.
    """
    srid = collection.storage_crs.srid
    literal = f"st_setsrid(%({where})s::geometry, {srid})"
    sql = f"st_intersects({collection.geometry}, {literal})"
    shape = parse_geometry(geometry, CRS84, where)
    return Condition(sql, {where: shape}, spatial=True, beside=sql)


@dataclass(frozen=True)
class _Value:
    """A scalar of a filter: its SQL, what it is, and the property or the literal behind it."""

    sql: str
    kind: str
    property: Property | None = None
    literal: Any = None


class _Translator:
    """One translation: SQL comes back, parameters gather."""

    def __init__(self, collection: Collection, crs: Crs, prefix: str) -> None:
        self.collection = collection
        self.crs = crs
        self.prefix = prefix
        self.parameters: dict[str, Any] = {}
        self.nodes = 0

    def boolean(self, node: Any) -> str:
        """SQL of a condition."""
        self.nodes += 1
        if self.nodes > MOST_NODES:
            raise InvalidParameter(f"filter: more than {MOST_NODES} conditions")
        if isinstance(node, bool):
            return "true" if node else "false"
        if not isinstance(node, dict) or not isinstance(node.get("op"), str):
            return self._boolean_property(node)
        op, args = node["op"].lower(), node.get("args")
        if not isinstance(args, list):
            raise InvalidParameter(f"filter: {op:.40}: a list of arguments expected")
        for operators, translate in self._kinds():
            if op in operators:
                return translate(op, args)
        raise InvalidParameter(f"filter: no operator or function {node['op']!r:.60} here")

    def _kinds(self) -> tuple[tuple[Sequence[str] | Mapping[str, str], Callable[[str, Any], str]], ...]:
        return (
            (("and", "or"), self._junction),
            (("not",), self._not),
            (COMPARISONS, self._comparison),
            (("like",), self._like),
            (("between",), self._between),
            (("in",), self._in),
            (("isnull",), self._is_null),
            (SPATIAL, self._spatial),
            (TEMPORAL, self._temporal),
        )

    def _boolean_property(self, node: Any) -> str:
        if isinstance(node, dict) and "property" in node:
            found = self._property(node["property"])
            if found.type == "boolean":
                return found.expression
            raise InvalidParameter(f"filter: {found.name} is not true or false: compare it with a value")
        raise InvalidParameter(f"filter: a condition expected, {json.dumps(node)!s:.60} found")

    def _junction(self, op: str, args: list[Any]) -> str:
        _count(op, args, 1, MOST_NODES)
        return "(" + f" {op} ".join(self.boolean(arg) for arg in args) + ")"

    def _not(self, op: str, args: list[Any]) -> str:
        _count(op, args, 1)
        return f"(not {self.boolean(args[0])})"

    def _comparison(self, op: str, args: list[Any]) -> str:
        _count(op, args, 2)
        left, right = self._pair(args[0], args[1])
        return f"({left} {op} {right})"

    def _between(self, op: str, args: list[Any]) -> str:
        _count(op, args, 3)
        low = self._pair(args[0], args[1])
        high = self._pair(args[0], args[2])
        return f"({low[0]} >= {low[1]} and {high[0]} <= {high[1]})"

    def _in(self, op: str, args: list[Any]) -> str:
        _count(op, args, 2)
        if not isinstance(args[1], list) or not args[1]:
            raise InvalidParameter("filter: in: a list of values expected")
        pairs = (self._pair(args[0], value) for value in args[1])
        return "(" + " or ".join(f"{left} = {right}" for left, right in pairs) + ")"

    def _like(self, op: str, args: list[Any]) -> str:
        _count(op, args, 2)
        left, right = self._scalar(args[0]), self._scalar(args[1])
        if (left.kind, right.kind) != ("text", "text"):
            raise InvalidParameter("filter: like: texts expected")
        pattern = right.literal
        if pattern is None or (len(pattern) - len(pattern.rstrip("\\"))) % 2:
            raise InvalidParameter("filter: like: a pattern that does not end with one \\ expected")
        return f"({left.sql} like {right.sql})"

    def _is_null(self, op: str, args: list[Any]) -> str:
        _count(op, args, 1)
        if isinstance(args[0], dict) and args[0].get("property") in GEOMETRY:
            return f"({self.collection.geometry} is null)"
        return f"({self._scalar(args[0]).sql} is null)"

    def _pair(self, left_node: Any, right_node: Any) -> tuple[str, str]:
        """SQL of two scalars that can be compared, each seen as the other is."""
        left, right = self._scalar(left_node), self._scalar(right_node)
        left, right = self._seen_as(left, right), self._seen_as(right, left)
        if left.kind != right.kind:
            raise InvalidParameter(
                f"filter: {_said(left_node)} is {left.kind} and {_said(right_node)} is {right.kind}:"
                " they cannot be compared"
            )
        return left.sql, right.sql

    def _seen_as(self, value: _Value, other: _Value) -> _Value:
        """A literal as the property beside it is kept: 0.7 of single precision, a date out of a text."""
        kept = other.property
        if kept is None or value.literal is None:
            return value
        if kept.type == "real" and value.kind == "number":
            return _Value(f"({value.sql})::real", "number")
        if kept.is_time and value.kind == "text":
            return self._instant(value.literal)
        return value

    def _scalar(self, node: Any) -> _Value:
        if isinstance(node, bool):
            return _Value("true" if node else "false", "boolean")
        if isinstance(node, int | float):
            return self._number(node)
        if isinstance(node, str):
            if "\0" in node:
                raise InvalidParameter("filter: a text holds a character NUL")
            return _Value(self._bind(node, "text"), "text", literal=node)
        if not isinstance(node, dict):
            raise InvalidParameter(f"filter: a value expected, {json.dumps(node)!s:.60} found")
        if "property" in node:
            found = self._property(node["property"])
            return _Value(*_expression(found), property=found)
        if "date" in node or "timestamp" in node:
            return self._instant(node.get("date", node.get("timestamp")))
        return self._function(node)

    def _number(self, node: int | float) -> _Value:
        if not math.isfinite(node):
            raise InvalidParameter(f"filter: {node} is not a number to compare with")
        # Whole numbers stay whole, so that the index of the key serves them.
        whole = float(node).is_integer() and abs(node) < 2**53
        sql = self._bind(int(node), "bigint") if whole else self._bind(float(node), "float8")
        return _Value(sql, "number", literal=node)

    def _function(self, node: dict[str, Any]) -> _Value:
        op, args = node.get("op"), node.get("args")
        if not isinstance(op, str) or not isinstance(args, list):
            raise InvalidParameter(f"filter: a value expected, {json.dumps(node)!s:.60} found")
        self.nodes += 1
        if op.lower() == "casei":
            _count(op, args, 1)
            inner = self._scalar(args[0])
            if inner.kind != "text":
                raise InvalidParameter("filter: casei: a text expected")
            return _Value(f"lower({inner.sql})", "text", literal=inner.literal)
        if op not in ARITHMETIC:
            raise InvalidParameter(f"filter: no operator or function {op!r:.60} here")
        if op == "-" and len(args) == 1:
            args = [0, *args]
        _count(op, args, 2)
        sides = [self._scalar(arg) for arg in args]
        if any(side.kind != "number" for side in sides):
            raise InvalidParameter(f"filter: {op}: numbers expected")
        return _Value(ARITHMETIC[op].format(*(f"({side.sql})::float8" for side in sides)), "number")

    def _spatial(self, op: str, args: list[Any]) -> str:
        _count(op, args, 2)
        if op != "s_intersects" and any(_is_collection(arg) for arg in args):
            raise InvalidParameter(f"filter: {op}: a GeometryCollection has no such relation")
        sides = [self._geometry(arg) for arg in args]
        # A box of the index first: PostGIS does so itself but for the relations it has no index for.
        return f"{SPATIAL[op]}({sides[0]}, {sides[1]})"

    def _geometry(self, node: Any) -> str:
        if isinstance(node, dict) and "property" in node:
            if node["property"] not in GEOMETRY:
                raise InvalidParameter(f"filter: {node['property']!r:.60} is not a geometry")
            return self.collection.geometry
        srid = self.collection.storage_crs.srid
        literal = self._bind(parse_geometry(node, self.crs, "filter"), "geometry")
        return f"st_setsrid({literal}, {srid})"

    def _temporal(self, op: str, args: list[Any]) -> str:
        _count(op, args, 2)
        ends = (*self._interval(args[0]), *self._interval(args[1]))
        return "(" + TEMPORAL[op].format(*ends) + ")"

    def _interval(self, node: Any) -> tuple[str, str]:
        if isinstance(node, dict) and "interval" in node:
            ends = node["interval"]
            if not isinstance(ends, list) or len(ends) != 2:
                raise InvalidParameter("filter: an interval has two ends")
            low, high = (self._end(end, open_) for end, open_ in zip(ends, ("-", ""), strict=True))
            return low, high
        instant = self._end(node, "")
        return instant, instant

    def _end(self, node: Any, sign: str) -> str:
        if node == "..":
            return f"'{sign}infinity'::timestamptz"
        value = self._instant(node) if isinstance(node, str) else self._scalar(node)
        if value.kind != "time":
            raise InvalidParameter(f"filter: {_said(node)} is {value.kind}, a time expected")
        return value.sql

    def _instant(self, text: Any) -> _Value:
        instant = parse_instant(text, "filter")
        return _Value(self._bind(instant, "timestamptz"), "time")

    def _property(self, name: Any) -> Property:
        found = self.collection.queryables.get(name) if isinstance(name, str) else None
        if found is None:
            known = ", ".join([*self.collection.queryables, GEOMETRY[0]])
            raise InvalidParameter(
                f"filter: no property {name!r:.60} in {self.collection.id}: there are {known}"
            )
        return found

    def _bind(self, value: Any, kind: str) -> str:
        name = f"{self.prefix}{len(self.parameters)}"
        self.parameters[name] = value
        return f"%({name})s::{kind}"


def _expression(found: Property) -> tuple[str, str]:
    if found.type == "date":
        return f"({found.expression}::timestamp at time zone 'UTC')", "time"
    kind = "number" if found.is_number else {"timestamptz": "time"}.get(found.type, found.type)
    return found.expression, kind


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


def _said(node: Any) -> str:
    return str(node["property"]) if isinstance(node, dict) and "property" in node else repr(node)[:60]
