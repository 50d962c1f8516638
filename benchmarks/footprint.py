"""The points of a footprint as GeoJSON: built by the database, against rows decoded in Python.

A private cluster is filled with a million points in Hilbert order, one for 2 km2 on average. Boxes that
hold about 1,000 and 2,000 points are asked for in turn by both ways, on one connection, warm; both give
the same features. Run: python -m benchmarks.footprint
"""

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import numpy as np
from rich.console import Console
from rich.table import Table

from app.db import binary_copy as binary
from app.db import engine
from app.db.collections import Viewer
from app.db.conditions import Box
from app.db.embedded import Cluster
from app.db.engine import Connection
from app.db.ingestion import POINT_COLUMNS
from app.usecases.features import find_collection, page
from app.usecases.questions import Question, understand
from services.formats.hilbert import hilbert_order
from services.geodesy import metres_per_degree

RESULTS = Path(__file__).parent / "results"
CENTRE_LAT_DEG = 44.0
POINTS_PER_KM2 = 0.5
BLOCK = 1
SECRET = b"of pages"

ROWS = """
select p.id, st_x(p.geom) as lon, st_y(p.geom) as lat, st_z(p.geom) as h,
    p.sigma_east_m, p.sigma_north_m, p.sigma_up_m, p.corr_east_north, p.corr_east_up, p.corr_north_up,
    p.n_views, p.saliency, p.typology, p.first_view, p.last_view, p.block_number
from point p join block b on b.number = p.block_number
where b.state = 'published' and p.geom && st_makeenvelope(%s, %s, %s, %s, 4979)
    and st_x(p.geom) between %s and %s and st_y(p.geom) between %s and %s
order by p.id limit 10000
"""


@dataclass(frozen=True)
class Outcome:
    """Median times of both ways for footprints of one size."""

    footprint_points: int
    points_found: float
    in_sql_ms: float
    in_python_ms: float
    ratio: float


