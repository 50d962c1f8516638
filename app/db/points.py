"""Control points of published blocks: as a collection, and as arrays by outline and by ids."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely
from sqlalchemy import (
    ARRAY,
    BigInteger,
    ColumnElement,
    Label,
    LargeBinary,
    Select,
    and_,
    any_,
    bindparam,
    cast,
    func,
    or_,
    select,
    true,
)

from amers.app.db.binary_copy import parse_copy
from amers.app.db.blocks import FRAME, FRAME_SIGMA_M, ID_BITS, in_published_block, published_numbers
from amers.app.db.constants import integer_constant, text_constant
from amers.app.db.density import points_in_box
from amers.app.db.engine import Connection, driver
from amers.app.db.features.antimeridian import on_the_map
from amers.app.db.features.collection import Collection, column_property
from amers.app.db.features.predicates import geometry_from_wkb, meets_box
from amers.app.db.features.query import AFTER_KEY, LIMIT
from amers.app.db.history import point_health, view_health
from amers.app.db.rows import columns_of
from amers.app.db.schema import block, chip_file, image, point, view
from amers.app.db.statements import CopyOut, HotStatement, hot
from amers.services.formats.block.frame_json import parse_frame
from amers.services.formats.block.tables import covariance_from_sigmas
from amers.services.types import Acquisition, Array, ControlPoints, Frame, IntArray, Views

SERVED = and_(point.c.superseded_by.is_(None), point.c.suspended_at.is_(None))
"""Neither a better block has the point, nor an administrator has suspended it."""
VISIBLE = and_(SERVED, in_published_block())
IDS = bindparam("ids", None, ARRAY(BigInteger()))


def _block_by_block(columns: Sequence[Label[Any]], predicate: ColumnElement[bool]) -> Select[Any]:
    """All served points in the order of ids, block by block along the primary key.

    Of a plainer statement the planner may read all unpublished points on its way to the published ones.
    """
    bits = integer_constant(ID_BITS)
    blocks = published_numbers().where(block.c.number >= AFTER_KEY.op(">>")(bits)).subquery("blocks")
    number = cast(blocks.c.number, BigInteger())
    rows = (
        select(*columns, point.c.id.label("key_of_scan"))
        .where(
            point.c.id > AFTER_KEY,
            point.c.id >= number.op("<<")(bits),
            point.c.id < (number + integer_constant(1)).op("<<")(bits),
            SERVED,
            predicate,
        )
        .order_by(point.c.id)
        .limit(LIMIT + integer_constant(1))
        .lateral("rows")
    )
    return (
        select(*(rows.c[column.name] for column in columns))
        .select_from(blocks.join(rows, true()))
        .order_by(blocks.c.number, rows.c.key_of_scan)
        .limit(LIMIT + integer_constant(1))
    )


POINTS = Collection(
    id="points",
    title="Control points",
    description="3D ground control points with image chips, of all published blocks.",
    source=point,
    key=column_property(point.c.id, "Identifier"),
    properties=(
        column_property(
            point.c.sigma_east_m, "Standard deviation eastwards, in the frame of its block", "m"
        ),
        column_property(
            point.c.sigma_north_m, "Standard deviation northwards, in the frame of its block", "m"
        ),
        column_property(
            point.c.sigma_up_m, "Standard deviation of the height, in the frame of its block", "m"
        ),
        column_property(point.c.corr_east_north, "Correlation of east and north"),
        column_property(point.c.corr_east_up, "Correlation of east and height"),
        column_property(point.c.corr_north_up, "Correlation of north and height"),
        column_property(point.c.n_views, "Images that show the point"),
        column_property(point.c.saliency, "How well its chips can be located, 0 to 1"),
        column_property(point.c.typology, "Kind of object on the ground"),
        column_property(point.c.first_view, "Date of the first view"),
        column_property(point.c.last_view, "Date of the last view"),
        column_property(point.c.block_number, "Number of its block"),
        column_property(point.c.surface_height_m, "Height of the surface at its place", "m"),
        column_property(point.c.surface_sigma_m, "Standard deviation of the surface height", "m"),
    ),
    geometry_type="Point",
    geometry=point.c.geom,
    has_height=True,
    visible=VISIBLE,
    interval=("first_view", "last_view"),
    full_scan=_block_by_block,
    total=select(
        cast(
            func.coalesce(func.sum(block.c.n_points - block.c.n_unserved), integer_constant(0)),
            BigInteger(),
        )
    ).where(block.c.state == text_constant("published")),
    estimate_in_box=points_in_box,
)

# Columns of points and views as arrays: name, kind in `binary_copy`, expression.
POINT_ARRAYS: tuple[tuple[str, str, ColumnElement[Any]], ...] = (
    ("id", "i8", point.c.id),
    ("lon", "f8", func.st_x(point.c.geom)),
    ("lat", "f8", func.st_y(point.c.geom)),
    ("h", "f8", func.st_z(point.c.geom)),
    ("sigma_east", "f4", point.c.sigma_east_m),
    ("sigma_north", "f4", point.c.sigma_north_m),
    ("sigma_up", "f4", point.c.sigma_up_m),
    ("corr_east_north", "f4", point.c.corr_east_north),
    ("corr_east_up", "f4", point.c.corr_east_up),
    ("corr_north_up", "f4", point.c.corr_north_up),
    ("saliency", "f4", point.c.saliency),
    ("chip_file", "i4", point.c.chip_file),
    ("chip_row", "i8", point.c.chip_row),
)
VIEW_ARRAYS: tuple[tuple[str, str, ColumnElement[Any]], ...] = (
    ("point_id", "i8", view.c.point_id),
    ("image", "i4", view.c.image),
    ("gsd", "f4", view.c.gsd_m),
    ("incidence", "f4", view.c.incidence_deg),
    ("azimuth", "f4", view.c.azimuth_deg),
)
Arrays = tuple[tuple[str, str, ColumnElement[Any]], ...]


@dataclass(frozen=True)
class BlockVersion:
    """A version of a block that points came from.

    Attributes:
        frame: how well its frame is known on the Earth.
    """

    number: int
    id: str
    version: str
    frame: Frame


@dataclass(frozen=True)
class StoredPoints:
    """Control points of the store.

    Attributes:
        points: their `chip_files` are keys of the storage.
        blocks: the versions they come from.
    """

    points: ControlPoints
    blocks: tuple[BlockVersion, ...]


def control_points(connection: Connection, outline: Array, limit: int | None = None) -> StoredPoints:
    """The published points inside an outline, with their views, as arrays.

    Heights of the surface are left out: registration has no use for them.

    Args:
        outline: (m, 2) lon, lat, not closed, longitudes continuous (beyond 180 degrees across the
            antimeridian).
        limit: where there are more, so many of them evenly along the Hilbert order of their blocks,
            which spreads them over the ground.

    Returns:
        Points in the order of their ids.
    """
    area = shapely.to_wkb(on_the_map(shapely.make_valid(shapely.Polygon(outline))))
    if limit is None:
        return _with_views(connection, _points_inside(), {"area": area})
    return _with_views(connection, _some_points_inside(), {"area": area, "limit": limit})


def points_of_ids(connection: Connection, ids: Sequence[int]) -> StoredPoints:
    """The published points of some ids, with their views, as arrays.

    Returns:
        Points in the order of their ids, without those that do not exist.
    """
    return _with_views(connection, _points_of_ids(), {"ids": list(ids)})


def points_of_block(connection: Connection, number: int) -> StoredPoints:
    """All points of a block in any state, with their views, as arrays, in the order of their ids.

    Heights of the surface are left out.
    """
    return _with_views(connection, _points_of_block(), {"number": number})


@cache
def _points_of_block() -> HotStatement:
    number, bits = bindparam("number", None, BigInteger()), integer_constant(ID_BITS)
    first = cast(number, BigInteger()).op("<<")(bits)
    last = (cast(number, BigInteger()) + integer_constant(1)).op("<<")(bits)
    rows = _select_arrays(POINT_ARRAYS).where(point.c.id >= first, point.c.id < last)
    return hot(CopyOut(rows.order_by(point.c.id), "binary"))


@cache
def _points_inside() -> HotStatement:
    return hot(CopyOut(_select_inside().order_by(point.c.id), "binary"))


@cache
def _some_points_inside() -> HotStatement:
    """Of n points inside, the rows where `rank * limit / n` steps up."""
    rank = (func.row_number().over(order_by=point.c.id) - integer_constant(1)).label("rank")
    count = func.count().over().label("n")
    ranked = _select_inside().add_columns(rank, count).subquery("ranked")
    limit = bindparam("limit", None, BigInteger())
    place, place_before = (
        ((row * limit).op("/")(ranked.c.n))
        for row in (ranked.c.rank, ranked.c.rank - integer_constant(1))
    )
    steps = or_(ranked.c.rank == integer_constant(0), place > place_before)
    columns = (ranked.c[name] for name, _, _ in POINT_ARRAYS)
    return hot(CopyOut(select(*columns).where(steps).order_by(ranked.c.id), "binary"))


def _select_inside() -> Select[Any]:
    area = geometry_from_wkb(bindparam("area", None, LargeBinary()), POINTS.storage_crs.srid)
    inside = (meets_box(point.c.geom, area), func.st_intersects(point.c.geom, area))
    return _select_arrays(POINT_ARRAYS).where(*inside, VISIBLE)


@cache
def _points_of_ids() -> HotStatement:
    rows = _select_arrays(POINT_ARRAYS).where(point.c.id == any_(IDS), in_published_block())
    return hot(CopyOut(rows.order_by(point.c.id), "binary"))


@cache
def _views_of_points() -> HotStatement:
    rows = _select_arrays(VIEW_ARRAYS).where(view.c.point_id == any_(IDS))
    return hot(CopyOut(rows.order_by(view.c.point_id, view.c.view), "binary"))


def _select_arrays(arrays: Arrays) -> Select[Any]:
    return select(*(expression.label(name) for name, _, expression in arrays))


def _with_views(
    connection: Connection, points_statement: HotStatement, parameters: dict[str, Any]
) -> StoredPoints:
    points = _read(connection, points_statement, parameters, POINT_ARRAYS)
    ids = points["id"].astype(np.int64)
    views = _read(connection, _views_of_points(), {"ids": ids.tolist()}, VIEW_ARRAYS)
    numbers = np.unique(ids >> ID_BITS)
    versions = _versions(connection, numbers)
    images, first_image = _images(connection, numbers)
    chip_files, storage_keys = _chip_files(connection, points["chip_file"].astype(np.int64))
    owner = views["point_id"].astype(np.int64)
    start = np.searchsorted(owner, np.append(ids, np.iinfo(np.int64).max)).astype(np.int64)
    block_of_view = np.searchsorted(numbers, owner >> ID_BITS)
    control = ControlPoints(
        id=ids,
        lon_lat_h=_columns(points, "lon", "lat", "h"),
        covariance_m2=covariance_from_sigmas(
            _columns(points, "sigma_east", "sigma_north", "sigma_up"),
            _columns(points, "corr_east_north", "corr_east_up", "corr_north_up"),
        ),
        block=np.searchsorted(numbers, ids >> ID_BITS).astype(np.int64),
        frames=tuple(version.frame for version in versions),
        saliency=_columns(points, "saliency")[:, 0],
        health=point_health(connection, ids),
        views=Views(
            start=start,
            gsd_m=_as_written(views["gsd"]),
            image=first_image[block_of_view] + views["image"].astype(np.int64),
            incidence_deg=_columns(views, "incidence")[:, 0],
            azimuth_deg=_columns(views, "azimuth")[:, 0],
            health=view_health(connection, ids, start),
            images=images,
        ),
        chip_file=chip_files,
        chip_row=points["chip_row"].astype(np.int64),
        chip_files=storage_keys,
    )
    return StoredPoints(control, versions)


def _read(
    connection: Connection, statement: HotStatement, parameters: dict[str, Any], arrays: Arrays
) -> npt.NDArray[np.void]:
    values = statement.parameters(parameters)
    with driver(connection).cursor() as cursor, cursor.copy(statement.sql, values) as copy:
        data = b"".join(bytes(piece) for piece in copy)
    return parse_copy(data, [(name, kind) for name, kind, _ in arrays])


def _columns(rows: npt.NDArray[np.void], *names: str) -> Array:
    return np.column_stack([rows[name].astype(np.float64) for name in names])


def _as_written(values: npt.NDArray[Any]) -> Array:
    """Single-precision values as the shortest decimals that stand for them: 0.7, not 0.699999988."""
    distinct, inverse = np.unique(values.astype(np.float32), return_inverse=True)
    return np.array([float(str(value)) for value in distinct], dtype=np.float64)[inverse]


def _nan_if_null(column: ColumnElement[Any]) -> ColumnElement[Any]:
    return func.coalesce(column, text_constant("NaN"))


_IMAGE_COLUMNS = columns_of(
    Acquisition,
    image,
    incidence_deg=_nan_if_null(image.c.incidence_deg),
    azimuth_deg=_nan_if_null(image.c.azimuth_deg),
    sun_elevation_deg=_nan_if_null(image.c.sun_elevation_deg),
    sun_azimuth_deg=_nan_if_null(image.c.sun_azimuth_deg),
)
_IMAGE_FIELDS = tuple(column.key for column in _IMAGE_COLUMNS)
_IMAGES = (
    select(image.c.block_number.label("block_number"), *_IMAGE_COLUMNS)
    .where(image.c.block_number == any_(IDS))
    .order_by(image.c.block_number, image.c.image)
)
_STORAGE_KEYS = (
    select(chip_file.c.storage_key).where(chip_file.c.id == any_(IDS)).order_by(chip_file.c.id)
)
_VERSIONS = (
    select(
        block.c.number,
        block.c.id,
        block.c.version,
        FRAME.label("frame"),
        FRAME_SIGMA_M.label("frame_sigma_m"),
    )
    .where(block.c.number == any_(IDS))
    .order_by(block.c.number)
)


def _images(connection: Connection, numbers: IntArray) -> tuple[tuple[Acquisition, ...], IntArray]:
    """The images of blocks, one block after the other, and where those of each block begin."""
    rows = connection.execute(_IMAGES, {"ids": numbers.tolist()}).mappings().all()
    blocks = np.array([row["block_number"] for row in rows], dtype=np.int64)
    images = [{name: row[name] for name in _IMAGE_FIELDS} for row in rows]
    return tuple(Acquisition(**one) for one in images), np.searchsorted(blocks, numbers)


def _chip_files(connection: Connection, files: IntArray) -> tuple[IntArray, tuple[str, ...]]:
    """The place of each file in the list of distinct files, and their keys in the storage."""
    ids, places = np.unique(files, return_inverse=True)
    storage_keys = connection.execute(_STORAGE_KEYS, {"ids": ids.tolist()}).scalars()
    return places.astype(np.int64), tuple(storage_keys)


def _versions(connection: Connection, numbers: IntArray) -> tuple[BlockVersion, ...]:
    """The versions of blocks, in the order of their numbers."""
    rows = connection.execute(_VERSIONS, {"ids": numbers.tolist()}).mappings()
    return tuple(
        BlockVersion(
            row["number"],
            row["id"],
            row["version"],
            parse_frame(row["frame"], row["frame_sigma_m"]),
        )
        for row in rows
    )
