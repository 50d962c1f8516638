"""Resumable uploads with the tus client over connections that break."""

import hashlib
import io
import socket
import tarfile
import threading
import time
from base64 import b64encode
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from pathlib import Path
from uuid import UUID, uuid4

import httpx
import numpy as np
import pytest
import uvicorn
from fastapi.testclient import TestClient
from tusclient.client import TusClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db import uploads as upload_rows
from amers.app.db.engine import Connection
from amers.app.db.scenes import newest_scenes
from amers.app.db.tokens import list_tokens
from amers.app.db.uploads import LIFE_HOURS
from amers.app.errors import Conflict, InputError, NotFound
from amers.app.main import create_app
from amers.app.storage import Storage
from amers.app.usecases.blocks.uploads import find_uploaded_block
from amers.app.usecases.scenes import SIDE_FILE_LIMIT_BYTES, local_image
from amers.app.usecases.uploads import UPLOAD_PREFIX, remove_abandoned_uploads
from amers.app.worker.sweep import sweep_files
from tests.app.callers import Bearer, Caller
from tests.app.conftest import stored_files
from tests.app.ledger import bytes_in_ledger, bytes_in_storage, make_token
from tests.app.point_history import let_pass
from tests.app.sending import PIECE, TUS, begun, piece, said, whole, zipped
from tests.services.formats.statements.scene_files import til
from tests.statements import run_sql

TIFF = b"II*\0" + np.random.default_rng(1).bytes(300_000)
LIMIT_BYTES = 400_000
BREAKS = 10


@pytest.fixture
def settings(dsn: str, tmp_path: Path) -> Settings:
    """An installation that takes small uploads only."""
    return Settings(database_url=dsn, data_folder=tmp_path / "data", upload_limit_bytes=LIMIT_BYTES)


@pytest.fixture
def me(bearer: Bearer) -> Caller:
    return bearer("register") | TUS


@contextmanager
def listening(settings: Settings) -> Iterator[str]:
    """The application behind a real socket."""
    server = uvicorn.Server(uvicorn.Config(create_app(settings), port=0, log_level="warning"))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            time.sleep(0.02)
        host, port = server.servers[0].sockets[0].getsockname()[:2]
        yield f"http://{host}:{port}"
    finally:
        server.should_exit = True
        thread.join()


@contextmanager
def breaking_line(url: str, me: dict[str, str], start: int, part: bytes) -> Iterator[None]:
    """A connection that announces the rest of the file, sends a part of it, and breaks."""
    host, port = url.split("/")[2].split(":")
    path = "/" + url.split("/", 3)[3]
    headers = {**me, **PIECE, "Upload-Offset": start, "Content-Length": len(TIFF) - start, "Host": host}
    lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    with socket.create_connection((host, int(port))) as line:
        line.sendall(f"PATCH {path} HTTP/1.1\r\n{lines}\r\n".encode() + part)
        yield


def test_an_upload_interrupted_and_resumed_ten_times_arrives_intact(
    settings: Settings, me: dict[str, str], storage: Storage
):
    rng = np.random.default_rng(2)
    with listening(settings) as base, httpx.Client(headers=me) as http:
        tus = TusClient(f"{base}/uploads", headers=me)
        metadata = {"filename": "a.tif", "sha256": hashlib.sha256(TIFF).hexdigest()}
        uploader = tus.uploader(file_stream=io.BytesIO(TIFF), chunk_size=100_000, metadata=metadata)
        uploader.set_url(uploader.create_url())
        url, arrived = uploader.url, 0
        for number in range(BREAKS):
            sent = int(rng.integers(1, 20_000))
            deadline = time.monotonic() + 20.0
            with breaking_line(url, me, arrived, TIFF[arrived : arrived + sent]):
                while int(http.head(url).headers["Upload-Offset"]) == arrived:
                    assert time.monotonic() < deadline, f"break {number}: nothing of {sent} bytes came"
                    time.sleep(0.01)
            # Until the service notices that the connection is gone.
            while probe(http, url) == 423:
                assert time.monotonic() < deadline
                time.sleep(0.02)
            arrived = int(http.head(url).headers["Upload-Offset"])
        assert 0 < arrived < len(TIFF)
        resumed = tus.uploader(file_stream=io.BytesIO(TIFF), chunk_size=100_000, url=url)
        assert resumed.offset == arrived
        resumed.upload()
        document = http.get(url).json()
        scene = http.get(f"{base}/scenes/{document['scene']}").json()
    assert (document["state"], document["offset"]) == ("finished", len(TIFF))
    assert (scene["state"], scene["sha256"]) == ("uploaded", metadata["sha256"])
    assert storage.path(f"scenes/{scene['id']}/a.tif").read_bytes() == TIFF


