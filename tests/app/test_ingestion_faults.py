"""Failed ingestions: whatever the fault, nothing of the block is visible afterwards."""

import hashlib
import json
import os
import signal
import time
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

import numpy as np
import psycopg
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from amers.app.db import binary_copy, engine, revisions
from amers.app.db.cluster.embedded import Cluster
from amers.app.db.metrics import read_gauges
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.garbage_collection import Bin, remove_unnamed_chips
from amers.services.errors import FormatError
from tests.factories import make_block
from tests.statements import run_sql

pytestmark = [pytest.mark.long, pytest.mark.thorough]

TABLES = ("block", "image", "chip_file", "point", "view")
PATIENCE_S = 30.0


def rows(connection) -> dict[str, int]:
    """The number of rows in the tables of blocks."""
    return {
        table: run_sql(connection, f"select count(*) as n from {table}").fetchone()["n"]
        for table in TABLES
    }


def resigned(folder: Path) -> None:
    """Make the checksums true again, so that only what was changed on purpose is wrong."""
    document = json.loads((folder / "block.json").read_text())
    for name in document["amers:checksums"]:
        data = (folder / name).read_bytes()
        document["amers:checksums"][name] = hashlib.sha256(data).hexdigest()
    (folder / "block.json").write_text(json.dumps(document))


def changed_chip(folder: Path) -> None:
    with (folder / "chips/0000.npy").open("r+b") as file:
        file.seek(9_000)
        file.write(b"\x01\x02")


def changed_file_that_no_point_names(folder: Path) -> None:
    (folder / "chips/9999.npy").write_bytes(b"of no point")
    document = json.loads((folder / "block.json").read_text())
    document["amers:checksums"]["chips/9999.npy"] = "0" * 64
    (folder / "block.json").write_text(json.dumps(document))


def missing_chip_file(folder: Path) -> None:
    (folder / "chips/0000.npy").unlink()


def nan_coordinate(folder: Path) -> None:
    path = folder / "points.parquet"
    table = pq.read_table(path)
    index = table.schema.get_field_index("geometry")
    wkb = table["geometry"].to_pylist()
    wkb[3] = wkb[3][:5] + np.array(np.nan, "<f8").tobytes() + wkb[3][13:]
    pq.write_table(table.set_column(index, table.schema.field(index), pa.array(wkb, pa.binary())), path)
    resigned(folder)


def truncated_parquet(folder: Path) -> None:
    path = folder / "views.parquet"
    path.write_bytes(path.read_bytes()[:-200])
    resigned(folder)


def misshapen_chips(folder: Path) -> None:
    path = folder / "chips/0000.npy"
    np.save(path, np.load(path)[:, :, :99])
    resigned(folder)


def path_out_of_the_folder(folder: Path) -> None:
    path = folder / "points.parquet"
    table = pq.read_table(path)
    index = table.schema.get_field_index("chip_file")
    outside = pa.array(["../../outside.npy"] * table.num_rows)
    pq.write_table(table.set_column(index, table.schema.field(index), outside), path)
    resigned(folder)


def link_out_of_the_folder(folder: Path) -> None:
    outside = folder.parent / "outside.npy"
    os.rename(folder / "chips/0000.npy", outside)
    (folder / "chips/0000.npy").symlink_to(outside)


def no_document(folder: Path) -> None:
    (folder / "block.json").write_text("{")


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (changed_chip, r"chips/0000\.npy: sha256"),
        (changed_file_that_no_point_names, r"chips/9999\.npy: sha256"),
        (missing_chip_file, r"chips/0000\.npy: no file"),
        (nan_coordinate, r"points\.parquet: geometry lon: row 3: nan found"),
        (truncated_parquet, r"views\.parquet: cannot be read as Parquet"),
        (misshapen_chips, r"chips/0000\.npy: shape \(240, 101, 99\)"),
        (path_out_of_the_folder, r"chip_file: '\.\./\.\./outside\.npy' found"),
        (link_out_of_the_folder, r"chips/0000\.npy: a link"),
        (no_document, r"block\.json: cannot be parsed as JSON"),
    ],
)
def test_a_broken_block_is_refused_by_name_changes_nothing_and_works_once_mended(
    connection, storage, tmp_path, spoil, named
):
    broken = make_block(tmp_path / "broken")
    spoil(broken.folder)
    with pytest.raises(FormatError, match=named):
        lifecycle.ingest_block(connection, storage, broken.folder)
    connection.commit()
    assert rows(connection) == dict.fromkeys(TABLES, 0)
    assert not (storage.folder / "chips").exists()

    mended = make_block(tmp_path / "mended")
    lifecycle.ingest_block(connection, storage, mended.folder)
    connection.commit()
    assert rows(connection) == {"block": 1, "image": 3, "chip_file": 1, "point": 40, "view": 240}


def test_a_block_that_changes_while_it_is_ingested_is_refused(connection, storage, tmp_path):
    made = make_block(tmp_path / "block")

    def change(fraction: float, message: str) -> None:
        if message == "storing chips":
            changed_chip(made.folder)

    with pytest.raises(FormatError, match=r"chips/0000\.npy: sha256"):
        lifecycle.ingest_block(connection, storage, made.folder, change)
    connection.rollback()
    assert rows(connection) == dict.fromkeys(TABLES, 0)
    assert not (storage.folder / "chips").exists()


@pytest.fixture
def own(open_folder):
    """A cluster of this test alone, without fsync: writes of a killed process survive all the same."""
    return Cluster(open_folder / uuid4().hex[:8], durable=False)


