"""What a collection of features is: declared once for each, asked for by `app.db.features.pages`.

SQL in a declaration calls the row `t`, and may use `%(admin)s` and `%(viewer)s`: whether the caller is
an administrator, and the id of the caller's token.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal
from uuid import UUID

from app.db.engine import Connection
from app.db.features.bbox import Box
from app.db.features.crs import CRS84, CRS84H, FLAT, WITH_HEIGHT, Crs

SqlType = Literal["bigint", "real", "double precision", "text", "date", "timestamptz", "boolean"]


@dataclass(frozen=True)
class Viewer:
    """Who asks: the id of a token, None without one, and whether it is an administrator's."""

    token: UUID | None = None
    is_admin: bool = False


@dataclass(frozen=True)
class Property:
    """A property of the features of a collection.

    Attributes:
        name: in replies, filters and files.
        type: of its SQL.
        title: what it is, in a few words.
        sql: the column of that name if not given.
        unit: as conventions name it, "" when it has none.
        nullable: whether it may be unknown.
        choices: all values there are, when there are few.
    """

    name: str
    type: SqlType
    title: str
    sql: str = ""
    unit: str = ""
    nullable: bool = False
    choices: tuple[str, ...] = ()

    @property
    def expression(self) -> str:
        """Its SQL."""
        return self.sql or f"t.{self.name}"

    @property
    def is_number(self) -> bool:
        """Whether values can be calculated with."""
        return self.type in ("bigint", "real", "double precision")

    @property
    def is_time(self) -> bool:
        """Whether values are dates or instants."""
        return self.type in ("date", "timestamptz")


@dataclass(frozen=True)
class Collection:
    """Features of one kind.

    Attributes:
        id, title, description: for people.
        source: what stands after FROM, with alias t.
        key: the property that tells features apart, by which they are ordered unless asked otherwise.
        properties: the others, in the order of replies.
        geometry_type: as GeoJSON names it.
        geometry: SQL, longitude and latitude (SRID 4326), or with height (4979).
        has_height: whether positions have a height.
        visible: condition that the caller may see the row.
        interval: names of the properties between which a feature lies in time; none: timeless.
        found_by: condition that the text `%(key)s` means the row; the key alone if not given.
        everything: SELECT of all visible rows that meet `{condition}` in the order of keys beyond
            `%(after)s`, at most `%(limit)s` + 1, where that is quicker than asking plainly.
        total: SELECT of `n`, how many visible rows there are, where that is quicker than counting.
        in_box: about how many features a box holds for anybody, where counts are kept.
        members: SQL of text that follows the properties of a feature in GeoJSON, beginning with a comma.
        is_open: whether it is open to everybody where points are.
    """

    id: str
    title: str
    description: str
    source: str
    key: Property
    properties: tuple[Property, ...]
    geometry_type: str
    geometry: str = "t.geom"
    has_height: bool = False
    visible: str = "true"
    interval: tuple[str, str] | None = None
    found_by: str = ""
    everything: str = ""
    total: str = ""
    in_box: Callable[[Connection, Box], int] | None = None
    members: str = ""
    is_open: bool = True

    @property
    def crs(self) -> tuple[Crs, ...]:
        """Reference systems it can be asked for in."""
        return WITH_HEIGHT if self.has_height else FLAT

    @property
    def storage_crs(self) -> Crs:
        """The one it is kept in, which is also the one of replies unless asked otherwise."""
        return CRS84H if self.has_height else CRS84

    @property
    def queryables(self) -> dict[str, Property]:
        """What a filter may name, beside the geometry."""
        return {item.name: item for item in (self.key, *self.properties)}
