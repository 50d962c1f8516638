"""The declaration of a collection of features: its columns, its geometry and who sees which rows.

Expressions of a declaration are over the tables of `amers.app.db.schema`. They may contain the bind
parameters `IS_ADMIN` and `VIEWER` (the caller) and `REFERENCE` (the text that names one feature).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal
from uuid import UUID

from sqlalchemy import (
    REAL,
    Boolean,
    Column,
    ColumnElement,
    Date,
    DateTime,
    Float,
    FromClause,
    Integer,
    Label,
    Select,
    Text,
    Uuid,
    bindparam,
    true,
)
from sqlalchemy.types import TypeEngine

from amers.app.db.engine import Connection
from amers.app.db.features.bbox import Box
from amers.app.db.features.crs import CRS84, CRS84H, FLAT, WITH_HEIGHT, Crs

SqlType = Literal["bigint", "real", "double precision", "text", "date", "timestamptz", "boolean"]

# The first that a type is an instance of: REAL is a Float.
SQL_TYPES: tuple[tuple[type[TypeEngine[Any]], SqlType], ...] = (
    (Integer, "bigint"),
    (REAL, "real"),
    (Float, "double precision"),
    (Text, "text"),
    (Date, "date"),
    (DateTime, "timestamptz"),
    (Boolean, "boolean"),
)

IS_ADMIN = bindparam("is_admin", None, Boolean())
VIEWER = bindparam("viewer", None, Uuid())
REFERENCE = bindparam("reference", None, Text())


@dataclass(frozen=True)
class Viewer:
    """The caller: the id of a token, None without one, and whether it is an administrator's."""

    token: UUID | None = None
    is_admin: bool = False

    @property
    def parameters(self) -> dict[str, Any]:
        """Values of the bind parameters of `Collection.visible`."""
        return {"viewer": self.token, "is_admin": self.is_admin}


@dataclass(frozen=True, eq=False)
class Property:
    """A property of the features of a collection.

    Attributes:
        name: in replies, filters and files.
        title: its meaning in a few words.
        expression: its value; the type of the expression is the type of the property.
        unit: as in the conventions, "" without one.
        nullable: whether values may be unknown.
        choices: all possible values, when they are few.
        absent: what a page shows where the value is null.
    """

    name: str
    title: str
    expression: ColumnElement[Any]
    unit: str = ""
    nullable: bool = False
    choices: tuple[str, ...] = ()
    absent: str = ""

    @cached_property
    def type(self) -> SqlType:
        """Its type in SQL, of the few that replies distinguish."""
        return next(name for kind, name in SQL_TYPES if isinstance(self.expression.type, kind))

    @property
    def is_number(self) -> bool:
        """Whether values are numbers."""
        return self.type in ("bigint", "real", "double precision")

    @property
    def is_time(self) -> bool:
        """Whether values are dates or instants."""
        return self.type in ("date", "timestamptz")


def column_property(
    column: Column[Any],
    title: str,
    unit: str = "",
    *,
    name: str = "",
    choices: tuple[str, ...] = (),
    absent: str = "",
) -> Property:
    """The property of a column of a table, nullable as the column is; of the same name unless given."""
    return Property(
        name or str(column.name), title, column, unit, bool(column.nullable), choices, absent
    )


@dataclass(frozen=True, eq=False)
class Collection:
    """Features of one kind.

    Attributes:
        id, title, description: for people.
        source: the table or the join of its rows.
        key: the property that identifies a feature; features are ordered by it unless asked otherwise.
        properties: the others, in the order of replies.
        geometry_type: as GeoJSON names it.
        geometry: longitude and latitude (SRID 4326), or with height (4979).
        has_height: whether positions have a height.
        visible: whether the caller may see a row.
        interval: names of the properties between which a feature lies in time; None: timeless.
        named_by: whether `REFERENCE` names the row; None: the key as text equals it.
        full_scan: SELECT of given columns of all visible rows that meet a predicate, in the order of
            keys beyond `AFTER_KEY`, of `LIMIT` rows and one more; None: the plain statement is as fast.
        total: SELECT of the number of visible rows, where that is faster than counting.
        estimate_in_box: about how many features a box contains for anybody, where cells are counted.
        is_open: whether everybody may list it where points are public.
        members: of a feature, beside its properties, that a filter may name.
    """

    id: str
    title: str
    description: str
    source: FromClause
    key: Property
    properties: tuple[Property, ...]
    geometry_type: str
    geometry: ColumnElement[Any]
    has_height: bool = False
    visible: ColumnElement[bool] = true()  # noqa: RUF009, an immutable constant of SQLAlchemy
    interval: tuple[str, str] | None = None
    named_by: ColumnElement[bool] | None = None
    full_scan: Callable[[Sequence[Label[Any]], ColumnElement[bool]], Select[Any]] | None = None
    total: Select[Any] | None = None
    estimate_in_box: Callable[[Connection, Box], int] | None = None
    is_open: bool = True
    members: tuple[Property, ...] = ()

    @property
    def crs(self) -> tuple[Crs, ...]:
        """Reference systems in which its features can be requested."""
        return WITH_HEIGHT if self.has_height else FLAT

    @property
    def geometry_nullable(self) -> bool:
        """Whether features may lack a geometry."""
        return not isinstance(self.geometry, Column) or bool(self.geometry.nullable)

    @property
    def storage_crs(self) -> Crs:
        """The reference system of the stored geometries, and of replies unless asked otherwise."""
        return CRS84H if self.has_height else CRS84

    @cached_property
    def columns(self) -> dict[str, Property]:
        """The key and the properties by name: what files have and features are sorted by."""
        return {item.name: item for item in (self.key, *self.properties)}

    @cached_property
    def queryables(self) -> dict[str, Property]:
        """What a filter may name, by name; the geometry comes beside it."""
        return self.columns | {item.name: item for item in self.members}
