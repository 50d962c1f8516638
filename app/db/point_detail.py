"""One control point: what is told of it, its views, and how registrations fared with it."""

from dataclasses import dataclass, fields
from datetime import date, datetime
from typing import Any

from app.db.engine import Connection
from app.db.history import FARED_OF_POINT, PointHistory


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
    """One point with all that is known of it.

    Attributes:
        chip_key: where the storage has its chips; `chip_row` is the first, `chip_count` their number.
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
    block: str
    block_version: str
    chip_key: str
    chip_row: int
    chip_count: int
    views: tuple[PointView, ...]
    history: PointHistory


FARED = tuple(field.name for field in fields(PointHistory) if field.name != "id")
POINT = f"""select p.id, st_x(geom) as lon_deg, st_y(geom) as lat_deg, st_z(geom) as height_m,
        sigma_east_m, sigma_north_m, sigma_up_m, corr_east_north, corr_east_up, corr_north_up,
        p.n_views, saliency, typology, first_view, last_view, b.id as block,
        b.version as block_version, f.storage_key as chip_key, chip_row, chip_count,
        {FARED_OF_POINT},
        (select coalesce(json_agg(one order by one.view), '[]')
         from (select v.view, v.gsd_m, nullif(v.incidence_deg, 'NaN') as incidence_deg,
                   nullif(v.azimuth_deg, 'NaN') as azimuth_deg, i.image_id, i.sensor, i.acquired_at,
                   nullif(i.sun_elevation_deg, 'NaN') as sun_elevation_deg,
                   nullif(i.sun_azimuth_deg, 'NaN') as sun_azimuth_deg
               from view v join image i on i.block_number = p.block_number and i.image = v.image
               where v.point_id = p.id) one) as views
    from point p join block b on b.number = p.block_number join chip_file f on f.id = p.chip_file
        left join point_history h on h.point_id = p.id
    where p.id = %s and b.state = 'published'"""
"""All that is told of a point, in one exchange with the database."""


def find_point(connection: Connection, point_id: int) -> PointDetail | None:
    """One published point."""
    row = connection.execute(POINT, [point_id]).fetchone()
    if row is None:
        return None
    views = tuple(_view(view) for view in row.pop("views"))
    history = PointHistory(row["id"], **{name: row.pop(name) for name in FARED})
    return PointDetail(**row, views=views, history=history)


def _view(said: dict[str, Any]) -> PointView:
    acquired_at = said.pop("acquired_at")
    return PointView(
        **said, acquired_at=None if acquired_at is None else datetime.fromisoformat(acquired_at)
    )
