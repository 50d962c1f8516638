"""Loading the contents of a block: images, files of chips, points and views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.db import binary_copy as binary
from app.db.blocks import ID_BITS
from app.db.engine import Connection
from services.formats.block.reader import BlockContents
from services.formats.block.tables import sigmas_from_covariance
from services.types import IntArray, Progress

POINT_COLUMNS = (
    "id, block_number, geom, sigma_east_m, sigma_north_m, sigma_up_m, corr_east_north, corr_east_up, "
    "corr_north_up, n_views, saliency, typology, first_view, last_view, chip_file, chip_row, chip_count"
)
VIEW_COLUMNS = "point_id, view, image, gsd_m, incidence_deg, azimuth_deg"


@dataclass(frozen=True)
class StoredChipFile:
    """A file of chips of a block.

    Attributes:
        name: path in the block.
        storage_key: where the storage has it.
    """

    name: str
    storage_key: str
    dtype: str
    n_chips: int


def load_contents(
    connection: Connection,
    number: int,
    contents: BlockContents,
    files: Sequence[StoredChipFile],
    progress: Progress,
) -> None:
    """Load the images, files of chips, points and views of a block.

    Args:
        number: of the block.
        contents: what it holds.
        files: one for each of `contents.points.chip_files`, in their order.
        progress: told while rows are sent.
    """
    progress(0.0, "loading images and files of chips")
    _insert_images(connection, number, contents)
    file_ids = _insert_chip_files(connection, number, files)
    points, views = _point_columns(number, contents, file_ids), _view_columns(number, contents)
    total, sent = len(points[0].length) + len(views[0].length), 0
    for table, names, columns in (("point", POINT_COLUMNS, points), ("view", VIEW_COLUMNS, views)):
        statement = f"copy {table} ({names}) from stdin (format binary)"
        with connection.cursor() as cursor, cursor.copy(statement) as copy:
            for piece, rows in binary.copy_pieces(columns):
                copy.write(piece)
                sent += rows
                progress(sent / total, f"loading rows of table {table}")


def _point_columns(number: int, contents: BlockContents, file_ids: IntArray) -> list[binary.Column]:
    points = contents.points
    sigma_m, correlation = sigmas_from_covariance(points.covariance_m2)
    spread = np.column_stack([sigma_m, correlation])
    return [
        binary.numbers((number << ID_BITS) + points.id, "i8"),
        binary.numbers(np.full(len(points), number), "i4"),
        binary.points_z(points.lon_lat_h),
        *(binary.numbers(spread[:, i], "f4") for i in range(6)),
        binary.numbers(contents.n_views, "i2"),
        binary.numbers(points.saliency, "f4"),
        binary.texts(contents.typology),
        binary.dates(contents.first_view),
        binary.dates(contents.last_view),
        binary.numbers(file_ids[points.chip_file], "i4"),
        binary.numbers(points.chip_row, "i8"),
        binary.numbers(np.diff(points.views.start), "i2"),
    ]


def _view_columns(number: int, contents: BlockContents) -> list[binary.Column]:
    points, views = contents.points, contents.points.views
    count = np.diff(views.start)
    within = np.arange(len(views.gsd_m)) - np.repeat(views.start[:-1], count)
    return [
        binary.numbers(np.repeat((number << ID_BITS) + points.id, count), "i8"),
        binary.numbers(within, "i2"),
        binary.numbers(views.image, "i4"),
        binary.numbers(views.gsd_m, "f4"),
        binary.numbers(views.incidence_deg, "f4"),
        binary.numbers(views.azimuth_deg, "f4"),
    ]


def _insert_images(connection: Connection, number: int, contents: BlockContents) -> None:
    rows = [
        (
            number,
            row,
            image.image_id,
            image.sensor,
            image.acquired_at,
            image.incidence_deg,
            image.azimuth_deg,
            image.sun_elevation_deg,
            image.sun_azimuth_deg,
        )
        for row, image in enumerate(contents.document.images)
    ]
    columns = (
        "block_number, image, image_id, sensor, acquired_at, incidence_deg, azimuth_deg, "
        "sun_elevation_deg, sun_azimuth_deg"
    )
    with connection.cursor() as cursor, cursor.copy(f"copy image ({columns}) from stdin") as copy:
        for values in rows:
            copy.write_row(values)


def _insert_chip_files(connection: Connection, number: int, files: Sequence[StoredChipFile]) -> IntArray:
    ids = []
    for file in files:
        row = connection.execute(
            "insert into chip_file (block_number, name, storage_key, dtype, n_chips)"
            " values (%s, %s, %s, %s, %s) returning id",
            [number, file.name, file.storage_key, file.dtype, file.n_chips],
        ).fetchone()
        assert row is not None
        ids.append(row["id"])
    return np.array(ids, dtype=np.int64)