def main() -> None:
    """Fill, measure, print, keep."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=60)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="amers-bench-", dir="/tmp") as name:
        Path(name).chmod(0o755)
        with Cluster(Path(name) / "postgres", durable=False).lease() as dsn:
            engine.upgrade(dsn)
            with engine.connect(dsn) as connection:
                side_deg = fill(connection, arguments.points)
                connection.commit()
                outcomes = [
                    measure(connection, side_deg, arguments.points, size, arguments.repeats)
                    for size in (1_000, 2_000)
                ]
    show(outcomes, arguments.points)
    RESULTS.mkdir(exist_ok=True)
    kept = {"points": arguments.points, "outcomes": [asdict(outcome) for outcome in outcomes]}
    (RESULTS / "footprint.json").write_text(json.dumps(kept, indent=1) + "\n")


def fill(connection: Connection, count: int) -> tuple[float, float]:
    """A published block of points; returns the size of its box in degrees of longitude and latitude."""
    rng = np.random.default_rng(1)
    side_m = math.sqrt(count / POINTS_PER_KM2) * 1000.0
    east_m, north_m = metres_per_degree(CENTRE_LAT_DEG, 0.0)
    side_deg = side_m / east_m, side_m / north_m
    low = np.array([0.0, CENTRE_LAT_DEG - side_deg[1] / 2.0])
    lon_lat = low + rng.uniform(0.0, 1.0, (count, 2)) * side_deg
    lon_lat_h = np.column_stack([lon_lat[hilbert_order(lon_lat)], rng.uniform(0.0, 2000.0, count)])
    connection.execute(
        """insert into block (id, version, state, extent, n_points, n_views, metadata, checksum)
           values ('bench', '1', 'published', st_makeenvelope(0, 0, 1, 1, 4326), %s, 0, '{}', '')""",
        [count],
    )
    connection.execute(
        """insert into chip_file (block_number, name, storage_key, dtype, n_chips)
           values (1, 'chips/0000.npy', 'chips/0', 'uint8', 0)"""
    )
    columns = [
        binary.numbers((BLOCK << 26) + np.arange(count), "i8"),
        binary.numbers(np.full(count, BLOCK), "i4"),
        binary.points_z(lon_lat_h),
        *(binary.numbers(rng.uniform(0.5, 3.0, count), "f4") for _ in range(3)),
        *(binary.numbers(rng.uniform(-0.3, 0.3, count), "f4") for _ in range(3)),
        binary.numbers(np.full(count, 8), "i2"),
        binary.numbers(rng.uniform(0.0, 1.0, count), "f4"),
        binary.texts(rng.choice(np.array(["crossroads", "building corner", None], dtype=object), count)),
        binary.dates(np.full(count, np.datetime64("2023-03-01"))),
        binary.dates(np.full(count, np.datetime64("2024-06-09"))),
        binary.numbers(np.ones(count), "i4"),
        binary.numbers(np.arange(count) * 8, "i8"),
        binary.numbers(np.full(count, 8), "i2"),
    ]
    with connection.cursor() as cursor:
        with cursor.copy(f"copy point ({POINT_COLUMNS}) from stdin (format binary)") as copy:
            for piece, _ in binary.copy_pieces(columns):
                copy.write(piece)
        cursor.execute("analyze point")
        cursor.execute("analyze block")
    return side_deg


def measure(
    connection: Connection, side_deg: tuple[float, float], count: int, size: int, repeats: int
) -> Outcome:
    """Time both ways in turn on the same boxes, the first of each not counted."""
    rng = np.random.default_rng(size)
    part = math.sqrt(size / count)
    times: dict[str, list[float]] = {"sql": [], "python": []}
    found = []
    for turn in range(repeats + 5):
        west, south = rng.uniform(0.0, 1.0 - part, 2) * side_deg
        south += CENTRE_LAT_DEG - side_deg[1] / 2.0
        corners = west, south, west + part * side_deg[0], south + part * side_deg[1]
        box = Box(*map(float, corners))
        in_sql, sql_s = timed(lambda box=box: in_database(connection, box))
        in_python, python_s = timed(lambda box=box: in_rows(connection, box))
        if turn == 0:
            assert_same(in_sql, in_python)
        if turn >= 5:
            times["sql"].append(sql_s)
            times["python"].append(python_s)
            found.append(json.loads(in_sql)["numberReturned"])
    sql_ms, python_ms = (1000.0 * median(times[way]) for way in ("sql", "python"))
    return Outcome(size, median(found), sql_ms, python_ms, python_ms / sql_ms)


def timed(work: Callable[[], bytes]) -> tuple[bytes, float]:
    """What the work gives, and how long it took."""
    start = time.perf_counter()
    out = work()
    return out, time.perf_counter() - start


def in_database(connection: Connection, box: Box) -> bytes:
    """The way of the service."""
    bbox = f"{box.west!r},{box.south!r},{box.east!r},{box.north!r}"
    asked = understand(find_collection("points"), Viewer(), Question(10_000, bbox=bbox), SECRET)
    found = page(connection, asked, "geojson", SECRET)
    rest = f'"numberReturned":{found.returned},"numberMatched":{found.matched.number}'
    return b'{"type":"FeatureCollection","features":[' + found.body + f"],{rest}}}".encode()


def in_rows(connection: Connection, box: Box) -> bytes:
    """The same reply from rows."""
    west, south, east, north = box.west, box.south, box.east, box.north
    rows = connection.execute(ROWS, [west, south, east, north, west, east, south, north]).fetchall()
    features = []
    for row in rows:
        point_id, lon, lat, h = row.pop("id"), row.pop("lon"), row.pop("lat"), row.pop("h")
        for name in ("first_view", "last_view"):
            row[name] = None if row[name] is None else row[name].isoformat()
        point = {"type": "Point", "coordinates": [round(lon, 9), round(lat, 9), round(h, 9)]}
        features.append({"type": "Feature", "id": point_id, "geometry": point, "properties": row})
    page = {"type": "FeatureCollection", "features": features, "numberReturned": len(features)}
    return json.dumps({**page, "numberMatched": len(features)}, separators=(",", ":")).encode()


def assert_same(one: bytes, other: bytes) -> None:
    """Both replies say the same."""
    first, second = json.loads(one), json.loads(other)
    assert first["numberReturned"] == second["numberReturned"] > 0
    for a, b in zip(first["features"], second["features"], strict=True):
        assert a["properties"] == b["properties"]
        assert a["id"] == b["id"]
        assert np.allclose(a["geometry"]["coordinates"], b["geometry"]["coordinates"], rtol=0, atol=2e-9)


def show(outcomes: list[Outcome], count: int) -> None:
    """Print the table."""
    table = Table(
        "footprint",
        "points found",
        "GeoJSON in SQL",
        "rows, then Python",
        "ratio",
        title=f"of {count:,} points",
    )
    for outcome in outcomes:
        table.add_row(
            f"{outcome.footprint_points:,}",
            f"{outcome.points_found:,.0f}",
            f"{outcome.in_sql_ms:.1f} ms",
            f"{outcome.in_python_ms:.1f} ms",
            f"{outcome.ratio:.1f}",
        )
    Console().print(table)


if __name__ == "__main__":
    main()
