"""Uploads of scenes: limits, checks, privacy; and removal of scenes."""

import hashlib
import os
import socket
from base64 import b64encode
from collections.abc import Callable, Iterator
from pathlib import Path
from uuid import UUID

import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from amers.app.config import Settings
from amers.app.db import engine, scenes, usage
from amers.app.db.engine import Connection, Database
from amers.app.errors import InputError, TooLarge
from amers.app.main import create_app
from amers.app.storage import KEY, Storage
from amers.app.usecases.installation import Installation
from amers.app.usecases.scenes import SentFile, clean_name, folder_of, upload_scene
from amers.app.usecases.tokens import create_token
from amers.app.worker.sweep import sweep_files
from tests.app.callers import Bearer, Caller
from tests.app.conftest import stored_files
from tests.app.running_service import running_service
from tests.app.sending import begun
from tests.app.worker_processes import wait_until
from tests.statements import run_in, run_sql

TIFF = b"II*\0" + bytes(100_000)
LIMIT_BYTES = 200_000


@pytest.fixture
def settings(dsn: str, tmp_path: Path) -> Settings:
    """An installation with a small limit of uploads."""
    return Settings(database_url=dsn, data_folder=tmp_path / "data", upload_limit_bytes=LIMIT_BYTES)


def chunks(data: bytes) -> Iterator[bytes]:
    """A body of unknown length."""
    for start in range(0, len(data), 10_000):
        yield data[start : start + 10_000]


def test_pages_of_scenes_have_every_scene_once(me: Caller, bearer: Bearer, connection: Connection):
    """Two scenes of the same instant fall on different pages, and a new one on none of those to come."""
    mine = {me.scene(TIFF[:9]) for _ in range(5)}
    foreign = bearer("register").scene(TIFF[:9])
    run_sql(connection, "update scene set created_at = date_trunc('day', created_at)")
    connection.commit()
    pages, path = [], "/scenes?limit=2"
    while path:
        page = me.get(path).json()
        pages.append([scene["id"] for scene in page["scenes"]])
        following = [link["href"] for link in page["links"] if link["rel"] == "next"]
        path = following[0] if following else ""
        assert not path or "limit=2" in path
        me.scene(TIFF[:9])
    assert [len(page) for page in pages] == [2, 2, 1]
    assert pages[0] + pages[1] + pages[2] == sorted(mine, reverse=True)
    assert me.get(f"/scenes?after={foreign}").status_code == 404
    assert me.get("/scenes?after=scene").status_code == 400


def test_an_uploaded_scene_is_stored_as_it_was_sent(me: Caller, storage: Storage):
    reply = me.post("/scenes?name=IMG_1.TIF&sigma_m=12.5", content=TIFF)
    assert reply.status_code == 201, reply.text
    scene = reply.json()
    assert (scene["state"], scene["file"], scene["sigma_m"]) == ("uploaded", "IMG_1.TIF", 12.5)
    assert (scene["size_bytes"], scene["sha256"]) == (len(TIFF), hashlib.sha256(TIFF).hexdigest())
    assert me.get(reply.headers["location"]).json() == scene
    assert me.get("/scenes").json()["scenes"] == [scene]
    assert storage.path(f"scenes/{scene['id']}/IMG_1.TIF").read_bytes() == TIFF


def test_the_name_may_come_from_the_content_disposition(client: TestClient, bearer: Bearer):
    header = {"Content-Disposition": "attachment; filename*=UTF-8''sc%C3%A8ne%201.tif"}
    reply = client.post("/scenes", content=TIFF, headers=bearer("register") | header)
    assert (reply.json()["name"], reply.json()["file"]) == ("scène 1.tif", "scene_1.tif")


def test_a_model_is_laid_beside_the_image(me: Caller, storage: Storage):
    scene = me.post("/scenes?name=a.tif", content=TIFF).json()
    reply = me.put(f"/scenes/{scene['id']}/files/a_RPC.TXT", content=b"LINE_OFF: 1")
    assert reply.status_code == 200, reply.text
    assert me.get(f"/scenes/{scene['id']}").json()["models"] == ["a_RPC.TXT"]
    assert storage.path(f"scenes/{scene['id']}/a_RPC.TXT").read_bytes() == b"LINE_OFF: 1"


@pytest.mark.parametrize(
    ("name", "status"), [("a.tif", 409), ("a.vrt", 422), ("a.aux.xml.sh", 422), ("...", 422)]
)
def test_only_models_are_laid_beside_an_image(me: Caller, name: str, status: int):
    scene = me.post("/scenes?name=a.tif", content=TIFF).json()
    reply = me.put(f"/scenes/{scene['id']}/files/{name}", content=b"x")
    assert reply.status_code == status, reply.text


