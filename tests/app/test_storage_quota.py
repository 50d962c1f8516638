"""One quota over everything that a token keeps in the storage, in a folder and in a bucket."""

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from uuid import UUID

import psycopg
import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from amers.app.cli.main import app
from amers.app.config import Settings
from amers.app.db import engine, usage
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts, jobs
from amers.app.db.tokens import Token
from amers.app.errors import TooLarge, TooMany
from amers.app.storage import Storage
from amers.app.usecases import quotas, results, storage_identity
from amers.app.usecases.installation import Installation
from amers.app.usecases.scenes import SentFile, upload_scene, upload_side_file
from amers.app.usecases.tokens import create_token
from tests.app.callers import Caller
from tests.app.job_queue import claim
from tests.app.ledger import bytes_in_ledger, bytes_in_storage, job_runner, make_token
from tests.app.s3_server import running_bucket
from tests.app.sending import TUS, begun, whole, zipped
from tests.app.served import serve_block
from tests.factories import BOX, make_block

TIFF = b"II*\0" + bytes(996)
PATIENCE_S = 30.0
in_both = pytest.mark.parametrize("settings", ["folder", "bucket"], indirect=True)


@pytest.fixture
def settings(
    request: pytest.FixtureRequest, dsn: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Settings]:
    own = Settings(
        database_url=dsn, data_folder=tmp_path / "data", quota_open_uploads=2, quota_kept_jobs=2
    )
    if getattr(request, "param", "folder") == "folder":
        yield own
    else:
        with running_bucket(monkeypatch) as url:
            yield own.model_copy(update={"storage_url": url})


@pytest.fixture
def storage(settings: Settings, database: Database) -> Storage:
    return storage_identity.opened(database, settings)


@pytest.fixture
def published(connection: Connection, storage: Storage, tmp_path: Path) -> None:
    """A published block, whose points can be exported."""
    serve_block(connection, storage, make_block(tmp_path / "block").folder)
    connection.commit()


def used_bytes(me: Caller, dsn: str) -> int:
    """What the ledger counts for a caller."""
    owner = UUID(me.get("/tokens/self").json()["id"])
    with engine.connect(dsn) as connection:
        return usage.read_usage(connection, owner).total_bytes


@pytest.mark.thorough
@in_both
def test_a_token_with_a_quota_of_one_byte_leaves_nothing_by_any_way(
    client: TestClient,
    admin: Caller,
    storage: Storage,
    settings: Settings,
    database: Database,
    published: None,
):
    me = make_token(client, admin, storage_quota_bytes=1)
    for body in (TIFF, iter([TIFF[:500], TIFF[500:]])):
        refused = me.post("/scenes?name=a.tif", content=body)
        assert refused.status_code == 413, refused.text
    assert begun(me, 1000, filename="a.tif").status_code == 413
    scene = admin.scene(TIFF, "name=a.tif")
    side_file = me.put(f"/scenes/{scene}/files/a_RPC.TXT", content=b"x" * 10)
    assert side_file.status_code == 404, "the scene belongs to another token"
    assert admin.delete(f"/scenes/{scene}").status_code == 204

    export = job_runner(client, database, settings, me)("export-block", bbox=BOX)
    assert (export["status"], export["error"]["error"]) == ("failed", "TooLarge")
    assert "of 1 bytes are used" in export["error"]["detail"]

    assert begun(me, 1, filename="a.tif").status_code == 201
    full = me.execute("export-block", {"bbox": BOX})
    assert full.status_code == 413, "the quota is full before the job begins"
    assert bytes_in_storage(storage) == 0


@in_both
def test_an_archive_counts_unpacked_and_is_refused_before_it_is_unpacked(
    client: TestClient, admin: Caller, storage: Storage, dsn: str
):
    archive = zipped({"a.tif": TIFF[:4] + bytes(200_000), "a_RPC.TXT": b"x" * 100})
    assert len(archive) < 2000
    me = make_token(client, admin, storage_quota_bytes=100_000)
    refused = whole(me, archive, filename="a.zip")
    assert refused.status_code == 413
    assert "unpacked to 200" in refused.json()["detail"]
    assert (bytes_in_storage(storage), used_bytes(me, dsn)) == (0, 0)
    roomy = make_token(client, admin, storage_quota_bytes=200_200)
    assert whole(roomy, archive, filename="a.zip").status_code == 204
    assert used_bytes(roomy, dsn) == bytes_in_storage(storage) == 200_104


