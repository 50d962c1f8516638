"""Loading the contents of a block: images, files of chips, points and views."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from sqlalchemy import insert

from amers.app.db import binary_copy as binary
from amers.app.db.blocks import ID_BITS
from amers.app.db.engine import Connection, driver
from amers.app.db.schema import chip_file, image, point, view
from amers.app.db.statements import CopyIn, hot, named
from amers.services.formats.block.reader import BlockContents
from amers.services.formats.block.tables import sigmas_from_covariance
from amers.services.types import IntArray, Progress, SurfaceHeights


@dataclass(frozen=True)
class StoredChipFile:
    """A file of chips of a block.

    Attributes:
        name: path in the block.
        storage_key: where the storage has it.
        chip_checksums: as in `amers.services.formats.chips.checksums`.
    """

    name: str
    storage_key: str
    dtype: str
    n_chips: int
    chip_checksums: bytes


def load_contents(
    connection: Connection,
    number: int,
    contents: BlockContents,
    files: Sequence[StoredChipFile],
    progress: Progress,
) -> None:
    """Load the images, files of chips, points and views of a block, and set its outline.

    Args:
        number: of the block.
        files: one for each of `contents.points.chip_files`, in their order.
        progress: called while rows are sent.
    """
    progress(0.0, "loading images and files of chips")
    _insert_images(connection, number, contents)
    file_ids = _insert_chip_files(connection, number, files)
    points, views = _point_columns(number, contents, file_ids), _view_columns(number, contents)
    total, sent = len(points["id"].length) + len(views["point_id"].length), 0
    for table, columns in ((point, points), (view, views)):
        statement = hot(CopyIn(table, columns))
        with driver(connection).cursor() as cursor, cursor.copy(statement.sql) as copy:
            for piece, rows in binary.copy_pieces(list(columns.values())):
                copy.write(piece)
                sent += rows
                progress(sent / total, f"loading rows of table {table.name}")
    ids = {"first": number << ID_BITS, "end": (number + 1) << ID_BITS}
    connection.execute(named("blocks.sql", "set_outline"), {"number": number, **ids})


def _point_columns(number: int, contents: BlockContents, file_ids: IntArray) -> dict[str, binary.Column]:
    """Columns of the table `point`, by name."""
    points = contents.points
    sigma_m, correlation = sigmas_from_covariance(points.covariance_m2)
    spread = np.column_stack([sigma_m, correlation])
    unknown = np.full(len(points), np.nan)
    surface = points.surface or SurfaceHeights(unknown, unknown)
    spread_columns = (
        "sigma_east_m",
        "sigma_north_m",
        "sigma_up_m",
        "corr_east_north",
        "corr_east_up",
        "corr_north_up",
    )
    return {
        "id": binary.numbers((number << ID_BITS) + points.id, "i8"),
        "block_number": binary.numbers(np.full(len(points), number), "i4"),
        "geom": binary.points_z(points.lon_lat_h),
        **{name: binary.numbers(spread[:, i], "f4") for i, name in enumerate(spread_columns)},
        "n_views": binary.numbers(contents.n_views, "i2"),
        "saliency": binary.numbers(points.saliency, "f4"),
        "typology": binary.texts(contents.typology),
        "first_view": binary.dates(contents.first_view),
        "last_view": binary.dates(contents.last_view),
        "chip_file": binary.numbers(file_ids[points.chip_file], "i4"),
        "chip_row": binary.numbers(points.chip_row, "i8"),
        "chip_count": binary.numbers(np.diff(points.views.start), "i2"),
        "surface_height_m": binary.reals(surface.height_m, "f8"),
        "surface_sigma_m": binary.reals(surface.sigma_m, "f4"),
    }


def _view_columns(number: int, contents: BlockContents) -> dict[str, binary.Column]:
    """Columns of the table `view`, by name."""
    points, views = contents.points, contents.points.views
    count = np.diff(views.start)
    within = np.arange(len(views.gsd_m)) - np.repeat(views.start[:-1], count)
    return {
        "point_id": binary.numbers(np.repeat((number << ID_BITS) + points.id, count), "i8"),
        "view": binary.numbers(within, "i2"),
        "image": binary.numbers(views.image, "i4"),
        "gsd_m": binary.numbers(views.gsd_m, "f4"),
        "incidence_deg": binary.numbers(views.incidence_deg, "f4"),
        "azimuth_deg": binary.numbers(views.azimuth_deg, "f4"),
    }


def _insert_images(connection: Connection, number: int, contents: BlockContents) -> None:
    rows = [
        {
            "block_number": number,
            "image": index,
            "image_id": metadata.image_id,
            "sensor": metadata.sensor,
            "acquired_at": metadata.acquired_at,
            "incidence_deg": metadata.incidence_deg,
            "azimuth_deg": metadata.azimuth_deg,
            "sun_elevation_deg": metadata.sun_elevation_deg,
            "sun_azimuth_deg": metadata.sun_azimuth_deg,
        }
        for index, metadata in enumerate(contents.document.images)
    ]
    if rows:
        connection.execute(insert(image), rows)


def _insert_chip_files(connection: Connection, number: int, files: Sequence[StoredChipFile]) -> IntArray:
    """Insert the files of chips; returns their ids, in the order of the files."""
    if not files:
        return np.empty(0, dtype=np.int64)
    rows = [{"block_number": number, **asdict(file)} for file in files]
    statement = insert(chip_file).returning(chip_file.c.id, sort_by_parameter_order=True)
    return np.array(connection.scalars(statement, rows).all(), dtype=np.int64)
