"""One control point with its views and its history."""

from dataclasses import dataclass, fields
from datetime import date, datetime
from functools import cache
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, bindparam, func, null, select
from sqlalchemy.dialects.postgresql import aggregate_order_by
from sqlalchemy.types import NullType

from amers.app.db.blocks import FRAME, FRAME_SIGMA_M
from amers.app.db.constants import text_constant
from amers.app.db.engine import Connection, driver
from amers.app.db.history import PointHistory, outcome_columns
from amers.app.db.rows import columns_of
from amers.app.db.schema import block, chip_file, image, point, point_history, view
from amers.app.db.statements import HotStatement, hot
from amers.services.formats.block.frame_json import parse_frame
from amers.services.types import Frame


@dataclass(frozen=True)
class PointView:
    """A view of a point and the image it was cut from; None where unknown."""

    view: int
    gsd_m: float
    incidence_deg: float | None
    azimuth_deg: float | None
    image_id: str
    sensor: str
    acquired_at: datetime | None
    sun_elevation_deg: float | None
    sun_azimuth_deg: float | None


@dataclass(frozen=True)
class PointDetail:
    """One point with its block, its views and its history.

    Attributes:
        height_m: of the content of its chips, which registration searches.
        surface_height_m, surface_sigma_m: the surface at its place; None where unknown.
        chip_key: key of its chips in the storage; `chip_row` is the first, `chip_count` their number.
        frame: of its block, on the Earth.
        history: how registrations fared with it.
    """

    id: int
    lon_deg: float
    lat_deg: float
    height_m: float
    sigma_east_m: float
    sigma_north_m: float
    sigma_up_m: float
    corr_east_north: float
    corr_east_up: float
    corr_north_up: float
    n_views: int
    saliency: float
    typology: str | None
    first_view: date | None
    last_view: date | None
    surface_height_m: float | None
    surface_sigma_m: float | None
    block: str
    block_version: str
    frame: Frame
    chip_key: str
    chip_row: int
    chip_count: int
    views: tuple[PointView, ...]
    history: PointHistory


DETAIL_FIELDS = tuple(field.name for field in fields(PointDetail))


def find_point(connection: Connection, point_id: int) -> PointDetail | None:
    """One published point; None when there is none of that id."""
    statement = _point_statement()
    parameters = statement.parameters({"point_id": point_id})
    row = driver(connection).execute(statement.sql, parameters).fetchone()
    if row is None:
        return None
    values = dict(zip(DETAIL_FIELDS, row, strict=False))
    values["views"] = tuple(map(_view, values["views"]))
    values["frame"] = parse_frame(*values["frame"])
    values["history"] = PointHistory(values["id"], *row[len(DETAIL_FIELDS) :])
    return PointDetail(**values)


def _known(column: ColumnElement[Any]) -> ColumnElement[Any]:
    return func.nullif(column, text_constant("NaN"), type_=column.type)


@cache
def _point_statement() -> HotStatement:
    """A point with all that belongs to it, in one exchange with the database."""
    one_view = (
        select(
            *columns_of(
                PointView,
                view,
                incidence_deg=_known(view.c.incidence_deg),
                azimuth_deg=_known(view.c.azimuth_deg),
                image_id=image.c.image_id,
                sensor=image.c.sensor,
                acquired_at=image.c.acquired_at,
                sun_elevation_deg=_known(image.c.sun_elevation_deg),
                sun_azimuth_deg=_known(image.c.sun_azimuth_deg),
            )
        )
        .select_from(view.join(image, image.c.image == view.c.image))
        .where(image.c.block_number == point.c.block_number, view.c.point_id == point.c.id)
        .correlate(point)
        .subquery("one_view")
    )
    views = select(
        func.coalesce(
            func.json_agg(aggregate_order_by(one_view.table_valued(), one_view.c.view)),
            text_constant("[]"),
            type_=NullType(),
        )
    ).scalar_subquery()
    columns = columns_of(
        PointDetail,
        point,
        lon_deg=func.st_x(point.c.geom),
        lat_deg=func.st_y(point.c.geom),
        height_m=func.st_z(point.c.geom),
        block=block.c.id,
        block_version=block.c.version,
        frame=func.json_build_array(FRAME, FRAME_SIGMA_M),
        chip_key=chip_file.c.storage_key,
        views=views,
        history=null(),
    )
    return hot(
        select(*columns, *outcome_columns())
        .select_from(
            point.join(block, block.c.number == point.c.block_number)
            .join(chip_file, chip_file.c.id == point.c.chip_file)
            .outerjoin(point_history, point_history.c.point_id == point.c.id)
        )
        .where(
            point.c.id == bindparam("point_id", None, BigInteger()),
            block.c.state == text_constant("published"),
        )
    )


def _view(document: dict[str, Any]) -> PointView:
    acquired_at = document.pop("acquired_at")
    taken = None if acquired_at is None else datetime.fromisoformat(acquired_at)
    return PointView(**document, acquired_at=taken)