def probe(http: httpx.Client, url: str) -> int:
    """The status of an empty piece at the end of the file: 423 while the former sender locks it."""
    start = http.head(url).headers["Upload-Offset"]
    return http.patch(url, content=b"", headers=PIECE | {"Upload-Offset": start}).status_code


def test_the_service_reports_the_tus_extensions_it_supports(client: TestClient, me: Caller):
    reply_headers = client.options("/uploads").headers
    assert reply_headers["tus-version"] == "1.0.0"
    assert set(reply_headers["tus-extension"].split(",")) == {
        "creation",
        "termination",
        "checksum",
        "expiration",
    }
    assert int(reply_headers["tus-max-size"]) == LIMIT_BYTES
    refused = client.post("/uploads", headers=me | {"Tus-Resumable": "0.2.2", "Upload-Length": "1"})
    assert (refused.status_code, refused.headers["tus-version"]) == (412, "1.0.0")


def test_an_image_and_the_file_with_its_model_become_one_scene(me: Caller, storage: Storage):
    reply = begun(me, len(TIFF), filename="IMG.TIF", sigma_m="7.5")
    assert reply.headers["upload-expires"]
    scene = reply.headers["amers-scene"]
    assert me.get(f"/scenes/{scene}").json()["state"] == "uploading"
    assert me.delete(f"/scenes/{scene}").status_code == 409, "its upload is deleted"
    model = begun(me, 4, filename="RPC_IMG.XML", scene=scene)
    assert piece(me, model.headers["location"], 0, b"<a/>").status_code == 204
    url = reply.headers["location"]
    assert piece(me, url, 0, TIFF[:1000]).headers["upload-offset"] == "1000"
    reply_headers = me.head(url).headers
    assert (reply_headers["upload-offset"], reply_headers["upload-length"]) == ("1000", str(len(TIFF)))
    assert reply_headers["cache-control"] == "no-store"
    assert piece(me, url, 1000, TIFF[1000:]).status_code == 204
    document = me.get(f"/scenes/{scene}").json()
    assert (document["state"], document["models"], document["sigma_m"]) == (
        "uploaded",
        ["RPC_IMG.XML"],
        7.5,
    )
    assert storage.path(f"scenes/{scene}/RPC_IMG.XML").read_bytes() == b"<a/>"
    assert list(storage.scratch().iterdir()) == []


def test_a_piece_that_does_not_begin_where_the_file_ends_is_refused(client: TestClient, me: Caller):
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    piece(me, url, 0, TIFF[:100])
    for start in (0, 99, 101):
        assert piece(me, url, start, TIFF[start:200]).status_code == 409
    reply = client.patch(url, content=b"x", headers=me | {"Upload-Offset": "100"})
    assert reply.status_code == 415
    assert piece(me, url, 100, TIFF).status_code == 413
    assert me.head(url).headers["upload-offset"] == "100"