def kill(cluster: Cluster) -> None:
    """Send SIGKILL to the server and its processes, and wait until they are gone."""
    server = int((cluster.data / "postmaster.pid").read_text().splitlines()[0])
    processes = [server, *children(server)]
    assert len(processes) > 2
    for process in processes:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    deadline = time.monotonic() + PATIENCE_S
    while any(alive(process) for process in processes):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def children(parent: int) -> list[int]:
    pids = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rsplit(")", 1)[1].split()
        except (OSError, IndexError):
            continue
        if int(fields[1]) == parent:
            pids.append(int(stat.parent.name))
    return pids


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def wait_until_rows_arrive(dsn: str, table: str) -> None:
    """Wait until the server is in the middle of a COPY into the table."""
    deadline = time.monotonic() + PATIENCE_S
    with psycopg.connect(dsn, autocommit=True) as watcher:
        while True:
            progress = watcher.execute(
                "select tuples_processed from pg_stat_progress_copy where relid = %s::regclass", [table]
            ).fetchone()
            if progress and progress[0] > 0:
                return
            assert time.monotonic() < deadline, f"no row of {table} arrived"
            time.sleep(0.01)


@pytest.mark.parametrize("table", ["point", "view"])
def test_postgresql_killed_in_the_middle_of_an_ingestion_leaves_nothing(
    own, tmp_path, monkeypatch, table
):
    made = make_block(tmp_path / "block", count=2000, n_images=2, gsds_m=(2.0,), dtype=np.uint8)
    storage = Storage(tmp_path / "storage")
    monkeypatch.setattr(binary_copy, "ROWS_AT_ONCE", 100)
    killed = []

    with own.lease() as dsn:
        revisions.upgrade(dsn)

        def kill_halfway(fraction: float, message: str) -> None:
            started = message == f"loading rows of table {table}"
            if started and fraction > halfway[table] and not killed:
                wait_until_rows_arrive(dsn, table)
                kill(own)
                killed.append(fraction)

        halfway = {"point": 0.68, "view": 0.88}
        with pytest.raises(psycopg.OperationalError), engine.connect(dsn) as connection:
            lifecycle.ingest_block(connection, storage, made.folder, kill_halfway)
        assert killed

    with own.lease() as dsn:
        with engine.connect(dsn) as connection:
            assert rows(connection) == dict.fromkeys(TABLES, 0)
            assert run_sql(connection, "select from block").fetchall() == []
        with engine.connect(dsn) as connection:
            lifecycle.ingest_block(connection, storage, made.folder)
            lifecycle.publish_block(connection, "calanques")
        with engine.connect(dsn) as connection:
            assert rows(connection) == {
                "block": 1,
                "image": 2,
                "chip_file": 1,
                "point": 2000,
                "view": 4000,
            }
            assert read_gauges(connection).points == 2000
            assert remove_unnamed_chips(connection, Bin(storage)) == []


def test_postgresql_killed_before_the_commit_leaves_nothing(own, tmp_path):
    made = make_block(tmp_path / "block")
    storage = Storage(tmp_path / "storage")

    def ingest_and_kill(dsn: str) -> None:
        with engine.connect(dsn) as connection:
            lifecycle.ingest_block(connection, storage, made.folder)
            kill(own)

    with own.lease() as dsn:
        revisions.upgrade(dsn)
        with pytest.raises(psycopg.OperationalError):
            ingest_and_kill(dsn)

    with own.lease() as dsn, engine.connect(dsn) as connection:
        assert rows(connection) == dict.fromkeys(TABLES, 0)
        assert len(storage.keys("chips")) == 1
        assert len(remove_unnamed_chips(connection, Bin(storage))) == 1


SERVED = """
select b.id, b.version, b.state, count(p.id) filter (where p.superseded_by is null) as served
from block b join point p on p.block_number = b.number group by b.number order by b.number
"""


def test_postgresql_killed_before_the_commit_of_a_publication_leaves_what_was_served(own, tmp_path):
    """The new version withdraws the old one and takes the places of another block, or nothing of it."""
    versions = (("coast", "1", 0), ("hills", "1", 1), ("coast", "2", 2))
    made = [
        make_block(tmp_path / f"{name}-{version}", name=name, version=version).folder
        for name, version, _ in versions
    ]
    storage = Storage(tmp_path / "storage")

    def served(connection) -> list[dict]:
        return run_sql(connection, SERVED).fetchall()

    def publish_and_kill(dsn: str) -> None:
        with engine.connect(dsn) as connection:
            lifecycle.publish_block(connection, "coast@2")
            assert served(connection) != before
            kill(own)

    with own.lease() as dsn:
        revisions.upgrade(dsn)
        with engine.connect(dsn) as connection:
            for folder, (_, _, priority) in zip(made, versions, strict=True):
                lifecycle.ingest_block(connection, storage, folder, priority=priority)
            lifecycle.publish_block(connection, "coast@1")
            lifecycle.publish_block(connection, "hills")
            before = served(connection)
        with pytest.raises(psycopg.OperationalError):
            publish_and_kill(dsn)

    with own.lease() as dsn, engine.connect(dsn) as connection:
        assert served(connection) == before
        lifecycle.publish_block(connection, "coast@2")
        after = served(connection)
    assert [row["state"] for row in before] == ["published", "published", "staged"]
    assert [row["state"] for row in after] == ["withdrawn", "published", "published"]
    assert before[1]["served"] > 0 == after[1]["served"], "the new version takes all places"
