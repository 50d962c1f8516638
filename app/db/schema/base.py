"""What the tables share: the metadata with its names of constraints, types, defaults and choices."""

from datetime import timedelta
from typing import Any, get_args

from geoalchemy2 import Geometry
from sqlalchemy import CheckConstraint, ColumnElement, Computed, DateTime, Interval, MetaData, func
from sqlalchemy import column as column_named
from sqlalchemy.dialects.postgresql import DOUBLE_PRECISION, JSONB, REAL

# Names that PostgreSQL gives to constraints without a name; a check adds what it checks.
NAMING_CONVENTION = {
    "pk": "%(table_name)s_pkey",
    "uq": "%(table_name)s_%(column_0_N_name)s_key",
    "fk": "%(table_name)s_%(column_0_name)s_fkey",
    "ck": "%(table_name)s_%(constraint_name)s_check",
}

metadata = MetaData(naming_convention=NAMING_CONVENTION)

Timestamp = DateTime(timezone=True)
Real: REAL[float] = REAL()
Double: DOUBLE_PRECISION[float] = DOUBLE_PRECISION()
# None is SQL's null, never the JSON value null.
Json = JSONB(none_as_null=True)
Polygon = Geometry("POLYGON", srid=4326, spatial_index=False)
MapOutline = Geometry("GEOMETRY", srid=4326, spatial_index=False)
PointZ = Geometry("POINTZ", srid=4979, dimension=3, spatial_index=False)

now = func.now()
# Rows written in one transaction differ in this one.
clock = func.clock_timestamp(type_=Timestamp)
uptime_s = func.uptime_s(type_=Double)


def one_of(column: str, choices: Any) -> CheckConstraint:
    """A check that a column has one of the values of a `Literal`."""
    return CheckConstraint(column_named(column).in_(get_args(choices)), name=column)


def hours(count: float) -> ColumnElement[timedelta]:
    """An interval of hours: unlike a day, it is as long on the day when clocks change."""
    return func.make_interval(0, 0, 0, 0, count, type_=Interval)


def on_map(outline: ColumnElement[Any]) -> Computed:
    """An outline cut at 180 degrees, as RFC 7946 asks; the outline itself stays in one piece."""
    wrapped = func.st_wrapx(func.st_wrapx(outline, 180, -360), -180, 360)
    return Computed(func.st_forcepolygonccw(wrapped), persisted=True)
