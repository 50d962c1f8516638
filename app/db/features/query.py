"""Which features of a collection a request selects, and the statements of a page of them.

A statement is built once for each layout and shape of a request; boxes, keys and limits are values of
its bind parameters. Only the predicate of a user's filter is added to it request by request.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from sqlalchemy import (
    BigInteger,
    ColumnElement,
    Label,
    Select,
    Text,
    and_,
    bindparam,
    cast,
    or_,
    select,
    true,
)

from amers.app.db.constants import integer_constant
from amers.app.db.features.collection import Collection, Property, Viewer
from amers.app.db.features.crs import Crs
from amers.app.db.features.predicates import ANYTHING, BoxShape, Condition, box_parameters, box_predicate
from amers.app.db.opaque import opaque
from amers.app.db.schema.base import Double
from amers.app.db.statements import HotStatement, hot_like

KEPT_STATEMENTS = 512
"""Statements kept for each step: of the layouts and orders that users ask for."""
KEPT_FILTERED = 32
"""Statements kept with a user's filter: one of a thousand parts takes megabytes."""

LIMIT = bindparam("limit", None, BigInteger())
AFTER_KEY = bindparam("after_key", None, BigInteger())
BEFORE_ALL_KEYS = -1

Key = tuple[Any, ...]
"""The values that order features, of one of them."""


@dataclass(frozen=True)
class Order:
    """Features in the order of a property."""

    property: Property
    descending: bool = False


@dataclass(frozen=True)
class Layout:
    """What a statement of features depends on besides their selection.

    Attributes:
        orders: by these, the last of which is the key.
    """

    collection: Collection
    properties: tuple[Property, ...]
    crs: Crs
    orders: tuple[Order, ...]


Columns = Callable[[Layout], Mapping[str, ColumnElement[Any]]]
"""The columns of a row of a page, by name."""


@dataclass(frozen=True)
class Selection:
    """The features that a request selects, and how they are replied.

    Attributes:
        viewer: the caller.
        crs: of the reply.
        properties: of each feature, in this order.
        condition: that features meet.
        order: by these, then by the key.
    """

    collection: Collection
    viewer: Viewer
    crs: Crs
    properties: tuple[Property, ...]
    condition: Condition = ANYTHING
    order: tuple[Order, ...] = ()

    @property
    def orders(self) -> tuple[Order, ...]:
        """The order, made definite by the key."""
        return (*self.order, Order(self.collection.key))

    @property
    def layout(self) -> Layout:
        """What its statements depend on."""
        return Layout(self.collection, self.properties, self.crs, self.orders)

    @property
    def box_shape(self) -> BoxShape | None:
        """The shape of the box of its condition."""
        box = self.condition.box
        return None if box is None else BoxShape.of(box, self.collection)

    @property
    def parameters(self) -> dict[str, Any]:
        """Values of the bind parameters of its condition: the caller and the box."""
        box = self.condition.box
        return {**self.viewer.parameters, **({} if box is None else box_parameters(box))}


def page_select(selection: Selection, columns: Columns, after: Key | None) -> Select[Any]:
    """SELECT of a page and of one row more, in order.

    Args:
        selection: of the rows.
        columns: of each row.
        after: the values that order features, of the last feature before the page; None for the first.

    Returns:
        A statement with the bind parameters of `page_parameters`. It is kept for all selections of the
        same layout, and with a user's filter for the next request with the same one.
    """
    layout, condition = selection.layout, selection.condition
    predicate = condition.non_bbox_predicate
    if layout.collection.full_scan and not selection.order and not condition.spatial:
        return _kept_full_scan(layout, columns, predicate)
    unknown_after = None if after is None else tuple(value is None for value in after)
    statement = _kept_select(layout, columns, selection.box_shape, unknown_after)
    return statement if predicate is None else _kept_filtered(statement, predicate)


def hot_page(selection: Selection, columns: Columns, after: Key | None) -> HotStatement:
    """`page_select` compiled, once for all requests of the same structure."""
    return _kept_hot(page_select(selection, columns, after))


