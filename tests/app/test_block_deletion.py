"""A block that is deleted: its rows and chips go, and nothing that others need."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event
from uuid import UUID, uuid4

import pytest

from amers.app.config import Settings
from amers.app.db import engine, history
from amers.app.db.engine import Connection, Database
from amers.app.errors import Conflict, NotFound
from amers.app.storage import Marker, Storage, trash, write_marker
from amers.app.usecases import storage_identity
from amers.app.usecases.blocks import lifecycle
from amers.app.usecases.blocks.deletion import delete_block
from amers.app.usecases.history import list_histories, suspend_point
from amers.app.usecases.installation import Installation
from amers.app.worker.sweep import sweep_files
from tests.factories import MadeBlock, make_block
from tests.statements import run_sql

OF_BLOCKS = (
    "block",
    "image",
    "chip_file",
    "point",
    "view",
    "point_history",
    "view_history",
    "density_cell",
)
JOB_S = 3600.0
points_of_a_block = 40


@pytest.fixture
def installation(database: Database, storage: Storage, settings: Settings) -> Installation:
    assert storage_identity.prepare(database.transaction, storage) is None
    return Installation(database, storage, settings)


@pytest.fixture
def withdrawn(installation: Installation, tmp_path: Path) -> MadeBlock:
    """A block that was published and withdrawn."""
    return ingested(installation, make_block(tmp_path / "block"), "published", "withdrawn")


def ingested(installation: Installation, made: MadeBlock, *states: str) -> MadeBlock:
    """A block of the store that goes through some states."""
    steps = {"published": lifecycle.publish_block, "withdrawn": lifecycle.withdraw_block}
    with installation.database.transaction() as connection:
        lifecycle.ingest_block(connection, installation.storage, made.folder)
        for state in states:
            steps[state](connection, f"{made.metadata.id}@{made.metadata.version}")
    return made


def rows_left(database: Database) -> dict[str, int]:
    """The tables of blocks that have rows, with their numbers of rows."""
    with database.reading() as connection:
        counts = {name: count(connection, name) for name in OF_BLOCKS}
    return {name: number for name, number in counts.items() if number}


def count(connection: Connection, table: str) -> int:
    (row,) = run_sql(connection, f"select count(*) as n from {table}").fetchall()
    return int(row["n"])


def test_a_withdrawn_block_leaves_no_row_and_its_chips_in_the_trash(
    installation: Installation, withdrawn: MadeBlock
):
    chips = installation.storage.keys("chips")
    deleted = delete_block(installation, "calanques@1")
    assert (deleted.block.id, deleted.block.state) == ("calanques", "withdrawn")
    assert (deleted.n_files, deleted.n_shared_files) == (len(chips), 0)
    assert rows_left(installation.database) == {}
    assert installation.storage.keys("chips") == []
    assert [key for keys in trash.batches(installation.storage).values() for key in keys] == chips


def test_a_block_that_was_never_published_is_deleted_too(installation: Installation, tmp_path: Path):
    ingested(installation, make_block(tmp_path / "block"))
    delete_block(installation, "calanques@1")
    assert rows_left(installation.database) == {}


def test_chips_that_another_block_shares_stay_and_are_served(
    installation: Installation, withdrawn: MadeBlock, tmp_path: Path
):
    """The other version has the same points and the same files of chips."""
    ingested(installation, make_block(tmp_path / "newer", version="2"), "published")
    chips = installation.storage.keys("chips")
    deleted = delete_block(installation, "calanques@1")
    assert (deleted.n_files, deleted.n_shared_files) == (0, len(chips))
    assert installation.storage.keys("chips") == chips
    left = rows_left(installation.database)
    assert (left["block"], left["point"]) == (1, points_of_a_block)


def test_the_histories_of_other_blocks_stay(
    installation: Installation, withdrawn: MadeBlock, tmp_path: Path
):
    newer = ingested(installation, make_block(tmp_path / "newer", seed=2, version="2"), "published")
    first_ids = {number: number * 2**26 + int(newer.points.id[0]) for number in (1, 2)}
    with installation.database.transaction() as connection:
        for point_id in first_ids.values():
            suspend_point(connection, point_id, "construction site")
    delete_block(installation, "calanques@1")
    with installation.database.reading() as connection:
        assert [point.id for point in list_histories(connection, "suspended")] == [first_ids[2]]
    assert rows_left(installation.database)["point_history"] == 1


def test_the_histories_of_views_go_with_their_block_alone(
    installation: Installation, withdrawn: MadeBlock, tmp_path: Path
):
    ingested(installation, make_block(tmp_path / "newer", seed=2, version="2"), "published")
    with installation.database.transaction() as connection:
        for number in (1, 2):
            run_sql(
                connection,
                "insert into view_history (point_id, view, attempts, successes, expected)"
                " select id, 0, 1, 1, 1 from point where block_number = %s",
                [number],
            )
    delete_block(installation, "calanques@1")
    with installation.database.reading() as connection:
        left = run_sql(
            connection, "select count(*) as n, min(point_id >> 26) as number from view_history"
        ).fetchone()
    assert left == {"n": points_of_a_block, "number": 2}


def test_a_registration_that_ends_after_the_deletion_leaves_its_measures_and_no_history(
    installation: Installation, withdrawn: MadeBlock
):
    point_id = 2**26 + int(withdrawn.points.id[0])
    delete_block(installation, "calanques@1")
    with installation.database.transaction() as connection:
        registration = registered_at(connection, point_id)
        history.count_registration(connection, registration)
    assert rows_left(installation.database) == {}
    with installation.database.reading() as connection:
        measures = run_sql(connection, "select point_id from measure").fetchall()
    assert measures == [{"point_id": point_id}]


def registered_at(connection: Connection, point_id: int) -> UUID:
    """A registration with one active point."""
    (row,) = run_sql(
        connection,
        """insert into registration (id, block_versions, options, report, verdict, files)
            values (gen_random_uuid(), '[]', '{}', '{}', 'good', '{}') returning id""",
    ).fetchall()
    registration: UUID = row["id"]
    measure = "insert into measure (registration_id, point_id, matched, active, reason)"
    run_sql(connection, f"{measure} values (%s, %s, true, true, '')", [registration, point_id])
    view = "insert into view_measure (registration_id, point_id, view, agreed, reason)"
    run_sql(connection, f"{view} values (%s, %s, 0, true, '')", [registration, point_id])
    return registration


def test_a_published_block_is_not_deleted(installation: Installation, tmp_path: Path):
    ingested(installation, make_block(tmp_path / "block"), "published")
    before = rows_left(installation.database)
    with pytest.raises(Conflict, match="calanques@1 is published: withdraw it before"):
        delete_block(installation, "calanques@1")
    assert rows_left(installation.database) == before


@pytest.mark.parametrize("reference", ["calanques", "1"])
def test_a_block_is_deleted_by_its_full_name_only(
    installation: Installation, withdrawn: MadeBlock, reference: str
):
    before = rows_left(installation.database)
    with pytest.raises(Conflict, match=f"block {reference} is calanques@1: name it so"):
        delete_block(installation, reference)
    with pytest.raises(NotFound):
        delete_block(installation, "calanques@2")
    assert rows_left(installation.database) == before


def test_the_storage_of_another_installation_loses_nothing(
    installation: Installation, withdrawn: MadeBlock
):
    before, chips = rows_left(installation.database), installation.storage.keys("chips")
    write_marker(installation.storage, Marker(uuid4(), 0))
    with pytest.raises(Conflict, match="amers store adopt"):
        delete_block(installation, "calanques@1")
    assert rows_left(installation.database) == before
    assert installation.storage.keys("chips") == chips


@pytest.mark.thorough
def test_no_block_is_deleted_while_one_is_ingested(
    installation: Installation, withdrawn: MadeBlock, tmp_path: Path, dsn: str
):
    """The one that is being ingested may use the files of the other."""
    other = make_block(tmp_path / "other", name="other")
    with engine.connect(dsn) as ingesting:
        lifecycle.ingest_block(ingesting, installation.storage, other.folder)
        with pytest.raises(Conflict, match="a block is being ingested"):
            delete_block(installation, "calanques@1")
    delete_block(installation, "calanques@1")
    assert rows_left(installation.database)["point"] == points_of_a_block


@dataclass(frozen=True)
class BusyDatabase(Database):
    """A database in which somebody else does something between the first transaction and the second."""

    meanwhile: Callable[[], None]
    begun: list[int] = field(default_factory=list)

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        self.begun.append(1)
        if len(self.begun) == 2:
            self.meanwhile()
        with super().transaction() as connection:
            yield connection


def test_a_block_that_is_ingested_between_the_rows_and_the_files_keeps_its_chips(
    installation: Installation, withdrawn: MadeBlock, tmp_path: Path
):
    """It finds the files of the deleted block in the storage, and does not store them again."""
    newer = make_block(tmp_path / "newer", version="2")
    chips, loaded, deleted = installation.storage.keys("chips"), Event(), Event()

    def ingest() -> None:
        with installation.database.transaction() as connection:
            lifecycle.ingest_block(connection, installation.storage, newer.folder)
            loaded.set()
            deleted.wait(0.5)

    with ThreadPoolExecutor(1) as threads:

        def meanwhile() -> None:
            threads.submit(ingest)
            assert loaded.wait(30.0)

        busy = BusyDatabase(**vars(installation.database), meanwhile=meanwhile)
        delete_block(replace(installation, database=busy), "calanques@1")
        deleted.set()
    assert rows_left(installation.database)["point"] == points_of_a_block
    assert installation.storage.keys("chips") == chips


def test_the_sweep_removes_the_chips_of_a_deletion_that_was_interrupted(
    installation: Installation, withdrawn: MadeBlock, monkeypatch: pytest.MonkeyPatch
):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(trash, "discard", interrupted)
        with pytest.raises(KeyboardInterrupt):
            delete_block(installation, "calanques@1")
    assert rows_left(installation.database) == {}
    assert installation.storage.keys("chips") != []
    sweep_files(installation.database, installation.storage, JOB_S)
    assert installation.storage.keys("chips") == []


def test_the_version_is_ingested_again_after_its_deletion(
    installation: Installation, withdrawn: MadeBlock
):
    delete_block(installation, "calanques@1")
    ingested(installation, withdrawn, "published")
    left = rows_left(installation.database)
    assert (left["block"], left["point"]) == (1, points_of_a_block)


def test_an_administrator_deletes_a_block_over_the_api_and_the_audit_trail_names_him(
    installation: Installation, withdrawn: MadeBlock, bearer: Callable[[str], dict]
):
    administrator = bearer("admin")
    assert bearer("register").delete("/blocks/calanques@1").status_code == 403
    reply = administrator.delete("/blocks/calanques@1")
    assert reply.status_code == 200, reply.text
    assert reply.json()["block"]["state"] == "withdrawn"
    assert reply.json()["n_files"] > 0
    assert administrator.get("/collections/blocks/items/1").status_code == 404
    assert administrator.delete("/blocks/calanques@1").status_code == 404
    query = "/audit?kind=block&subject=calanques@1&limit=1"
    [change] = administrator.get(query).json()["changes"]
    assert (change["action"], change["actor_name"]) == ("deleted", "a token to admin")
    assert change["before"]["n_points"] == points_of_a_block
