"""Control points of published blocks: as a collection, and as arrays by outline and by ids."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from psycopg import sql

from app.db.binary_copy import parse_copy
from app.db.blocks import ID_BITS, PUBLISHED
from app.db.density import points_in_box
from app.db.engine import Connection
from app.db.features.antimeridian import on_the_map
from app.db.features.collection import Collection, Property
from app.db.history import point_health, view_health
from services.formats.block.tables import covariance_from_sigmas
from services.types import Acquisition, Array, ControlPoints, IntArray, Views

SERVED = "t.superseded_by is null and t.suspended_at is null"
VISIBLE = f"{SERVED} and t.block_number = any(array({PUBLISHED}))"
"""Points of published blocks, but for those that a better block has at the same place, and for those
that an administrator has suspended."""

# Block by block along the primary key. Asked for more simply, the planner may read all unpublished
# points on its way to the published ones.
EVERYTHING = f"""select t.* from ({PUBLISHED} and number >= %(after)s >> {ID_BITS}) b
    cross join lateral (
        select * from point t where id > %(after)s and id >= b.number::bigint << {ID_BITS}
            and id < (b.number::bigint + 1) << {ID_BITS} and {SERVED} and {{condition}}
        order by id limit %(limit)s + 1) t
    order by b.number, t.id limit %(limit)s + 1"""

POINTS = Collection(
    id="points",
    title="Control points",
    description="3D ground control points with image chips, of all published blocks.",
    source="point t",
    key=Property("id", "bigint", "Identifier"),
    properties=(
        Property("sigma_east_m", "real", "Standard deviation eastwards", unit="m"),
        Property("sigma_north_m", "real", "Standard deviation northwards", unit="m"),
        Property("sigma_up_m", "real", "Standard deviation of the height", unit="m"),
        Property("corr_east_north", "real", "Correlation of east and north"),
        Property("corr_east_up", "real", "Correlation of east and height"),
        Property("corr_north_up", "real", "Correlation of north and height"),
        Property("n_views", "bigint", "Images that see the point"),
        Property("saliency", "real", "How well its chips can be located, 0 to 1"),
        Property("typology", "text", "What it is on the ground", nullable=True),
        Property("first_view", "date", "Date of the first view", nullable=True),
        Property("last_view", "date", "Date of the last view", nullable=True),
        Property("block_number", "bigint", "Number of its block"),
    ),
    geometry_type="Point",
    has_height=True,
    visible=VISIBLE,
    interval=("first_view", "last_view"),
    everything=EVERYTHING,
    total=(
        "select coalesce(sum(n_points - n_unserved), 0)::bigint as n from block"
        " where state = 'published'"
    ),
    in_box=points_in_box,
)

POINT_KINDS = (
    ("id", "i8"),
    ("lon", "f8"),
    ("lat", "f8"),
    ("h", "f8"),
    ("sigma_east", "f4"),
    ("sigma_north", "f4"),
    ("sigma_up", "f4"),
    ("corr_east_north", "f4"),
    ("corr_east_up", "f4"),
    ("corr_north_up", "f4"),
    ("saliency", "f4"),
    ("chip_file", "i4"),
    ("chip_row", "i8"),
)
POINT_COLUMNS = sql.SQL(
    """id, st_x(geom) as lon, st_y(geom) as lat, st_z(geom) as h,
    sigma_east_m, sigma_north_m, sigma_up_m, corr_east_north, corr_east_up, corr_north_up,
    saliency, chip_file, chip_row"""
)
IN_PUBLISHED = sql.SQL("block_number = any(array(select number from block where state = 'published'))")
VIEW_KINDS = (
    ("point_id", "i8"),
    ("image", "i4"),
    ("gsd", "f4"),
    ("incidence", "f4"),
    ("azimuth", "f4"),
)


_FRAME_SIGMA = '$."amers:accuracy"."absolute"[*] ? (@.name == "frame_sigma_m").value'


@dataclass(frozen=True)
class BlockVersion:
    """A version of a block that points came from.

    Attributes:
        frame_sigma_m: how well its frame is known, standard deviation a coordinate; None if unsaid.
    """

    number: int
    id: str
    version: str
    frame_sigma_m: float | None


@dataclass(frozen=True)
class StoredPoints:
    """Control points out of the store.

    Attributes:
        points: their `chip_files` are keys of the storage.
        blocks: the versions they come from.
    """

    points: ControlPoints
    blocks: tuple[BlockVersion, ...]


def control_points(connection: Connection, outline: Array, limit: int | None = None) -> StoredPoints:
    """The published points inside an outline, with their views, as arrays.

    Args:
        outline: (m, 2) lon, lat, not closed, longitudes continuous (beyond 180 degrees across the
            antimeridian).
        limit: where there are more, so many of them evenly along the Hilbert order of their blocks,
            which spreads them over the ground.

    Returns:
        Points in the order of their ids.
    """
    place = shapely.set_srid(on_the_map(shapely.make_valid(shapely.Polygon(outline))), 4979)
    area = sql.Literal(shapely.to_wkb(place, include_srid=True, hex=True))
    return _with_views(connection, _points_query(area, limit))


def points_of_ids(connection: Connection, ids: Sequence[int]) -> StoredPoints:
    """The published points of some ids, with their views, as arrays.

    Returns:
        Points in the order of their ids; those that there are not are left out.
    """
    query = sql.SQL("select {} from point where id = any({}) and {} order by id").format(
        POINT_COLUMNS, sql.Literal(list(ids)), IN_PUBLISHED
    )
    return _with_views(connection, query)


def _with_views(connection: Connection, points_query: sql.Composed) -> StoredPoints:
    point = _read(connection, points_query, POINT_KINDS)
    ids = point["id"].astype(np.int64)
    views_query = sql.SQL(
        "select point_id, image, gsd_m, incidence_deg, azimuth_deg from view"
        " where point_id = any({}) order by point_id, view"
    ).format(sql.Literal(ids.tolist()))
    view = _read(connection, views_query, VIEW_KINDS)
    numbers = np.unique(ids >> ID_BITS)
    images, first_image = _images(connection, numbers)
    chip_file, chip_files = _chip_files(connection, point["chip_file"].astype(np.int64))
    owner = view["point_id"].astype(np.int64)
    start = np.searchsorted(owner, np.append(ids, np.iinfo(np.int64).max)).astype(np.int64)
    block_of_view = np.searchsorted(numbers, owner >> ID_BITS)
    points = ControlPoints(
        id=ids,
        lon_lat_h=_columns(point, "lon", "lat", "h"),
        covariance_m2=covariance_from_sigmas(
            _columns(point, "sigma_east", "sigma_north", "sigma_up"),
            _columns(point, "corr_east_north", "corr_east_up", "corr_north_up"),
        ),
        saliency=_columns(point, "saliency")[:, 0],
        health=point_health(connection, ids),
        views=Views(
            start=start,
            gsd_m=_as_written(view["gsd"]),
            image=first_image[block_of_view] + view["image"].astype(np.int64),
            incidence_deg=_columns(view, "incidence")[:, 0],
            azimuth_deg=_columns(view, "azimuth")[:, 0],
            health=view_health(connection, ids, start),
            images=images,
        ),
        chip_file=chip_file,
        chip_row=point["chip_row"].astype(np.int64),
        chip_files=chip_files,
    )
    return StoredPoints(points, _versions(connection, numbers))


def _points_query(area: sql.Literal, limit: int | None) -> sql.Composed:
    """Points inside an area; with a limit, the rows where `rank * limit / count` steps up."""
    inside = sql.SQL(
        """select {columns}
           from point where geom && {area}::geometry and st_intersects(geom, {area}::geometry)
               and superseded_by is null and suspended_at is null and {published}"""
    ).format(columns=POINT_COLUMNS, area=area, published=IN_PUBLISHED)
    if limit is None:
        return inside + sql.SQL(" order by id")
    return sql.SQL(
        """select id, lon, lat, h, sigma_east_m, sigma_north_m, sigma_up_m,
               corr_east_north, corr_east_up, corr_north_up, saliency, chip_file, chip_row
           from (select p.*, row_number() over (order by id) - 1 as rank, count(*) over () as found
                 from ({inside}) p) ranked
           where rank = 0 or rank * {limit} / found > (rank - 1) * {limit} / found order by id"""
    ).format(inside=inside, limit=sql.Literal(limit))


def _read(
    connection: Connection, query: sql.Composed, kinds: tuple[tuple[str, str], ...]
) -> npt.NDArray[np.void]:
    statement = sql.SQL("copy ({}) to stdout (format binary)").format(query)
    with connection.cursor() as cursor, cursor.copy(statement) as copy:
        return parse_copy(b"".join(bytes(piece) for piece in copy), kinds)


def _columns(rows: npt.NDArray[np.void], *names: str) -> Array:
    return np.column_stack([rows[name].astype(np.float64) for name in names])


def _as_written(values: npt.NDArray[Any]) -> Array:
    """Single-precision values as the shortest decimals that stand for them: 0.7, not 0.699999988."""
    distinct, inverse = np.unique(values.astype(np.float32), return_inverse=True)
    return np.array([float(str(value)) for value in distinct], dtype=np.float64)[inverse]


def _images(connection: Connection, numbers: IntArray) -> tuple[tuple[Acquisition, ...], IntArray]:
    """The images of blocks, one block after the other, and where those of each block begin."""
    rows = connection.execute(
        """select block_number, image_id, sensor, acquired_at,
               coalesce(incidence_deg, 'NaN') as incidence_deg,
               coalesce(azimuth_deg, 'NaN') as azimuth_deg,
               coalesce(sun_elevation_deg, 'NaN') as sun_elevation_deg,
               coalesce(sun_azimuth_deg, 'NaN') as sun_azimuth_deg
           from image where block_number = any(%s) order by block_number, image""",
        [numbers.tolist()],
    ).fetchall()
    blocks = np.array([row.pop("block_number") for row in rows], dtype=np.int64)
    return tuple(Acquisition(**row) for row in rows), np.searchsorted(blocks, numbers)


def _chip_files(connection: Connection, file: IntArray) -> tuple[IntArray, tuple[str, ...]]:
    ids, rows = np.unique(file, return_inverse=True)
    found = connection.execute(
        "select storage_key from chip_file where id = any(%s) order by id", [ids.tolist()]
    ).fetchall()
    return rows.astype(np.int64), tuple(row["storage_key"] for row in found)


def _versions(connection: Connection, numbers: IntArray) -> tuple[BlockVersion, ...]:
    rows = connection.execute(
        "select number, id, version, jsonb_path_query_first(metadata, %s)::float8 as frame_sigma_m"
        " from block where number = any(%s) order by number",
        [_FRAME_SIGMA, numbers.tolist()],
    ).fetchall()
    return tuple(BlockVersion(**row) for row in rows)
