"""What is asked of a collection, and the SQL that chooses its rows, a page of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from app.db.features.collection import Collection, Property, Viewer
from app.db.features.crs import Crs
from app.db.features.predicates import ANYTHING, Condition

Key = tuple[Any, ...]
"""The values that order features, of one of them."""


@dataclass(frozen=True)
class Order:
    """Features in the order of a property."""

    property: Property
    descending: bool = False


@dataclass(frozen=True)
class Selection:
    """What is asked of a collection.

    Attributes:
        collection: asked.
        viewer: who asks.
        condition: that features meet.
        order: by these, then by the key.
        properties: of each feature, in this order.
        crs: of the reply.
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


def chosen_rows(selection: Selection, after: Key | None, limit: int) -> tuple[str, dict[str, Any]]:
    """SELECT of a page and one row more, in order."""
    collection, condition = selection.collection, selection.condition
    parameters = {**condition.parameters, **viewer_parameters(selection.viewer), "limit": limit}
    if collection.everything and not selection.order and not condition.spatial:
        parameters["after"] = -1 if after is None else after[0]
        return collection.everything.replace("{condition}", condition.sql), parameters
    where = from_where(selection)
    if after is not None:
        where += f" and {_beyond(selection.orders, after, parameters)}"
    order = ", ".join(
        f"{sortable(item.property)} {'desc' if item.descending else 'asc'} nulls last"
        if item.property.nullable
        else f"{sortable(item.property)} {'desc' if item.descending else 'asc'}"
        for item in selection.orders
    )
    return f"select t.* from {where} order by {order} limit %(limit)s + 1", parameters


def from_where(selection: Selection) -> str:
    collection = selection.collection
    return f"{collection.source} where {collection.visible} and {selection.condition.sql}"


def _beyond(orders: Sequence[Order], after: Key, parameters: dict[str, Any]) -> str:
    """The condition that a row comes after the one of these values; unknown values come last."""
    first, rest = orders[0], orders[1:]
    sql, value, name = sortable(first.property), after[0], f"after{len(orders)}"
    if value is None:
        return f"({sql} is null and {_beyond(rest, after[1:], parameters)})"
    parameters[name] = value
    bound = f"%({name})s::{_sort_type(first.property)}"
    further = f"{sql} {'<' if first.descending else '>'} {bound}"
    if not rest:
        return further
    if first.property.nullable:
        further = f"({further} or {sql} is null)"
    return f"({further} or ({sql} = {bound} and {_beyond(rest, after[1:], parameters)}))"


def _sort_type(item: Property) -> str:
    """The type in which values go to a link and come back the same."""
    return "double precision" if item.type == "real" else item.type


def sortable(item: Property) -> str:
    return f"({item.expression})::double precision" if item.type == "real" else item.expression


def viewer_parameters(viewer: Viewer) -> dict[str, Any]:
    return {"viewer": viewer.token, "admin": viewer.is_admin}