def test_files_beside_a_scene_count_for_its_owner(
    client: TestClient, admin: Caller, storage: Storage, dsn: str
):
    me = make_token(client, admin, storage_quota_bytes=1500)
    scene = me.scene(TIFF, "name=a.tif")
    for size, status in ((400, 200), (450, 413), (100, 200), (390, 200)):
        beside = me.put(f"/scenes/{scene}/files/a_RPC.TXT", content=b"x" * size)
        assert beside.status_code == status, (size, beside.text)
    assert used_bytes(me, dsn) == 1390
    for chunks in ([b"x" * 60, b"x" * 60], [b"x" * 50]):
        chunked = me.put(f"/scenes/{scene}/files/b_RPC.TXT", content=iter(chunks))
    assert chunked.status_code == 200
    by_admin = admin.put(f"/scenes/{scene}/files/c_RPC.TXT", content=b"x" * 100)
    assert by_admin.status_code == 413, "the bytes count for the owner, whoever sends them"
    by_admin = begun(admin, 100, filename="c_RPC.TXT", scene=scene)
    assert by_admin.status_code == 413, "however they are sent"
    assert used_bytes(me, dsn) == bytes_in_storage(storage) == 1440


def test_a_scene_has_no_more_side_files_than_allowed(admin: Caller, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("amers.app.usecases.scenes.MOST_SIDE_FILES", 2)
    scene = admin.scene(TIFF, "name=a.tif")
    statuses = [
        admin.put(f"/scenes/{scene}/files/{name}.txt", content=b"").status_code
        for name in ("a", "b", "c", "a")
    ]
    assert statuses == [200, 200, 429, 200]


def test_a_token_has_no_more_open_uploads_than_allowed(client: TestClient, admin: Caller):
    me = make_token(client, admin)
    statuses = [begun(me, 10, filename="a.tif").status_code for _ in range(3)]
    assert statuses == [201, 201, 429]
    url = begun(admin, 10, filename="a.tif").headers["location"]
    assert (admin | TUS).delete(url).status_code == 204, "others are not affected"


def test_a_token_keeps_no_more_jobs_than_allowed_and_can_remove_them(client: TestClient, admin: Caller):
    me = make_token(client, admin)

    def ask():
        return me.execute("export-block", {"bbox": BOX})

    made = [ask().headers["location"] for _ in range(2)]
    for url in made:
        assert me.delete(url).json()["status"] == "dismissed"
    refused = ask()
    assert refused.status_code == 429
    assert "DELETE /jobs/ID" in refused.json()["detail"]
    assert me.delete(made[0]).json()["status"] == "dismissed"
    assert me.get(made[0]).status_code == 404
    assert ask().status_code == 201


def test_inputs_of_a_job_have_a_limit(admin: Caller):
    inputs = {"bbox": BOX, "title": "x" * 70_000}
    refused = admin.execute("export-block", inputs)
    assert refused.status_code == 422
    assert "at most 65536 expected" in refused.json()["detail"]


def test_bodies_without_a_length_cannot_exceed_the_quota_together(
    settings: Settings, database: Database, storage: Storage
):
    installation = Installation(database, storage, settings)
    with database.transaction() as connection:
        me = create_token(connection, "me", ["register"], storage_quota_bytes=2000).token
    scene = upload_scene(installation, me, SentFile("a.tif", [TIFF], len(TIFF)))
    arrived, go_on = threading.Event(), threading.Event()

    def slow() -> Iterator[bytes]:
        yield TIFF[:100]
        arrived.set()
        assert go_on.wait(PATIENCE_S)
        yield TIFF[100:400]

    first = threading.Thread(
        target=upload_side_file, args=(installation, me, scene.id, SentFile("b.txt", slow()))
    )
    first.start()
    try:
        assert arrived.wait(PATIENCE_S)
        with pytest.raises(TooLarge, match="exceeds the storage quota of token me: 2000 of 2000 bytes"):
            upload_scene(installation, me, SentFile("c.tif", [TIFF]))
        with pytest.raises(TooLarge):
            upload_side_file(installation, me, scene.id, SentFile("d.txt", [b"x"], 1))
    finally:
        go_on.set()
        first.join()
    with database.transaction() as connection:
        assert usage.read_usage(connection, me.id).total_bytes == bytes_in_storage(storage) == 1400


def test_results_of_jobs_at_the_same_time_cannot_exceed_the_quota_together(
    settings: Settings, database: Database
):
    with database.transaction() as connection:
        me = create_token(connection, "me", ["register"], storage_quota_bytes=1000).token
        made = [jobs.create(connection, "register-scene", {}, me.id) for _ in range(2)]
    with database.transaction() as connection:
        first, second = (claim(connection, job.id) for job in made if job is not None)
    assert first is not None
    assert second is not None
    outcomes: list[str] = []
    together = threading.Barrier(2)

    def reserve(job: jobs.Job) -> None:
        together.wait(PATIENCE_S)
        try:
            with database.transaction() as connection:
                quotas.reserve_results(connection, settings, job, 600)
            outcomes.append("reserved")
        except TooLarge:
            outcomes.append("refused")

    threads = [threading.Thread(target=reserve, args=(job,)) for job in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(outcomes) == ["refused", "reserved"]


@pytest.mark.parametrize("counted", ["bytes", "uploads", "jobs"])
def test_what_a_token_reserves_is_counted_after_what_it_reserves_at_once(
    settings: Settings, database: Database, counted: str
):
    with database.transaction() as connection:
        me, other = (create_token(connection, name, ["register"]).token for name in ("me", "other"))

    def count(connection: Connection, token: Token) -> None:
        if counted == "bytes":
            quotas.require_room(connection, settings, token.id, "the image", 1)
        elif counted == "uploads":
            quotas.require_free_upload(connection, settings, token.id)
        else:
            quotas.require_free_job(connection, settings, token)

    with database.transaction() as first:
        count(first, me)
        with database.transaction() as second:
            engine.limit_lock_wait(second, 0.1)
            count(second, other)
        with database.transaction() as second:
            engine.limit_lock_wait(second, 0.1)
            with pytest.raises(psycopg.errors.LockNotAvailable):
                count(second, me)
            second.rollback()
    with database.transaction() as second:
        count(second, me)


def test_a_token_may_fill_its_own_quota_to_the_last_byte_and_a_quota_of_nothing_allows_nothing(
    settings: Settings, connection: Connection
):
    """The quotas of the settings are large: they are not those of these tokens."""
    some = create_token(connection, "some", ["register"], storage_quota_bytes=100, job_quota=1).token
    none = create_token(connection, "none", ["register"], storage_quota_bytes=0, job_quota=0).token
    one = create_token(connection, "one", ["register"], storage_quota_bytes=1, job_quota=1).token
    for owner, size_bytes in ((some, 100), (some, None), (one, 1), (one, None)):
        room = quotas.require_room(connection, settings, owner.id, "the image", size_bytes)
        assert room == quotas.room_left(connection, settings, owner.id) == owner.storage_quota_bytes
    quotas.require_free_job(connection, settings, some)
    for owner, size_bytes in ((some, 101), (one, 2), (none, 1), (none, None)):
        with pytest.raises(TooLarge, match=f"of {owner.storage_quota_bytes} bytes"):
            quotas.require_room(connection, settings, owner.id, "the image", size_bytes)
    assert quotas.room_left(connection, settings, none.id) == 0
    with pytest.raises(TooMany, match="0 open jobs of 0 allowed"):
        quotas.require_free_job(connection, settings, none)


@pytest.mark.thorough
@in_both
def test_an_owner_removes_the_results_of_a_job_and_the_history_stays(
    client: TestClient,
    admin: Caller,
    storage: Storage,
    settings: Settings,
    database: Database,
    published: None,
    dsn: str,
):
    me = make_token(client, admin)
    job = job_runner(client, database, settings, me)("export-block", bbox=BOX)
    assert job["status"] == "successful", job
    here = f"/jobs/{job['jobID']}"
    assert used_bytes(me, dsn) == bytes_in_storage(storage) > 1000
    stranger = make_token(client, admin)
    assert stranger.delete(here).status_code == 404
    assert me.delete(here).json()["status"] == "dismissed"
    assert me.get(here).status_code == 404
    assert used_bytes(me, dsn) == bytes_in_storage(storage) == 0
    record = admin.get("/audit", params={"subject": job["jobID"]}).json()["changes"]
    assert record[0]["action"] == "deleted"


def test_an_attempt_that_is_lost_gives_its_room_back(
    settings: Settings, database: Database, storage: Storage
):
    with database.transaction() as connection:
        me = create_token(connection, "me", ["register"]).token
        made = [jobs.create(connection, "register-scene", {}, me.id) for _ in range(3)]
    for ending, job in zip(("fail", "dismiss", "succeed"), made, strict=True):
        assert job is not None
        with database.transaction() as connection:
            attempt = claim(connection, job.id)
            assert attempt is not None
            quotas.reserve_results(connection, settings, attempt, 100)
        storage.put(f"results/{job.id}/1/a", [bytes(100)])
        with database.transaction() as connection:
            if ending == "fail":
                attempts.fail(connection, job.id, 1, {"title": "x"})
            elif ending == "dismiss":
                jobs.dismiss(connection, job.id)
            else:
                attempts.succeed(connection, job.id, 1, {"files": {"a": f"results/{job.id}/1/a"}})
    assert bytes_in_storage(storage) == 300
    results.reconcile_results(database, storage)
    with database.transaction() as connection:
        assert usage.read_usage(connection, me.id).result_bytes == bytes_in_storage(storage) == 100


@pytest.mark.thorough
@in_both
def test_the_ledger_equals_the_storage_after_a_mixed_run(
    client: TestClient,
    admin: Caller,
    storage: Storage,
    settings: Settings,
    database: Database,
    published: None,
    dsn: str,
):
    callers = [make_token(client, admin), make_token(client, admin, storage_quota_bytes=150_000)]
    for me in callers:
        kept, removed = (me.scene(body, "name=a.tif") for body in (TIFF, iter([TIFF, b"more"])))
        for scene in (kept, removed):
            for content in (b"x" * 300, b"x" * 200):
                me.put(f"/scenes/{scene}/files/a_RPC.TXT", content=content)
        assert whole(me, b"x" * 50, filename="b_RPC.TXT", scene=kept).status_code == 204
        assert whole(me, TIFF, filename="b.tif").status_code == 204
        archive = zipped({"c.tif": TIFF + bytes(9000), "c_RPC.TXT": b"x"})
        assert whole(me, archive, filename="c.zip").status_code == 204
        assert me.post("/scenes?name=a.tif", content=b"no image").status_code == 422
        assert me.delete(f"/scenes/{removed}").status_code == 204
        run = job_runner(client, database, settings, me)
        run("export-block", bbox=BOX)
        run("export-block", bbox=(50.0, 43.0, 51.0, 44.0))
    archive = zipped({"block.json": b"{}"})
    assert admin.put("/blocks/uploads/b.zip", content=archive).status_code < 300
    assert admin.put("/blocks/uploads/b.zip", content=iter([archive])).status_code < 300
    with engine.connect(dsn) as connection:
        assert bytes_in_ledger(connection) == bytes_in_storage(storage)
        held = {one.owner: one for one in usage.read_all_usage(connection)}
    roomy, small = (held[UUID(me.get("/tokens/self").json()["id"])] for me in callers)
    assert (roomy.scenes, roomy.jobs, roomy.open_uploads) == (3, 2, 0)
    assert roomy.scene_bytes == small.scene_bytes == 1000 + 200 + 50 + 1000 + 10_000 + 1
    assert roomy.result_bytes > 150_000
    assert small.result_bytes == 0


@in_both
def test_usage_is_shown_to_callers_administrators_and_operators(
    client: TestClient,
    admin: Caller,
    storage: Storage,
    settings: Settings,
    database: Database,
    published: None,
    monkeypatch: pytest.MonkeyPatch,
):
    me = make_token(client, admin, storage_quota_bytes=4000)
    assert me.post("/scenes?name=a.tif", content=TIFF).status_code == 201
    assert begun(me, 600, filename="b.tif").status_code == 201
    (chips,) = storage.keys("chips")
    stray = storage.put(f"scenes/{UUID(int=1)}/stray.tif", [bytes(70)])
    stray_chips = storage.put(f"chips/{'0' * 64}.npy", [bytes(5)])
    storage.put("trash/2026-01-01_1h/scenes/a", [bytes(30)])
    own = me.get("/tokens/self/usage").json()
    assert (own["scenes"], own["open_uploads"], own["total_bytes"], own["share"]) == (2, 1, 1600, 0.4)
    assert me.get("/tokens/usage").status_code == 403
    assert admin.get("/tokens/usage").json()["owners"] == [own]

    assert settings.database_url is not None
    monkeypatch.setenv("AMERS_DATABASE_URL", settings.database_url.get_secret_value())
    monkeypatch.setenv("AMERS_DATA_FOLDER", str(settings.data_folder))
    if settings.storage_url is not None:
        monkeypatch.setenv("AMERS_STORAGE_URL", settings.storage_url)
    shown = CliRunner().invoke(app, ["store", "usage", "--json"])
    assert shown.exit_code == 0, shown.output
    document = json.loads(shown.stdout)
    assert document["owners"] == [own]
    unowned = {row["what"]: (row["files"], row["total_bytes"]) for row in document["unowned"]}
    assert unowned == {
        "chips of blocks": (1, storage.size(chips)),
        "trash": (1, 30),
        "unfinished": (1, 0),
        "no row": (2, stray.size_bytes + stray_chips.size_bytes),
    }
    table = CliRunner().invoke(app, ["store", "usage"]).stdout
    assert f"{own['name']}\t2\t1\t0\t0 B\t1.6 KiB\t3.9 KiB\t40.0%" in table
    assert table.splitlines()[-1].startswith("total")
