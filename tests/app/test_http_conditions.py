"""Conditions and ranges: what a client has is not sent again, and what it wants is sent alone."""

import logging
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from email import message_from_bytes
from pathlib import Path

import numpy as np
import pytest
import rasterio
import uvicorn
from fastapi import FastAPI
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.main import create_app
from tests.app.callers import Bearer
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.http_world import TIFF, HttpWorld, headers_of, http_world
from tests.app.s3_server import running_bucket
from tests.service_process import free_port

TILE = "/collections/points/tiles/WebMercatorQuad/5/11/16"
CHIP = "/collections/points/items/67108871/chips/0"


@pytest.fixture(scope="module")
def world(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[HttpWorld]:
    folder = tmp_path_factory.mktemp("http")
    with fresh_database(cluster, TEMPLATE) as dsn, http_world(dsn, folder) as world:
        yield world


@contextmanager
def listening(app: FastAPI) -> Iterator[str]:
    """A started application behind a real socket."""
    port = free_port()
    server = uvicorn.Server(uvicorn.Config(app, port=port, lifespan="off", log_config=None))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            time.sleep(0.02)
        yield f"http://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join()


def tagged(world: HttpWorld) -> list[str]:
    """Addresses whose replies have a tag."""
    page = ["/map"] if world.client.get("/map").is_success else []
    return [
        *world.files(),
        *page,
        TILE,
        CHIP,
        f"{CHIP}?f=npz",
        "/collections/points/items/67108871/chips",
    ]


def weak(tag: str) -> str:
    return f"W/{tag}"


def test_what_a_client_has_is_not_sent_again(world: HttpWorld):
    for url in tagged(world):
        whole = world.client.get(url)
        tag = whole.headers["etag"]
        for held in (tag, weak(tag), f'"a,b", {tag}', f'W/"x",{weak(tag)} , "y"', "*"):
            for method in ("GET", "HEAD"):
                reply = world.client.request(method, url, headers={"If-None-Match": held})
                assert (reply.status_code, reply.content) == (304, b""), (url, held)
                for name in ("etag", "cache-control", "vary", "last-modified", "expires"):
                    assert reply.headers.get(name) == whole.headers.get(name), (url, name)
                assert not {"content-length", "content-type"} & reply.headers.keys()
        for other in ('"other"', tag.strip('"'), f'{tag[:-1]}-x"', "", "W/*"):
            reply = world.client.get(url, headers={"If-None-Match": other})
            assert (reply.status_code, reply.content) == (200, whole.content), (url, other)


def test_a_date_decides_only_where_no_tag_does(world: HttpWorld):
    for url in world.files():
        whole = world.client.get(url)
        date, early = whole.headers["last-modified"], "Mon, 01 Jan 2001 00:00:00 GMT"

        def status(url: str = url, **conditions: str) -> int:
            named = {name.replace("_", "-"): value for name, value in conditions.items()}
            return world.client.get(url, headers=named).status_code

        assert status(If_Modified_Since=date) == 304
        assert status(If_Modified_Since="Fri, 01 Jan 2100 00:00:00 GMT") == 304
        for since in (early, "yesterday", "", "2020-01-01T00:00:00Z 99999999999"):
            assert status(If_Modified_Since=since) == 200, since
        assert status(If_Modified_Since=date, If_None_Match='"other"') == 200
        assert status(If_Modified_Since=early, If_None_Match=whole.headers["etag"]) == 304
        assert status(If_Unmodified_Since=date) == 200
        assert status(If_Unmodified_Since=early) == 412


def test_a_client_that_wants_another_content_gets_none(world: HttpWorld):
    for url in tagged(world):
        tag = world.client.get(url).headers["etag"]
        for wanted, status in (
            (tag, 200),
            ("*", 200),
            (f'"x", {tag}', 200),
            (weak(tag), 412),
            ('"x"', 412),
        ):
            reply = world.client.get(url, headers={"If-Match": wanted})
            assert reply.status_code == status, (url, wanted)
        refused = world.client.get(url, headers={"If-Match": '"x"'})
        assert tag in refused.json()["detail"]
    assert world.client.get("/conformance", headers={"If-Match": '"x"'}).status_code == 412
    assert world.client.get("/nothing", headers={"If-None-Match": "*"}).status_code == 404


def test_a_range_of_a_file_is_sent_alone(world: HttpWorld):
    for url in world.files():
        whole = world.client.get(url).content
        size = len(whole)
        for asked, start, end in (
            ("bytes=0-9", 0, 10),
            ("bytes=5-5", 5, 6),
            ("Bytes = 7-", 7, size),
            ("bytes=-4", size - 4, size),
            (f"bytes=-{size * 10}", 0, size),
            (f"bytes=3-{size * 10}", 3, size),
            ("bytes=1-2,3-4, 2-3", 1, 5),
            (f"bytes=2-3,{size}-", 2, 4),
        ):
            reply = world.client.get(url, headers={"Range": asked})
            assert (reply.status_code, reply.content) == (206, whole[start:end]), asked
            assert reply.headers["content-range"] == f"bytes {start}-{end - 1}/{size}"
            assert int(reply.headers["content-length"]) == end - start


def test_ranges_that_are_none_are_ignored(world: HttpWorld):
    for url in world.files():
        whole = world.client.get(url)
        asked = (
            "items=0-5",
            "bytes",
            "bytes=",
            "bytes=a-b",
            "bytes=9-2",
            "bytes=-",
            "bytes=1-2;3",
            "0-5",
        )
        for value in (*asked, f"bytes={'0-0,' * 101}", f"bytes={'9' * 5000}-"):
            reply = world.client.get(url, headers={"Range": value})
            assert (reply.status_code, reply.content) == (200, whole.content), value
        head = world.client.head(url, headers={"Range": "bytes=0-5"})
        assert (head.status_code, headers_of(head)) == (200, headers_of(whole))
        assert head.headers["accept-ranges"] == "bytes"


def test_a_range_beyond_the_end_tells_the_size(world: HttpWorld):
    for url in world.files():
        size = len(world.client.get(url).content)
        for asked in (f"bytes={size}-", "bytes=-0", f"bytes={size}-{size + 5},{size + 9}-"):
            reply = world.client.get(url, headers={"Range": asked})
            assert (reply.status_code, reply.headers["content-range"]) == (416, f"bytes */{size}")
            assert f"{size} bytes" in reply.json()["detail"]


def test_several_ranges_come_in_parts(world: HttpWorld):
    for url in world.files():
        whole = world.client.get(url).content
        reply = world.client.get(url, headers={"Range": "bytes=-3,0-1,9-12"})
        kind = reply.headers["content-type"]
        assert (reply.status_code, kind.partition(";")[0]) == (206, "multipart/byteranges")
        assert int(reply.headers["content-length"]) == len(reply.content)
        read = message_from_bytes(f"Content-Type: {kind}\r\n\r\n".encode() + reply.content)
        found = [(part["Content-Range"], part.get_payload(decode=True)) for part in read.get_payload()]
        size = len(whole)
        assert found == [
            (f"bytes {start}-{end - 1}/{size}", whole[start:end])
            for start, end in ((0, 2), (9, 13), (size - 3, size))
        ]


def test_a_range_is_sent_only_of_the_content_that_the_client_has(world: HttpWorld):
    for url in world.files():
        whole = world.client.get(url)
        tag, date = whole.headers["etag"], whole.headers["last-modified"]
        early = "Mon, 01 Jan 2001 00:00:00 GMT"
        for condition, status in ((tag, 206), (date, 206), (weak(tag), 200), ('"x"', 200), (early, 200)):
            headers = {"Range": "bytes=0-0", "If-Range": condition}
            assert world.client.get(url, headers=headers).status_code == status, condition
        both = {"Range": "bytes=0-0", "If-None-Match": tag}
        assert world.client.get(url, headers=both).status_code == 304


def test_a_side_file_is_replaced_only_on_conditions_that_hold(world: HttpWorld):
    url = f"/scenes/{world.values['scene_id']}/files/a.json"

    def put(content: bytes, **headers: str) -> int:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        return world.client.put(url, content=content, headers=named).status_code

    assert put(b"{}", If_Match='"x"') == 412
    assert put(b"{}", If_None_Match="*") == 200
    tag = world.client.get(url).headers["etag"]
    assert put(b"[1]", If_None_Match="*") == put(b"[1]", If_Match='"x"') == 412
    assert world.client.get(url).content == b"{}"
    assert put(b"[1]", If_Match=tag) == 200
    assert world.client.get(url).content == b"[1]"
    assert world.client.get(url).headers["etag"] != tag


def test_a_cache_learns_what_decided_on_a_reply(world: HttpWorld):
    by_accept = world.client.get("/collections", headers={"Accept": "text/html"})
    assert {"Accept", "Origin"} <= set(by_accept.headers["vary"].split(", "))
    assert "Accept" not in world.client.get("/collections?f=html").headers["vary"].split(", ")


READ = """
import sys, rasterio
from rasterio.windows import Window
with rasterio.Env(GDAL_HTTP_HEADERS=sys.argv[2], GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR"):
    with rasterio.open(f"/vsicurl/{sys.argv[1]}") as image:
        print(int(image.read(1, window=Window(900, 900, 1, 1))[0, 0]))
"""


@pytest.mark.long
def test_gdal_reads_an_image_of_a_scene_by_ranges(
    world: HttpWorld, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    pixels = np.random.default_rng(1).integers(1, 255, (1, 1024, 1024), dtype=np.uint8)
    shape = {"width": 1024, "height": 1024, "count": 1, "dtype": "uint8"}
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", tiled=True, **shape) as image:
        image.write(pixels)
    content = (tmp_path / "a.tif").read_bytes()
    scene = world.client.post("/scenes?name=large.tif", content=content).json()["id"]
    caplog.set_level(logging.INFO, "amers.requests")
    caplog.clear()
    authorization = f"Authorization: Bearer {world.client.headers['Authorization'].split()[1]}"
    with listening(world.app) as url:
        address = f"{url}/scenes/{scene}/files/large.tif"
        done = subprocess.run(
            [sys.executable, "-c", READ, address, authorization],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert (done.returncode, done.stdout) == (0, f"{pixels[0, 900, 900]}\n"), done.stderr
    # Records of other loggers, such as warnings of a slow machine, are not of requests.
    requests = [record for record in caplog.records if record.name == "amers.requests"]
    statuses = {(one.getMessage().split()[0], vars(one)["status"]) for one in requests}
    assert ("GET", 206) in statuses
    assert {status for _, status in statuses} <= {200, 206}


def test_a_file_in_a_bucket_is_sent_like_one_in_a_folder(
    dsn: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    bearer: Bearer,
):
    with running_bucket(monkeypatch) as bucket:
        settings = Settings(database_url=dsn, data_folder=tmp_path / "data", storage_url=bucket)
        with TestClient(create_app(settings), headers=bearer("register")) as client:
            scene = client.post("/scenes?name=a.tif", content=TIFF).json()["id"]
            url = f"/scenes/{scene}/files/a.tif"
            whole = client.get(url)
            tag, date = whole.headers["etag"], whole.headers["last-modified"]
            assert whole.content == TIFF
            part = client.get(url, headers={"Range": "bytes=100-199", "If-Range": tag})
            assert (part.status_code, part.content) == (206, TIFF[100:200])
            several = client.get(url, headers={"Range": "bytes=0-3,-5"})
            assert several.headers["content-type"].startswith("multipart/byteranges")
            assert TIFF[-5:] in several.content
            head = client.head(url)
            assert headers_of(head) == headers_of(whole)
            for held in ({"If-None-Match": weak(tag)}, {"If-Modified-Since": date}):
                assert client.get(url, headers=held).status_code == 304
            assert client.get(url, headers={"Range": f"bytes={len(TIFF)}-"}).status_code == 416