def test_an_upload_without_announced_length_arrives(bearer: Bearer):
    reply = bearer("register").post("/scenes?name=a.tif", content=chunks(TIFF))
    assert reply.json()["size_bytes"] == len(TIFF)


DIGEST = hashlib.sha256(TIFF).digest()


@pytest.mark.parametrize(
    "header",
    [
        {"X-Checksum": DIGEST.hex()},
        {"Repr-Digest": f"sha-256=:{b64encode(DIGEST).decode()}:"},
        {"Repr-Digest": f"md5=:AAAA:, sha-256=:{b64encode(DIGEST).decode()}:"},
    ],
)
def test_a_checksum_that_fits_is_accepted(client: TestClient, bearer: Bearer, header: dict[str, str]):
    reply = client.post("/scenes?name=a.tif", content=TIFF, headers=bearer("register") | header)
    assert reply.status_code == 201, reply.text


NO_IMAGE = "neither TIFF, JPEG 2000 nor NITF"


@pytest.mark.parametrize(
    ("body", "header", "status", "reason"),
    [
        *(
            (body, {}, 422, NO_IMAGE)
            for body in (b"", b"II", b"<VRTDataset/>", b"\x89PNG\r\n", b"PK\3\4")
        ),
        (b"II*\0", {"Content-Length": str(LIMIT_BYTES + 1)}, 413, f"{LIMIT_BYTES + 1} bytes announced"),
        (TIFF + bytes(LIMIT_BYTES), {}, 413, f"larger than {LIMIT_BYTES} bytes"),
        (TIFF, {"X-Checksum": bytes(32).hex()}, 422, "sha256"),
        (TIFF, {"X-Checksum": "abc"}, 422, "X-Checksum"),
        (TIFF, {"Repr-Digest": f"sha-256=:{b64encode(bytes(32)).decode()}:"}, 422, "sha256"),
        (TIFF, {"Repr-Digest": "sha-256=:AAAA:"}, 422, "Repr-Digest"),
    ],
)
def test_an_upload_that_cannot_be_used_is_refused_and_leaves_nothing(
    me: Caller, storage: Storage, body: bytes, header: dict[str, str], status: int, reason: str
):
    """What is no image, has another checksum, or is too large: announced so, or only when it arrives."""
    content = chunks(body) if len(body) > LIMIT_BYTES else body
    reply = (me | header).post("/scenes?name=a.tif", content=content)
    assert reply.status_code == status
    assert reason in reply.json()["detail"]
    assert me.get("/scenes").json()["scenes"] == []
    assert stored_files(storage) == []


def test_an_upload_without_a_name_is_refused(bearer: Bearer):
    reply = bearer("register").post("/scenes", content=TIFF)
    assert reply.status_code == 422
    assert "no name" in reply.json()["detail"]


def test_a_scene_of_another_owner_is_not_found(bearer: Bearer, storage: Storage):
    scene = bearer("register").post("/scenes?name=a.tif", content=TIFF).json()
    here = f"/scenes/{scene['id']}"
    stranger = bearer("register")
    replies = [
        stranger.get(here),
        stranger.delete(here),
        stranger.put(f"{here}/files/a_RPC.TXT", content=b"x"),
    ]
    assert [reply.status_code for reply in replies] == [404, 404, 404]
    assert stranger.get("/scenes").json()["scenes"] == []
    assert storage.keys("scenes") == [f"scenes/{scene['id']}/a.tif"]
    assert bearer("admin").get(here).status_code == 200


def test_a_removed_scene_keeps_its_record_and_loses_its_files(me: Caller, storage: Storage):
    scene = me.post("/scenes?name=a.tif", content=TIFF).json()
    here = f"/scenes/{scene['id']}"
    me.put(f"{here}/files/a_RPC.TXT", content=b"x")
    assert me.delete(here).status_code == 204
    left = me.get(here).json()
    assert (left["state"], left["sha256"], left["models"]) == ("removed", scene["sha256"], [])
    assert stored_files(storage) == []
    late = me.put(f"{here}/files/a_RPC.TXT", content=b"x")
    assert late.status_code == 409


def test_a_removed_scene_takes_and_gives_no_more_files_and_counts_for_nobody(
    me: Caller, connection: Connection, storage: Storage
):
    """Not even those that a deletion has left which broke off."""
    scene = me.scene(TIFF, "name=a.tif")
    model = f"/scenes/{scene}/files/a_RPC.TXT"
    announced = {"filename": "b_RPC.TXT", "scene": scene}
    owner = UUID(me.get("/tokens/self").json()["id"])
    assert me.put(model, content=b"LINE_OFF: 1").status_code == 200
    assert me.get(model).content == b"LINE_OFF: 1"
    before = usage.read_usage(connection, owner)
    assert (before.scenes, before.scene_bytes) == (1, len(TIFF) + 11)
    connection.commit()
    assert me.delete(f"/scenes/{scene}").status_code == 204
    for name in ("a_RPC.TXT", "a.tif"):
        storage.put(f"scenes/{scene}/{name}", [b"left"])
        assert me.get(f"/scenes/{scene}/files/{name}").status_code == 404
    assert me.put(model, content=b"LINE_OFF: 2").status_code == 409
    assert begun(me, 1, **announced).status_code == 409
    after = usage.read_usage(connection, owner)
    assert (after.scenes, after.total_bytes) == (0, 0)


