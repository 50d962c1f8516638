"""The points of a footprint as GeoJSON: built by the database, compared with rows decoded in Python.

A private cluster is filled with a million points in Hilbert order, on average one per 2 km2. Boxes with
about 1,000 and 2,000 points are read in turn in both ways, on one warm connection; both ways give the
same features.
Run: python -m benchmarks.footprint
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import numpy as np
from rich.console import Console
from rich.table import Table

from amers.app.db import engine, revisions
from amers.app.db.cluster.embedded import DATABASE, SUPERUSER, Cluster
from amers.app.db.engine import Connection
from amers.app.db.features.bbox import Box
from amers.app.db.features.collection import Viewer
from amers.app.usecases.features.items import find_collection, page
from amers.app.usecases.features.query import FeatureQuery, resolve
from benchmarks._filled import Ground, fill
from benchmarks._measuring import keep
from tests.statements import run_sql

SECRET = b"of pages"

ROWS = """
select p.id, st_x(p.geom) as lon, st_y(p.geom) as lat, st_z(p.geom) as h,
    p.sigma_east_m, p.sigma_north_m, p.sigma_up_m, p.corr_east_north, p.corr_east_up, p.corr_north_up,
    p.n_views, p.saliency, p.typology, p.first_view, p.last_view, p.block_number,
    p.surface_height_m, p.surface_sigma_m
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
    """Fill the store, measure, print and save the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=60)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="amers-bench-", dir="/tmp") as name:
        Path(name).chmod(0o755)
        cluster = Cluster(Path(name) / "postgres", durable=False)
        with cluster.lease() as dsn:
            revisions.upgrade(dsn)
            ground = fill(cluster.dsn(DATABASE, SUPERUSER), arguments.points)
            with engine.connect(dsn) as connection:
                sizes = (1_000, 2_000)
                outcomes = [measure(connection, ground, size, arguments.repeats) for size in sizes]
    show(outcomes, arguments.points)
    records = [asdict(outcome) for outcome in outcomes]
    keep("footprint", {"points": arguments.points, "outcomes": records})


def measure(connection: Connection, ground: Ground, size: int, repeats: int) -> Outcome:
    """Time both ways in turn on the same boxes, without the first run of each."""
    rng = np.random.default_rng(size)
    times: dict[str, list[float]] = {"sql": [], "python": []}
    counts = []
    for turn in range(repeats + 5):
        box = Box(*ground.box(rng, size))
        in_sql, sql_s = timed(lambda box=box: in_database(connection, box))
        in_python, python_s = timed(lambda box=box: in_rows(connection, box))
        if turn == 0:
            assert_same(in_sql, in_python)
        if turn >= 5:
            times["sql"].append(sql_s)
            times["python"].append(python_s)
            counts.append(json.loads(in_sql)["numberReturned"])
    sql_ms, python_ms = (1000.0 * median(times[way]) for way in ("sql", "python"))
    return Outcome(size, median(counts), sql_ms, python_ms, python_ms / sql_ms)


def timed(work: Callable[[], bytes]) -> tuple[bytes, float]:
    """The result of the work, and its time in milliseconds."""
    start = time.perf_counter()
    out = work()
    return out, time.perf_counter() - start


def in_database(connection: Connection, box: Box) -> bytes:
    """The reply as the service builds it."""
    bbox = f"{box.west!r},{box.south!r},{box.east!r},{box.north!r}"
    query = resolve(find_collection("points"), Viewer(), FeatureQuery(limit=10_000, bbox=bbox), SECRET)
    feature_page = page(connection, query, "geojson", SECRET)
    rest = f'"numberReturned":{feature_page.returned},"numberMatched":{feature_page.matched.number}'
    return b'{"type":"FeatureCollection","features":[' + feature_page.body + f"],{rest}}}".encode()


def in_rows(connection: Connection, box: Box) -> bytes:
    """The same reply from rows."""
    west, south, east, north = box.west, box.south, box.east, box.north
    rows = run_sql(connection, ROWS, [west, south, east, north, west, east, south, north]).fetchall()
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
    """Check that both replies have the same features."""
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