def page_parameters(selection: Selection, after: Key | None, limit: int) -> dict[str, Any]:
    """Values of the bind parameters of `page_select`.

    Args:
        limit: most features on the page.
    """
    parameters = {**selection.parameters, "limit": limit}
    parameters["after_key"] = BEFORE_ALL_KEYS if after is None else after[-1]
    if after is not None:
        parameters |= {_after_name(place): value for place, value in enumerate(after)}
    return parameters


def select_visible(
    collection: Collection, box: BoxShape | None, *columns: ColumnElement[Any]
) -> Select[Any]:
    """SELECT of columns of the rows that the caller may see and that meet a box, in no order."""
    return select(*columns).select_from(collection.source).where(_kept_predicate(collection, box))


@lru_cache(KEPT_STATEMENTS)
def _kept_predicate(collection: Collection, box: BoxShape | None) -> ColumnElement[bool]:
    """The predicate that the caller may see a row and that it meets a box."""
    if box is None:
        return opaque(collection.visible)
    return opaque(and_(collection.visible, box_predicate(collection, box)))


@lru_cache(KEPT_STATEMENTS)
def kept_columns(layout: Layout, columns: Columns) -> tuple[Label[Any], ...]:
    """The columns of a page, built once."""
    return tuple(opaque(column).label(name) for name, column in columns(layout).items())


@lru_cache(KEPT_STATEMENTS)
def _kept_select(
    layout: Layout, columns: Columns, box: BoxShape | None, unknown_after: tuple[bool, ...] | None
) -> Select[Any]:
    rows = select_visible(layout.collection, box, *kept_columns(layout, columns))
    if unknown_after is not None:
        rows = rows.where(_beyond(layout.orders, unknown_after, 0))
    orders = (_ordering(order) for order in layout.orders)
    return rows.order_by(*orders).limit(LIMIT + integer_constant(1))


@lru_cache(KEPT_FILTERED)
def _kept_filtered(statement: Select[Any], predicate: ColumnElement[bool]) -> Select[Any]:
    return statement.where(predicate)


@lru_cache(KEPT_FILTERED)
def _kept_full_scan(
    layout: Layout, columns: Columns, predicate: ColumnElement[bool] | None
) -> Select[Any]:
    assert layout.collection.full_scan is not None
    rows = kept_columns(layout, columns)
    return layout.collection.full_scan(rows, true() if predicate is None else predicate)


@lru_cache(KEPT_FILTERED)
def _kept_hot(statement: Select[Any]) -> HotStatement:
    return hot_like(statement)


def _ordering(order: Order) -> ColumnElement[Any]:
    value = sortable(order.property)
    directed = value.desc() if order.descending else value.asc()
    return directed.nulls_last() if order.property.nullable else directed


def _beyond(orders: Sequence[Order], unknown_after: tuple[bool, ...], place: int) -> ColumnElement[bool]:
    """The predicate that a row comes after the row of the bound values; unknown values come last."""
    order, is_last = orders[place], place == len(orders) - 1
    value = sortable(order.property)
    if unknown_after[place]:
        return and_(value.is_(None), _beyond(orders, unknown_after, place + 1))
    bound = _after_value(order.property, place)
    further: ColumnElement[bool] = value < bound if order.descending else value > bound
    if is_last:
        return further
    if order.property.nullable:
        further = or_(further, value.is_(None))
    return or_(further, and_(value == bound, _beyond(orders, unknown_after, place + 1)))


def _after_value(item: Property, place: int) -> ColumnElement[Any]:
    """A value of `after`: a number, or a text of another type, as JSON carries them."""
    value = sortable(item)
    kind = value.type if item.is_number else Text()
    return cast(bindparam(_after_name(place), None, kind), value.type)


def _after_name(place: int) -> str:
    return f"after{place}"


def sortable(item: Property) -> ColumnElement[Any]:
    """The value of a property that features are ordered by, which comes back from a link the same."""
    return cast(item.expression, Double) if item.type == "real" else item.expression