@pytest.mark.parametrize("announced", [len(TIFF) - 1, len(TIFF) + 1])
def test_a_file_of_another_size_than_announced_leaves_nothing(
    settings: Settings, database: Database, storage: Storage, connection: Connection, announced: int
):
    owner = create_token(connection, "me", ["register"]).token
    connection.commit()
    sent = SentFile("a.tif", [TIFF], size_bytes=announced)
    with pytest.raises((InputError, TooLarge)):
        upload_scene(Installation(database, storage, settings), owner, sent)
    assert stored_files(storage) == []
    assert usage.read_usage(connection, owner.id).total_bytes == 0


def test_folders_in_a_sent_file_name_are_dropped(me: Caller, storage: Storage):
    for name in ("../../../etc/passwd.tif", "/etc/cron.d/x.tif", "..\\..\\x.tif", ".hidden.tif"):
        reply = me.post("/scenes", params={"name": name}, content=TIFF)
        assert reply.status_code == 201, reply.text
        key = f"scenes/{reply.json()['id']}/{reply.json()['file']}"
        assert storage.path(key).resolve().is_relative_to(storage.folder.resolve())
    assert len(stored_files(storage)) == 4


@given(st.text(max_size=300))
def test_any_text_becomes_a_name_the_storage_takes_or_is_refused(text: str):
    try:
        name = clean_name(text)
    except InputError:
        return
    assert KEY.fullmatch(name)
    assert "/" not in name
    assert clean_name(name) == name


def test_the_sweep_removes_what_uploads_cut_off_left_behind(client: TestClient, bearer: Bearer):
    uploaded = bearer("register").post("/scenes?name=a.tif", content=TIFF).json()
    app = client.app
    database, storage = app.state.database, app.state.storage  # type: ignore[attr-defined]
    with database.transaction() as connection:
        arriving = scenes.begin_upload(connection, None, "b.tif", "b.tif", sigma_m=None)
        cut_off = scenes.begin_upload(connection, None, "c.tif", "c.tif", sigma_m=None)
        run_sql(
            connection,
            "update scene set created_at = now() - interval '2 days', created_at_uptime_s = -2 * 86400"
            " where id = %s",
            [cut_off],
        )
    for scene_id, name in ((arriving, "b.tif"), (cut_off, "c.tif")):
        storage.put(f"{folder_of(scene_id)}/{name}", [TIFF])
    old, new = (storage.folder / "unfinished" / name for name in ("old", "new"))
    for path in (old, new):
        path.write_bytes(b"II*")
    os.utime(old, (0, 0))
    sweep_files(database, storage, longest_job_s=3600.0)
    assert (old.exists(), new.exists()) == (False, True)
    assert storage.keys("scenes") == sorted(
        [f"scenes/{uploaded['id']}/a.tif", f"scenes/{arriving}/b.tif"]
    )


def test_an_upload_survives_no_failure_of_the_database(settings: Settings, bearer: Bearer, dsn: str):
    me = bearer("register")
    run_in(engine.connect(dsn), "alter table scene add constraint test_only check (state <> 'uploaded')")
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        reply = client.post("/scenes?name=a.tif", content=TIFF, headers=me)
        assert reply.status_code == 500
        assert stored_files(Storage(settings.data_folder / "storage")) == []
        assert client.get("/scenes", headers=me).json()["scenes"] == []


@pytest.mark.thorough
def test_an_upload_cut_off_by_its_sender_leaves_nothing(
    token: Callable[[str], str], settings: Settings, storage: Storage, tmp_path: Path, dsn: str
):
    with running_service(settings, tmp_path / "serve.log", "--no-worker") as url:
        port = int(url.rsplit(":", 1)[1])
        head = (
            "POST /scenes?name=a.tif HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10000000\r\n"
            f"Authorization: Bearer {token('register')}\r\n\r\n"
        )
        with socket.create_connection(("127.0.0.1", port)) as sender:
            sender.sendall(head.encode() + b"II*\0" + bytes(1_000_000))
            unfinished = storage.folder / "unfinished"
            wait_until(lambda: list(unfinished.glob("*")), "the upload has begun", 20.0)

        def forgotten() -> bool:
            (row,) = run_in(engine.connect(dsn), "select count(*) as n from scene")
            return row == {"n": 0}

        wait_until(forgotten, "the scene is forgotten", 20.0)
        assert stored_files(storage) == []
