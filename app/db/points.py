"""Control points of published blocks: by box, by outline, one by one."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date, datetime
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from psycopg import sql

from app.db.binary_copy import parse_copy
from app.db.blocks import ID_BITS
from app.db.engine import Connection
from services.formats.block_tables import covariance_from_spread
from services.types import Acquisition, Array, ControlPoints, IntArray, Views

EXACT_COUNT = 10_000
COORDINATE_DIGITS = 9
"""Decimals of a degree in replies: a tenth of a millimetre."""

PUBLISHED = "select number from block where state = 'published'"

# Text of a feature, made by the database: five times faster than rows that become dictionaries and JSON.
# Figures are finite by the constraints of the table; texts and dates are quoted by to_json.
FEATURE = f"""format(
    '{{"type":"Feature","id":%%s,"geometry":%%s,"properties":{{'
    '"sigma_east_m":%%s,"sigma_north_m":%%s,"sigma_up_m":%%s,'
    '"corr_east_north":%%s,"corr_east_up":%%s,"corr_north_up":%%s,'
    '"n_views":%%s,"saliency":%%s,"typology":%%s,"first_view":%%s,"last_view":%%s,"block_number":%%s}}}}',
    p.id, st_asgeojson(p.geom, {COORDINATE_DIGITS}, 0),
    p.sigma_east_m, p.sigma_north_m, p.sigma_up_m, p.corr_east_north, p.corr_east_up, p.corr_north_up,
    p.n_views, p.saliency, coalesce(to_json(p.typology)::text, 'null'),
    coalesce(to_json(p.first_view)::text, 'null'), coalesce(to_json(p.last_view)::text, 'null'),
    p.block_number)"""

CSV_COLUMNS = """p.id, st_x(p.geom) as lon_deg, st_y(p.geom) as lat_deg, st_z(p.geom) as height_m,
    p.sigma_east_m, p.sigma_north_m, p.sigma_up_m, p.corr_east_north, p.corr_east_up, p.corr_north_up,
    p.n_views, p.saliency, p.typology, p.first_view, p.last_view, b.id as block, b.version"""

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
VIEW_KINDS = (
    ("point_id", "i8"),
    ("image", "i4"),
    ("gsd", "f4"),
    ("incidence", "f4"),
    ("azimuth", "f4"),
)


@dataclass(frozen=True)
class Box:
    """A box of longitude and latitude; `east` below `west` crosses the antimeridian."""

    west: float
    south: float
    east: float
    north: float


@dataclass(frozen=True)
class FeaturePage:
    """Points as GeoJSON features.

    Attributes:
        features: separated by commas, without brackets.
        returned: how many.
        last_id: of the last one, where the next page goes on; None when there are no more.
    """

    features: str
    returned: int
    last_id: int | None


@dataclass(frozen=True)
class Count:
    """How many points; an estimate beyond 10,000 unless `exact`."""

    number: int
    exact: bool


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


def point_features(connection: Connection, box: Box | None, after: int, limit: int) -> FeaturePage:
    """A page of published points, in the order of their ids.

    Args:
        box: where; None for everywhere.
        after: points with greater ids only.
        limit: most points on the page.
    """
    where: dict[str, float] = {}
    if box is None:
        chosen = _everywhere()
    else:
        condition, where = _inside(box)
        chosen = f"{_in_box(condition)} and id > %(after)s order by id limit %(limit)s + 1"
    # The rows come in order, so the texts need no sort. Never prepared: the best way to a box depends
    # on its size, and a plan for any box reads all of the world to find its first hundred points.
    row = connection.execute(
        f"""with p as materialized ({chosen})
            select (select string_agg({FEATURE}, ',') from (select * from p limit %(limit)s) p)
                       as features,
                   (select count(*) from p) as found,
                   (select id from p offset %(limit)s - 1 limit 1) as last_id""",
        {**where, "after": after, "limit": limit},
        prepare=False,
    ).fetchone()
    assert row is not None
    more = row["found"] > limit
    return FeaturePage(row["features"] or "", min(row["found"], limit), row["last_id"] if more else None)


def count_points(connection: Connection, box: Box | None) -> Count:
    """How many published points a box holds: exact up to 10,000, beyond as the planner estimates."""
    if box is None:
        row = connection.execute(
            "select coalesce(sum(n_points), 0)::bigint as n from block where state = 'published'"
        ).fetchone()
        assert row is not None
        return Count(row["n"], exact=True)
    condition, parameters = _inside(box)
    chosen = _in_box(condition)
    row = connection.execute(
        f"select count(*) as n from (select 1 from ({chosen}) p limit {EXACT_COUNT + 1}) few",
        parameters,
        prepare=False,
    ).fetchone()
    assert row is not None
    if row["n"] <= EXACT_COUNT:
        return Count(row["n"], exact=True)
    return Count(max(EXACT_COUNT + 1, _estimated_count(connection, box)), exact=False)


def points_csv(connection: Connection, box: Box) -> Iterator[bytes]:
    """All published points of a box as CSV with a header, in pieces."""
    condition, parameters = _inside(box)
    statement = f"""copy (select {CSV_COLUMNS} from point p join block b on b.number = p.block_number
        where b.state = 'published' and {condition} order by p.id) to stdout with (format csv, header)"""
    with connection.cursor() as cursor, cursor.copy(statement, parameters) as copy:
        for piece in copy:
            yield bytes(piece)


def find_point(connection: Connection, point_id: int) -> PointDetail | None:
    """One published point."""
    row = connection.execute(
        """select p.id, st_x(geom) as lon_deg, st_y(geom) as lat_deg, st_z(geom) as height_m,
                sigma_east_m, sigma_north_m, sigma_up_m, corr_east_north, corr_east_up, corr_north_up,
                p.n_views, saliency, typology, first_view, last_view, b.id as block,
                b.version as block_version, f.storage_key as chip_key, chip_row, chip_count
            from point p join block b on b.number = p.block_number join chip_file f on f.id = p.chip_file
            where p.id = %s and b.state = 'published'""",
        [point_id],
    ).fetchone()
    if row is None:
        return None
    views = connection.execute(
        """select v.view, v.gsd_m, nullif(v.incidence_deg, 'NaN') as incidence_deg,
               nullif(v.azimuth_deg, 'NaN') as azimuth_deg, i.image_id, i.sensor, i.acquired_at,
               nullif(i.sun_elevation_deg, 'NaN') as sun_elevation_deg,
               nullif(i.sun_azimuth_deg, 'NaN') as sun_azimuth_deg
           from view v join image i on i.block_number = %s and i.image = v.image
           where v.point_id = %s order by v.view""",
        [point_id >> ID_BITS, point_id],
    ).fetchall()
    return PointDetail(**row, views=tuple(PointView(**view) for view in views))


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
    area = sql.Literal(shapely.to_wkb(_on_the_map(outline), include_srid=True, hex=True))
    point = _read(connection, _points_query(area, limit), POINT_KINDS)
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
    block_of_view = np.searchsorted(numbers, owner >> ID_BITS)
    points = ControlPoints(
        id=ids,
        lon_lat_h=_columns(point, "lon", "lat", "h"),
        covariance_m2=covariance_from_spread(
            _columns(point, "sigma_east", "sigma_north", "sigma_up"),
            _columns(point, "corr_east_north", "corr_east_up", "corr_north_up"),
        ),
        saliency=_columns(point, "saliency")[:, 0],
        health=np.ones(len(ids)),
        views=Views(
            start=np.searchsorted(owner, np.append(ids, np.iinfo(np.int64).max)).astype(np.int64),
            gsd_m=_as_written(view["gsd"]),
            image=first_image[block_of_view] + view["image"].astype(np.int64),
            incidence_deg=_columns(view, "incidence")[:, 0],
            azimuth_deg=_columns(view, "azimuth")[:, 0],
            health=np.ones(len(view)),
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
        """select id, st_x(geom) as lon, st_y(geom) as lat, st_z(geom) as h,
               sigma_east_m, sigma_north_m, sigma_up_m, corr_east_north, corr_east_up, corr_north_up,
               saliency, chip_file, chip_row
           from point where geom && {area}::geometry and st_intersects(geom, {area}::geometry)
               and block_number = any(array(select number from block where state = 'published'))"""
    ).format(area=area)
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


def _on_the_map(outline: Array) -> shapely.Geometry:
    """An outline with continuous longitudes as its parts between -180 and 180 degrees."""
    polygon = shapely.make_valid(shapely.Polygon(outline))
    world = shapely.box(-180.0, -90.0, 180.0, 90.0)
    turned = [
        shapely.transform(polygon, lambda lon_lat, turn=turn: lon_lat + [turn, 0.0])
        for turn in (-360.0, 0.0, 360.0)
    ]
    parts = shapely.union_all([shapely.intersection(part, world) for part in turned])
    return shapely.set_srid(parts, 4979)


def _everywhere() -> str:
    """Published points after an id, block by block along the primary key.

    Asked for more simply, the planner may read all unpublished points on its way to the published ones.
    """
    return f"""select p.* from ({PUBLISHED} and number >= %(after)s >> {ID_BITS}) b
        cross join lateral (
            select * from point where id > %(after)s and id >= b.number::bigint << {ID_BITS}
                and id < (b.number::bigint + 1) << {ID_BITS}
            order by id limit %(limit)s + 1) p
        order by b.number, p.id limit %(limit)s + 1"""


def _in_box(condition: str) -> str:
    return f"select p.* from point p where {condition} and block_number = any(array({PUBLISHED}))"


def _estimated_count(connection: Connection, box: Box) -> int:
    """What the planner expects in the box, by the share of all points that is published."""
    condition, parameters = _near(box)
    plan = connection.execute(
        f"explain (format json) select 1 from point p where {condition}", parameters
    ).fetchone()
    share = connection.execute(
        "select sum(n_points) filter (where state = 'published') / sum(n_points) as published from block"
    ).fetchone()
    assert plan is not None
    assert share is not None
    return int(plan["QUERY PLAN"][0]["Plan"]["Plan Rows"] * share["published"])


def _near(box: Box) -> tuple[str, dict[str, float]]:
    """The condition that a point lies in a box, as exact as the index is: single precision."""
    east = 180.0 if box.east < box.west else box.east
    parts = ["1"]
    parameters = {"west1": box.west, "east1": east, "south": box.south, "north": box.north}
    if box.east < box.west:
        parts.append("2")
        parameters |= {"west2": -180.0, "east2": box.east}
    envelopes = (
        f"p.geom && st_makeenvelope(%(west{i})s, %(south)s, %(east{i})s, %(north)s, 4979)" for i in parts
    )
    return f"({' or '.join(envelopes)})", parameters


def _inside(box: Box) -> tuple[str, dict[str, float]]:
    """The condition that a point lies in a box: by the index, then exactly.

    The exact part is wrapped in `coalesce`, where the planner does not look: it would take four ranges
    of unknown values for very selective, and read all the world to find its first hundred points.
    """
    near, parameters = _near(box)
    exact = " or ".join(
        f"st_x(p.geom) between %(west{i})s and %(east{i})s"
        for i in ("1", "2")
        if f"west{i}" in parameters
    )
    return (
        f"{near} and coalesce(({exact}) and st_y(p.geom) between %(south)s and %(north)s, false)",
        parameters,
    )