def test_a_piece_with_a_wrong_checksum_is_discarded(me: Caller):
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    for algorithm in ("sha1", "sha256"):
        start = int(me.head(url).headers["upload-offset"])
        data = TIFF[start : start + 100]
        right = b64encode(hashlib.new(algorithm, data).digest()).decode()
        wrong = b64encode(hashlib.new(algorithm, b"other").digest()).decode()
        bad = piece(me, url, start, data, **{"Upload-Checksum": f"{algorithm} {wrong}"})
        assert bad.status_code == 460
        assert int(me.head(url).headers["upload-offset"]) == start
        good = piece(me, url, start, data, **{"Upload-Checksum": f"{algorithm} {right}"})
        assert good.status_code == 204
    for unknown in ("md5 AAAA", "sha1 AAAA", "sha256"):
        assert piece(me, url, 200, b"x", **{"Upload-Checksum": unknown}).status_code == 400


def tar_with_a_broken_later_header() -> bytes:
    """A complete image, and a model whose tar header has a wrong checksum."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w") as archive:
        for name, data in (("a.tif", TIFF[:1000]), ("a_RPC.TXT", b"LINE_OFF: 1")):
            header = tarfile.TarInfo(name)
            header.size = len(data)
            archive.addfile(header, io.BytesIO(data))
    return out.getvalue().replace(b"a_RPC.TXT", b"b_RPC.TXT")


@pytest.mark.parametrize(
    ("data", "metadata", "message"),
    [
        (b"<VRTDataset/>", {"filename": "a.tif"}, "neither TIFF"),
        (TIFF, {"filename": "a.tif", "sha256": "0" * 64}, "sha256"),
        (b"PK\3\4garbage", {"filename": "a.zip"}, "broken archive"),
        (tar_with_a_broken_later_header(), {"filename": "a.tar"}, "broken archive"),
    ],
)
def test_an_unusable_file_is_refused_and_deleted(
    me: Caller, storage: Storage, data: bytes, metadata: dict[str, str], message: str
):
    reply = begun(me, len(data), **metadata)
    refused = piece(me, reply.headers["location"], 0, data)
    assert refused.status_code == 422
    assert message in refused.json()["detail"]
    assert me.head(reply.headers["location"]).status_code == 404
    assert me.get("/scenes").json()["scenes"] == []
    assert stored_files(storage) == []


def test_an_unusable_upload_is_refused_before_it_begins(me: Caller):
    for size, metadata, status in [
        (0, {"filename": "a.tif"}, 422),
        (10, {}, 422),
        (LIMIT_BYTES + 1, {"filename": "a.tif"}, 413),
        (10, {"filename": "a.tif", "sha256": "abc"}, 422),
        (10, {"filename": "a.tif", "sigma_m": "-1"}, 422),
        (10, {"filename": "a.tif", "sigma_m": "nan"}, 422),
        (10, {"filename": "a.tif", "purpose": "virus"}, 422),
        (10, {"filename": "a.xml", "scene": "1"}, 422),
        (10, {"filename": "a.xml", "scene": str(UUID(int=1))}, 404),
        (10, {"filename": "a.xml", "purpose": "model"}, 422),
        (10, {"filename": "a.zip", "purpose": "block"}, 403),
        (10, {"filename": "..."}, 422),
    ]:
        reply = begun(me, size, **metadata)
        assert reply.status_code == status, reply.text
        assert me.get("/scenes").json()["scenes"] == [], size


def test_an_archive_with_an_image_and_its_model_becomes_a_scene(me: Caller, storage: Storage):
    files = {"p/IMG_1.TIF": TIFF, "p/RPC_1.XML": b"<a/>", "p/READ.ME": b"x", "q/RPC_2.XML": b"<b/>"}
    reply = whole(me, zipped(files), filename="delivery.zip")
    assert reply.status_code == 204, reply.text
    scene = me.get(f"/scenes/{reply.headers['amers-scene']}").json()
    assert (scene["file"], scene["models"]) == ("IMG_1.TIF", ["RPC_1.XML"])
    assert scene["sha256"] == hashlib.sha256(TIFF).hexdigest()
    assert storage.keys("scenes") == [f"scenes/{scene['id']}/{n}" for n in ("IMG_1.TIF", "RPC_1.XML")]


def tiles_of_a_product() -> dict[str, bytes]:
    """An image in two tiles, with the file that lists them and the model of the whole."""
    boxes = [("a_R1C1.TIF", 0, 0, 59, 79), ("a_R2C1.TIF", 60, 0, 119, 79)]
    return {
        "delivery/a.TIL": til(boxes).encode(),
        "delivery/a.RPB": b"satId = ...",
        **{f"delivery/{name}": TIFF[:1000] for name, *_ in boxes},
    }


def test_the_tiles_of_a_product_become_one_scene_that_is_read_whole(
    me: Caller,
    connection: Connection,
    storage: Storage,
    settings: Settings,
    tmp_path: Path,
) -> None:
    reply = whole(me, zipped(tiles_of_a_product()), filename="delivery.zip")
    assert reply.status_code == 204, reply.text
    (row,) = newest_scenes(connection, None, 2)
    assert row.file_name == "a_R1C1.TIF"
    assert set(row.models) == {"a_R2C1.TIF", "a.TIL", "a.RPB"}
    assert local_image(storage, settings, row, tmp_path).name == "a.TIL"


def test_tiles_without_the_document_that_lists_them_are_refused(me: Caller) -> None:
    files = {name: content for name, content in tiles_of_a_product().items() if "TIL" not in name}
    reply = whole(me, zipped(files), filename="delivery.zip")
    assert "all tiles of one product with the document that lists them" in reply.text


@pytest.mark.parametrize(("room", "status"), [(0, 204), (-1, 413)])
def test_an_archive_needs_the_room_of_what_it_unpacks_to_and_no_more(
    client: TestClient, bearer: Bearer, storage: Storage, connection: Connection, room: int, status: int
):
    """It is far smaller itself, and has files that nobody needs."""
    files = {"a.tif": b"II*\0" + bytes(200_000), "a_RPC.TXT": bytes(3000), "READ.ME": bytes(100_000)}
    needed = len(files["a.tif"]) + len(files["a_RPC.TXT"])
    me = make_token(client, bearer("admin"), storage_quota_bytes=needed + room) | TUS
    assert whole(me, zipped(files), filename="delivery.zip").status_code == status
    stored = needed if status == 204 else 0
    assert bytes_in_ledger(connection) == bytes_in_storage(storage) == stored


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"../IMG.TIF": TIFF}, "not accepted"),
        ({"a.tif": TIFF, "b.tif": TIFF[:9]}, "a.tif, b.tif"),
        ({"readme": b"x"}, "none"),
        ({"a.tif": b"<VRTDataset/>"}, "neither TIFF"),
        ({"a.tif": TIFF, "zeros": bytes(LIMIT_BYTES)}, "unpacks to more"),
        ({"a.tif": TIFF, "a b_RPC.TXT": b"LINE", "a+b_RPC.TXT": b"SAMP"}, "get the same name"),
    ],
)
def test_an_archive_that_could_do_harm_or_is_no_scene_is_refused(
    me: Caller, storage: Storage, files: dict[str, bytes], message: str
):
    reply = whole(me, zipped(files), filename="delivery.zip")
    assert reply.status_code == 422
    assert message in reply.json()["detail"]
    assert stored_files(storage) == []


def test_an_upload_of_another_owner_is_not_found(client: TestClient, me: Caller, bearer: Bearer):
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    stranger = bearer("register") | TUS
    assert stranger.head(url).status_code == 404
    assert piece(stranger, url, 0, TIFF).status_code == 404
    assert stranger.delete(url).status_code == 404
    assert client.head(url, headers=TUS).status_code == 401


def test_an_upload_that_is_ended_or_expires_leaves_nothing(
    client: TestClient, me: Caller, storage: Storage
):
    first, second = (begun(me, len(TIFF), filename="a.tif") for _ in range(2))
    piece(me, first.headers["location"], 0, TIFF[:100])
    piece(me, second.headers["location"], 0, TIFF[:100])
    assert me.delete(first.headers["location"]).status_code == 204
    assert me.head(first.headers["location"]).status_code == 404
    database = client.app.state.database  # type: ignore[attr-defined]
    remove_abandoned_uploads(database, storage)
    (arriving,) = storage.scratch().iterdir()
    assert arriving.stat().st_mode & 0o777 == 0o600
    for hours, status in ((LIFE_HOURS - 1, 200), (2, 404)):
        with database.transaction() as connection:
            let_pass(connection, hours=hours)
        assert me.head(second.headers["location"]).status_code == status
    remove_abandoned_uploads(database, storage)
    assert list(storage.scratch().iterdir()) == []


def test_two_senders_of_one_file_do_not_mix(settings: Settings, me: dict[str, str]):
    with listening(settings) as base, httpx.Client(headers=me) as http:
        length = {"Upload-Length": str(len(TIFF))}
        url = http.post(f"{base}/uploads", headers=length | said(filename="a.tif")).headers["location"]
        halfway, go_on = threading.Event(), threading.Event()

        def slow() -> Iterator[bytes]:
            yield TIFF[:1000]
            halfway.set()
            go_on.wait(5.0)  # the answer to a refused request is read after its body
            yield TIFF[1000:]

        replies: list[int] = []

        def send() -> None:
            headers = me | PIECE | {"Upload-Offset": "0"}
            status = 423
            while status == 423:  # a probe was there first; clients of tus try again
                status = httpx.patch(url, content=slow(), headers=headers, timeout=30.0).status_code
            replies.append(status)

        sender = threading.Thread(target=send)
        sender.start()
        assert halfway.wait(20.0)
        deadline = time.monotonic() + 60.0
        while (status := probe(http, url)) != 423:
            assert time.monotonic() < deadline, status
            time.sleep(0.05)
        go_on.set()
        sender.join()
        assert replies == [204]
        assert http.get(url).json()["state"] == "finished"


def test_a_block_that_has_arrived_is_there_to_be_ingested(bearer: Bearer, storage: Storage, dsn: str):
    admin = bearer("admin") | TUS
    reply = begun(admin, 100, filename="block.zip", purpose="block")
    url = reply.headers["location"]
    assert piece(admin, url, 0, bytes(100)).status_code == 204
    with engine.connect(dsn) as connection:
        caller = list_tokens(connection)[0]
        key = find_uploaded_block(connection, caller, UUID(url.rsplit("/", 1)[-1]))
    assert storage.size(key) == 100


@pytest.mark.parametrize("version", [None, "0.2.2", "1.0", ""])
def test_a_request_without_the_version_of_the_protocol_is_refused_and_changes_nothing(
    client: TestClient, me: Caller, version: str | None
):
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    piece(me, url, 0, TIFF[:10])
    other = {name: value for name, value in me.items() if name not in TUS}
    other |= {} if version is None else {"Tus-Resumable": version}
    for refused in (
        client.post("/uploads", headers=other | {"Upload-Length": "10"} | said(filename="b.tif")),
        client.head(url, headers=other),
        client.patch(url, content=TIFF[10:20], headers=other | PIECE | {"Upload-Offset": "10"}),
        client.delete(url, headers=other),
        client.post(url, headers=other | {"X-HTTP-Method-Override": "DELETE"}),
    ):
        assert (refused.status_code, refused.headers["tus-version"]) == (412, "1.0.0")
        assert refused.headers["tus-resumable"] == "1.0.0"
    assert client.get(url, headers=other).json()["offset"] == 10, "for clients without tus"
    assert client.options("/uploads", headers=other).status_code == 204
    assert len(client.get("/scenes", headers=other).json()["scenes"]) == 1


def shown(me: Caller, reply: httpx.Response) -> dict[str, object]:
    """The document of the upload that a reply has created."""
    assert reply.status_code == 201, reply.text
    document: dict[str, object] = me.get(reply.headers["location"]).json()
    return document


@pytest.fixture
def arriving(me: Caller) -> str:
    """The id of a scene whose image arrives."""
    return str(begun(me, 10, filename="a.tif").headers["amers-scene"])


@pytest.mark.parametrize("named", [{}, {"purpose": "model"}])
def test_a_file_that_names_a_scene_is_a_model_of_it(me: Caller, arriving: str, named: dict[str, str]):
    model = shown(me, begun(me, 10, filename="a.xml", scene=arriving, **named))
    assert (model["purpose"], model["scene"]) == ("model", arriving)


@pytest.mark.parametrize("named", [{}, {"purpose": "image"}])
def test_a_file_that_names_no_scene_is_the_image_of_another_one(
    me: Caller, arriving: str, named: dict[str, str]
):
    image = shown(me, begun(me, 10, filename="a.tif", **named))
    assert (image["purpose"], image["scene"] == arriving) == ("image", False)


def test_an_image_does_not_join_a_scene(me: Caller, arriving: str):
    beside = begun(me, 10, filename="b.tif", purpose="image", scene=arriving)
    assert (beside.status_code, "creates a new scene" in beside.json()["detail"]) == (422, True)


@pytest.mark.parametrize("named", [{}, {"scene": str(UUID(int=1))}])
def test_a_block_belongs_to_no_scene(bearer: Bearer, named: dict[str, str]):
    me = bearer("admin") | TUS
    block = shown(me, begun(me, 10, filename="a.zip", purpose="block", **named))
    assert (block["purpose"], block.get("scene")) == ("block", None)


@pytest.mark.parametrize("letters", [1, 195, 196, 197, 500])
def test_of_a_long_name_the_last_two_hundred_letters_are_kept(me: Caller, letters: int):
    name = f"{'ab' * letters}"[:letters] + ".tif"
    reply = begun(me, 10, filename=name)
    assert shown(me, reply)["name"] == name[-200:]
    scene = me.get(f"/scenes/{reply.headers['amers-scene']}").json()
    assert scene["name"] == name[-200:]


def test_each_piece_gives_an_upload_another_day(me: Caller, connection: Connection):
    def hours_left(reply: httpx.Response) -> float:
        expiry = parsedate_to_datetime(reply.headers["upload-expires"])
        return (expiry - datetime.now(UTC)).total_seconds() / 3600.0

    reply = begun(me, len(TIFF), filename="a.tif")
    url = reply.headers["location"]
    assert hours_left(reply) == pytest.approx(24.0, abs=0.1)
    other = begun(me, len(TIFF), filename="a.tif").headers["location"]
    for data in (TIFF[:10], b""):
        run_sql(connection, "update upload set expires_at = now() + interval '1 hour'")
        connection.commit()
        start = int(me.head(url).headers["upload-offset"])
        assert piece(me, url, start, data).status_code == 204
        assert hours_left(me.head(url)) == pytest.approx(24.0, abs=0.1)
        assert hours_left(me.head(other)) == pytest.approx(1.0, abs=0.1)


def test_the_largest_model_may_be_announced_and_the_largest_raster_as_an_image(me: Caller):
    scene = begun(me, LIMIT_BYTES, filename="a.tif").headers["amers-scene"]
    for name, most in (("a.xml", SIDE_FILE_LIMIT_BYTES), ("mask.tif", LIMIT_BYTES)):
        for size, status in ((most, 201), (most + 1, 413)):
            assert begun(me, size, filename=name, scene=scene).status_code == status, name


def test_a_model_that_does_not_arrive_leaves_the_scene_and_its_former_model(
    me: Caller, storage: Storage
):
    scene = whole(me, TIFF, filename="a.tif").headers["amers-scene"]
    whole(me, b"former", filename="a_RPC.TXT", scene=scene)
    ended = begun(me, 4, filename="a_RPC.TXT", scene=scene).headers["location"]
    assert me.delete(ended).status_code == 204
    wrong = whole(me, b"<a/>", filename="a_RPC.TXT", scene=scene, sha256="0" * 64)
    assert wrong.status_code == 422
    document = me.get(f"/scenes/{scene}").json()
    assert (document["state"], document["models"]) == ("uploaded", ["a_RPC.TXT"])
    assert storage.open(f"scenes/{scene}/a_RPC.TXT").read() == b"former"
    assert list(storage.scratch().iterdir()) == []


def test_the_model_that_an_administrator_sends_belongs_to_the_owner_of_the_scene(
    me: Caller, bearer: Bearer
):
    scene = whole(me, TIFF, filename="a.tif").headers["amers-scene"]
    admin, stranger = bearer("admin") | TUS, bearer("register") | TUS
    assert begun(stranger, 4, filename="a.xml", scene=scene).status_code == 404
    url = begun(admin, 4, filename="a.xml", scene=scene).headers["location"]
    assert stranger.head(url).status_code == 404
    assert piece(me, url, 0, b"<a/>").status_code == 204
    assert me.get(f"/scenes/{scene}").json()["models"] == ["a.xml"]


def test_an_upload_whose_bytes_are_on_another_machine_has_to_begin_again(me: Caller, storage: Storage):
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    (arriving,) = storage.scratch().iterdir()
    arriving.unlink()
    for reply in (me.get(url), piece(me, url, 0, TIFF)):
        assert reply.status_code == 404
        assert "start a new upload" in reply.json()["detail"]


@pytest.mark.parametrize("announced", [True, False])
def test_the_checksum_of_a_block_is_kept_whether_it_was_announced_or_not(
    bearer: Bearer, connection: Connection, announced: bool
):
    data, admin = b"PK\3\4" * 10, bearer("admin") | TUS
    sha256 = hashlib.sha256(data).hexdigest()
    more = {"sha256": sha256} if announced else {}
    assert whole(admin, data, filename="a.zip", purpose="block", **more).status_code == 204
    row = run_sql(connection, "select sha256, size_bytes from upload").fetchone()
    assert row == {"sha256": sha256, "size_bytes": len(data)}


def test_a_complete_upload_is_not_ended_with_its_scene(me: Caller, storage: Storage):
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    scene = piece(me, url, 0, TIFF).headers["amers-scene"]
    assert me.delete(url).status_code == 409
    assert me.get(f"/scenes/{scene}").status_code == 200
    assert storage.keys("scenes") == [f"scenes/{scene}/a.tif"]


def test_a_complete_upload_takes_its_end_again_and_nothing_else(me: Caller):
    """The confirmation of the last piece may have been lost."""
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    piece(me, url, 0, TIFF)
    assert piece(me, url, len(TIFF), b"").status_code == 204
    assert piece(me, url, 0, TIFF).status_code == 404
    assert piece(me, url, len(TIFF) + 1, b"").status_code == 404


def test_a_checksum_is_compared_in_small_letters_and_in_capitals(me: Caller):
    for digest in (hashlib.sha256(TIFF).hexdigest(), hashlib.sha256(TIFF).hexdigest().upper()):
        assert whole(me, TIFF, filename="a.tif", sha256=digest).status_code == 204


def test_the_accuracy_of_a_model_is_a_number_of_metres_above_zero(me: Caller):
    for sigma_m, status in [("0", 422), ("-1", 422), ("inf", 422), ("0.1", 201)]:
        assert begun(me, 10, filename="a.tif", sigma_m=sigma_m).status_code == status, sigma_m


def test_a_block_is_ingested_from_a_complete_archive_of_ones_own(bearer: Bearer, connection: Connection):
    admin, me = bearer("admin") | TUS, bearer("register") | TUS
    callers = {token.scopes[0]: token for token in list_tokens(connection)}

    def id_of(url: str) -> UUID:
        return UUID(url.rsplit("/", 1)[-1])

    arriving = begun(admin, 40, filename="block.zip", purpose="block").headers["location"]
    with pytest.raises(Conflict, match="not complete"):
        find_uploaded_block(connection, callers["admin"], id_of(arriving))
    assert piece(admin, arriving, 0, bytes(40)).status_code == 204
    key = find_uploaded_block(connection, callers["admin"], id_of(arriving))
    assert key == f"uploads/{id_of(arriving)}/block.zip"
    with pytest.raises(NotFound):
        find_uploaded_block(connection, callers["register"], id_of(arriving))
    image = begun(me, len(TIFF), filename="a.tif").headers["location"]
    assert piece(me, image, 0, TIFF).status_code == 204
    for caller in callers.values():
        with pytest.raises(InputError, match="purpose image"):
            find_uploaded_block(connection, caller, id_of(image))


def test_the_archive_of_a_block_is_found_by_its_upload_and_no_other_file_is(
    bearer: Bearer, connection: Connection, storage: Storage
):
    admin = bearer("admin") | TUS
    ids = {}
    for purpose, name in (("block", "a.zip"), ("image", "a.tif"), ("block", "b.zip")):
        reply = begun(admin, len(TIFF), filename=name, purpose=purpose)
        url = reply.headers["location"]
        assert piece(admin, url, 0, TIFF).status_code == 204
        ids[name] = UUID(url.rsplit("/", 1)[-1])
    found = {name: upload_rows.find_block(connection, upload_id) for name, upload_id in ids.items()}
    keys = {name: f"uploads/{ids[name]}/{name}" for name in ("a.zip", "b.zip")}
    assert found == {**keys, "a.tif": None}
    assert storage.keys("uploads") == sorted(keys.values())
    assert upload_rows.find_block(connection, uuid4()) is None


def test_what_a_complete_upload_has_left_beside_its_file_is_removed(
    client: TestClient, me: Caller, storage: Storage
):
    arriving = begun(me, len(TIFF), filename="a.tif").headers["location"]
    complete = begun(me, len(TIFF), filename="b.tif").headers["location"]
    assert piece(me, complete, 0, TIFF).status_code == 204
    name = f"{UPLOAD_PREFIX}{complete.rsplit('/', 1)[-1]}"
    (storage.scratch() / name).write_bytes(b"left by a service that was killed")
    assert remove_abandoned_uploads(client.app.state.database, storage) == [name]  # type: ignore[attr-defined]
    assert me.head(arriving).headers["upload-offset"] == "0"


def test_archives_are_stored_and_swept_alike_however_they_were_uploaded(
    admin: Caller, storage: Storage, settings: Settings, dsn: str
):
    put = admin.put("/blocks/uploads/a.zip", content=b"PK\3\4" * 10).json()["upload"]
    reply = begun(admin, 40, filename="a.zip", purpose="block")
    tus = reply.headers["location"].rsplit("/", 1)[1]
    assert piece(admin, reply.headers["location"], 0, bytes(40)).status_code == 204
    keys = sorted(f"uploads/{upload}/a.zip" for upload in (put, tus))
    assert storage.keys("uploads") == keys
    execute = "/processes/ingest-block/execution"
    job = admin.post(execute, json={"inputs": {"upload": tus}}).json()["jobID"]
    for upload in (put, tus):
        document = admin.get(f"/uploads/{upload}").json()
        assert (document["state"], document["purpose"], document["size_bytes"]) == (
            "finished",
            "block",
            40,
        )
    assert settings.database_url is not None
    with engine.pooled(settings.database_url.get_secret_value(), settings) as database:
        storage.put(f"uploads/{uuid4()}/left.zip", [b"by a killed service"])
        sweep_files(database, storage, 3600.0)
        assert storage.keys("uploads") == keys
        with database.transaction() as connection:
            let_pass(connection, hours=LIFE_HOURS + 1)
        sweep_files(database, storage, 3600.0)
        assert storage.keys("uploads") == [f"uploads/{tus}/a.zip"], "a job waits to ingest it"
        assert admin.delete(f"/jobs/{job}").status_code == 200
        sweep_files(database, storage, 3600.0)
    assert storage.keys("uploads") == []
    gone = admin.post(execute, json={"inputs": {"upload": put}})
    assert gone.status_code == 404
