"""A store with millions of published points and no chips, filled in minutes.

Blocks of a million points have the same extent in degrees, with one point for 2 km2 on average at the
latitude of the first row, each in Hilbert order. Twenty of them lie side by side along a parallel;
further rows follow to the south. A footprint meets the same ground however many points there are.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import psycopg
from rich.console import Console

from amers.app.db import binary_copy as binary
from amers.app.db import engine
from amers.app.db.blocks import ID_BITS
from amers.app.db.engine import Connection
from amers.app.db.schema import point
from amers.services.formats.block.hilbert import hilbert_order
from amers.services.geodesy import metres_per_degree
from amers.services.types import Array
from tests.statements import run_sql

WEST_DEG = -177.0
CENTRE_LAT_DEG = 44.0
"""Of the first row of blocks."""
POINTS_PER_KM2 = 0.5
BLOCK_POINTS = 1_000_000
ROW_BLOCKS = 20
"""Blocks along one parallel: with a million points each, from 177 degrees west to 175 degrees east."""
TYPOLOGIES = ("crossroads", "building corner", None)


@dataclass(frozen=True)
class Ground:
    """Where the points lie.

    Attributes:
        west_south_deg: (blocks, 2) lon, lat of the corner of each block.
        side_deg: (2,) extent of a block in longitude and latitude.
        points: how many.
        block_points: how many in each block but the last.
    """

    west_south_deg: Array
    side_deg: Array
    points: int
    block_points: int

    def box(self, rng: np.random.Generator, count: int) -> tuple[float, float, float, float]:
        """West, south, east, north of a box in one of the blocks that holds about so many points."""
        part = side_m(count) / np.array(metres_per_degree(CENTRE_LAT_DEG, 0.0))
        low = rng.choice(self.west_south_deg) + rng.uniform(0.0, 1.0, 2) * (self.side_deg - part)
        west, south, east, north = (float(value) for value in (*low, *(low + part)))
        return west, south, east, north

    def point_id(self, rng: np.random.Generator) -> int:
        """The id of one of the points."""
        block, row = divmod(int(rng.integers(self.points)), self.block_points)
        return ((block + 1) << ID_BITS) + row

    def points_of(self, block: int) -> int:
        """How many points a block has; the last one may have fewer."""
        return min(self.block_points, self.points - block * self.block_points)


def side_m(count: int) -> float:
    """Side of the square that holds so many points."""
    return math.sqrt(count / POINTS_PER_KM2) * 1000.0


def lay_out(count: int, block_points: int = BLOCK_POINTS) -> Ground:
    """The ground of so many points.

    Raises:
        ValueError: the rows of blocks would leave the Earth.
    """
    blocks = -(-count // block_points)
    block_points = -(-count // blocks)  # As many in each, so that density is the same everywhere.
    side_deg = side_m(block_points) / np.array(metres_per_degree(CENTRE_LAT_DEG, 0.0))
    row, column = np.divmod(np.arange(blocks), ROW_BLOCKS)
    low = np.column_stack([column, -row]) * side_deg + [WEST_DEG, CENTRE_LAT_DEG - side_deg[1] / 2.0]
    if low[:, 1].min() < -90.0 or (low + side_deg).max() > 180.0:
        raise ValueError(f"{count:,} points in blocks of {block_points:,} leave the Earth")
    return Ground(low, side_deg, count, block_points)


def fill(
    dsn: str, count: int, console: Console | None = None, block_points: int = BLOCK_POINTS
) -> Ground:
    """Fill an empty store of the newest schema with published points; indexes are built at the end.

    The role of the connection string has to be a superuser.
    """
    ground = lay_out(count, block_points)
    blocks = len(ground.west_south_deg)
    with engine.connect(dsn) as connection:
        # Rows made here need no check against the tables they point to, four fifths of the time.
        run_sql(connection, "set session_replication_role = replica")
        run_sql(connection, "drop index point_geom")
        for k in range(blocks):
            _insert_block(connection, ground, k)
            binary.insert_rows(connection, point, _columns(ground, k))
            if console is not None:
                console.print(f"block {k + 1} of {blocks} filled")
        run_sql(connection, "set session_replication_role = origin")
        run_sql(connection, "select setval(pg_get_serial_sequence('block', 'number'), %s)", [blocks])
        run_sql(connection, "select setval(pg_get_serial_sequence('chip_file', 'id'), %s)", [blocks])
        run_sql(connection, "create index point_geom on point using gist (geom)")
    with psycopg.connect(dsn, autocommit=True) as alone:
        alone.execute("vacuum analyze point")
        alone.execute("vacuum analyze block")
    return ground


def _insert_block(connection: Connection, ground: Ground, k: int) -> None:
    low, number = ground.west_south_deg[k], k + 1
    run_sql(
        connection,
        """insert into block (number, id, version, state, extent, n_points, n_views, metadata, checksum)
           overriding system value
           values (%s, %s, '1', 'published', st_makeenvelope(%s, %s, %s, %s, 4326), %s, 0, '{}', '')""",
        [number, f"bench-{number}", *low, *(low + ground.side_deg), ground.points_of(k)],
    )
    run_sql(
        connection,
        """insert into chip_file (id, block_number, name, storage_key, dtype, n_chips)
           overriding system value values (%s, %s, 'chips/0000.npy', 'chips/0', 'uint8', 0)""",
        [number, number],
    )


def _columns(ground: Ground, k: int) -> Mapping[str, binary.Column]:
    number, count = k + 1, ground.points_of(k)
    rng = np.random.default_rng(number)
    lon_lat = ground.west_south_deg[k] + rng.uniform(0.0, 1.0, (count, 2)) * ground.side_deg
    lon_lat_h = np.column_stack([lon_lat[hilbert_order(lon_lat)], rng.uniform(0.0, 2000.0, count)])
    return {
        "id": binary.numbers((number << ID_BITS) + np.arange(count), "i8"),
        "block_number": binary.numbers(np.full(count, number), "i4"),
        "geom": binary.points_z(lon_lat_h),
        "sigma_east_m": binary.numbers(rng.uniform(0.5, 3.0, count), "f4"),
        "sigma_north_m": binary.numbers(rng.uniform(0.5, 3.0, count), "f4"),
        "sigma_up_m": binary.numbers(rng.uniform(0.5, 3.0, count), "f4"),
        "corr_east_north": binary.numbers(rng.uniform(-0.3, 0.3, count), "f4"),
        "corr_east_up": binary.numbers(rng.uniform(-0.3, 0.3, count), "f4"),
        "corr_north_up": binary.numbers(rng.uniform(-0.3, 0.3, count), "f4"),
        "n_views": binary.numbers(np.full(count, 8), "i2"),
        "saliency": binary.numbers(rng.uniform(0.0, 1.0, count), "f4"),
        "typology": binary.texts(rng.choice(np.array(TYPOLOGIES, dtype=object), count)),
        "first_view": binary.dates(np.full(count, np.datetime64("2023-03-01"))),
        "last_view": binary.dates(np.full(count, np.datetime64("2024-06-09"))),
        "chip_file": binary.numbers(np.full(count, number), "i4"),
        "chip_row": binary.numbers(np.arange(count) * 8, "i8"),
        "chip_count": binary.numbers(np.full(count, 8), "i2"),
    }
