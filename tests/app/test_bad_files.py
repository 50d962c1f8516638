"""Damaged, absurd and hostile files: the API or the job refuses them with the reason."""

import hashlib
import io
import json
import pickle
from base64 import b64encode
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from amers.app.usecases.report_files import REPORT_FILES
from tests.app.bad_images import ARCHIVES, IMAGES, MODELS, BadScene, folder_archive
from tests.app.bad_requests import BAD_REQUESTS
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.flat_world import FlatWorld, make_flat_world
from tests.app.hostile_installation import (
    CANARY,
    LEFT_BY_JOBS,
    Installation,
    hostile_installation,
    told,
)
from tests.factories import make_block

pytestmark = pytest.mark.security

TUS = {"Tus-Resumable": "1.0.0"}
Files = dict[str, bytes]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"), size=600)


@pytest.fixture(scope="module")
def store(cluster, world, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    """One installation for all cases; they leave only files of scenes, failed jobs and their reports."""
    folder = tmp_path_factory.mktemp("hostile_installation")
    with fresh_database(cluster, TEMPLATE) as dsn, hostile_installation(dsn, folder, world) as store:
        yield store


def refused(store: Installation, reply: httpx.Response, says: str) -> None:
    """Check that a reply is a clear 4xx that discloses nothing of this machine."""
    assert 400 <= reply.status_code < 500, f"{reply.status_code} {reply.text[:300]}"
    assert says in reply.json()["detail"], reply.json()
    keeps_secrets(store, told(reply))


def failed(store: Installation, job: dict[str, Any], says: str) -> None:
    """Check that a job failed for good with its reason."""
    assert job["status"] == "failed", job
    assert says in json.dumps(job["error"]), job["error"]
    assert job["error"]["error"] not in ("Internal error", ""), job
    keeps_secrets(store, json.dumps(job))


def keeps_secrets(store: Installation, text: str) -> None:
    assert CANARY not in text
    assert "Traceback" not in text
    assert str(store.settings.data_folder) not in text
    assert "/tmp/" not in text, text


def sent(store: Installation, content: bytes, who: str, **metadata: str) -> httpx.Response:
    """The reply to the only piece of a tus upload."""
    metadata_header = ",".join(
        f"{key} {b64encode(value.encode()).decode()}" for key, value in metadata.items()
    )
    headers = store.headers[who] | TUS
    begun = store.client.post(
        "/uploads",
        headers=headers | {"Upload-Length": str(len(content)), "Upload-Metadata": metadata_header},
    )
    assert begun.status_code == 201, begun.text
    headers |= {"Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    reply = store.client.patch(begun.headers["location"], content=content, headers=headers)
    reply.headers["amers-upload"] = begun.headers["location"].rsplit("/", 1)[1]
    return reply


@pytest.mark.parametrize("case", [*IMAGES, *MODELS], ids=lambda case: case.name)
def test_a_bad_scene_is_refused_or_its_job_fails_with_the_reason(
    store: Installation, world, case: BadScene
):
    before = store.digest(LEFT_BY_JOBS)
    me, outside = store.headers["register"], str(store.outside)
    image = case.image(world)
    sent = store.client.post(f"/scenes?name={case.file_name}&sigma_m=6", content=image, headers=me)
    assert sent.status_code == 201, sent.text
    scene = sent.json()["id"]
    for name, text in case.models.items():
        content = text.replace("<outside>", outside).encode() if isinstance(text, str) else text
        beside = store.client.put(f"/scenes/{scene}/files/{name}", content=content, headers=me)
        assert beside.status_code == 200, beside.text
    inputs = {"scene": scene} | ({"model": store.filled(case.model)} if case.model else {})
    reply = store.client.post("/processes/register-scene/execution", json={"inputs": inputs}, headers=me)
    if reply.status_code == 201:
        job = store.outcome(reply)
        failed(store, job, case.says)
        added = {f"results/{job['jobID']}/1/{name}" for name in REPORT_FILES}
    else:
        refused(store, reply, case.says)
        added = set()
    after = store.digest(LEFT_BY_JOBS)
    changed = {name for name in after | before if after.get(name) != before.get(name)}
    assert changed == added | ({"result_file"} if added else set())
    for name in added:
        keeps_secrets(store, (store.settings.data_folder / "storage" / name).read_text())


@pytest.mark.parametrize(("name", "says", "content"), ARCHIVES, ids=[case[0] for case in ARCHIVES])
def test_a_bad_archive_is_refused_and_forgotten(
    store: Installation, name: str, says: str, content: bytes
):
    before = store.digest()
    refused(store, sent(store, content, "register", filename="delivery.zip"), says)
    assert store.digest() == before


def signed(files: Files) -> None:
    """Update the checksums, so that only the intended change is wrong."""
    document = json.loads(files["block/block.json"])
    for name in document["amers:checksums"]:
        if f"block/{name}" in files:
            document["amers:checksums"][name] = hashlib.sha256(files[f"block/{name}"]).hexdigest()
    files["block/block.json"] = json.dumps(document).encode()


def said(change: Callable[[dict[str, Any]], Any]) -> Callable[[Files], None]:
    """A change of block.json."""

    def spoil(files: Files) -> None:
        document = json.loads(files["block/block.json"])
        change(document)
        files["block/block.json"] = json.dumps(document).encode()

    return spoil


def chips(make: Callable[[np.ndarray], bytes]) -> Callable[[Files], None]:
    """Other bytes for the chip file, with the right checksum."""

    def spoil(files: Files) -> None:
        files["block/chips/0000.npy"] = make(np.load(io.BytesIO(files["block/chips/0000.npy"])))
        signed(files)

    return spoil


def column(file: str, name: str, change: Callable[[list[Any]], list[Any]]) -> Callable[[Files], None]:
    """Other values in a column of a table, with the right checksum."""

    def spoil(files: Files) -> None:
        table = pq.read_table(io.BytesIO(files[f"block/{file}"]))
        index = table.schema.get_field_index(name)
        assert index >= 0, table.schema.names
        kind = table.schema.field(index)
        changed = pa.array(change(table[name].to_pylist()), kind.type)
        out = io.BytesIO()
        pq.write_table(table.set_column(index, kind, changed), out)
        files[f"block/{file}"] = out.getvalue()
        signed(files)

    return spoil


def raw(name: str, content: bytes) -> Callable[[Files], None]:
    def spoil(files: Files) -> None:
        files[f"block/{name}"] = content
        if name != "block.json":
            signed(files)

    return spoil


def saved(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


class Harm:
    """The action of a pickle, if code unpickled it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, ("/tmp/amers-pickle-was-opened", "w"))


def pickled(array: np.ndarray) -> bytes:
    header = b"\x93NUMPY\x01\x00"
    text = b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }".ljust(117) + b"\n"
    return header + len(text).to_bytes(2, "little") + text + pickle.dumps(Harm())


def huge_header(array: np.ndarray) -> bytes:
    header = b"\x93NUMPY\x01\x00"
    text = b"{'descr': '<u2', 'fortran_order': False, 'shape': (99999999999, 101, 101), }".ljust(117)
    return header + (118).to_bytes(2, "little") + text + b"\n"


def point(x: float, y: float, h: float) -> bytes:
    return b"\x01" + (1001).to_bytes(4, "little") + np.array([x, y, h], "<f8").tobytes()


def first(value: Any) -> Callable[[list[Any]], list[Any]]:
    return lambda values: [value, *values[1:]]


DEEP = b"[" * 100_000
BLOCKS: list[tuple[str, str, Callable[[Files], None]]] = [
    ("without its document", "block.json", lambda files: files.pop("block/block.json")),
    ("whose document is no JSON", "block.json", raw("block.json", b"{")),
    ("whose document is empty", "block.json", raw("block.json", b"")),
    ("whose document is a list", "block.json", raw("block.json", b"[]")),
    ("whose document is deep", "block.json", raw("block.json", DEEP)),
    ("whose document is not UTF-8", "block.json", raw("block.json", b'{"id": "\xff"}')),
    ("whose document holds NaN", "block.json", said(lambda d: d.update({"amers:epoch": float("nan")}))),
    ("whose name is a path", "id", said(lambda d: d.update(id="../../etc/passwd"))),
    ("whose name is SQL", "id", said(lambda d: d.update(id="x'; drop table block; --"))),
    ("whose name is a number", "id", said(lambda d: d.update(id=7))),
    ("without checksums", "checksums", said(lambda d: d.pop("amers:checksums"))),
    (
        "that names a file outside",
        "block.json",
        said(lambda d: d["amers:checksums"].update({"../outside/canary.txt": "0" * 64})),
    ),
    (
        "that names an absolute file",
        "block.json",
        said(lambda d: d["amers:checksums"].update({"/etc/passwd": "0" * 64})),
    ),
    (
        "with a checksum that is none",
        "block.json",
        said(lambda d: d["amers:checksums"].update({"points.parquet": 7})),
    ),
    ("of another format", "block.json", said(lambda d: d.update({"amers:format": "amers-block/99"}))),
    ("with a file nobody named", "stray.txt", lambda files: files.update({"block/stray.txt": b"x"})),
    ("without its points", "points.parquet", lambda files: files.pop("block/points.parquet")),
    (
        "whose points are no Parquet",
        "points.parquet",
        raw("points.parquet", b"PAR1" + bytes(100) + b"PAR1"),
    ),
    (
        "whose points are cut",
        "points.parquet",
        lambda files: (
            files.update({"block/points.parquet": files["block/points.parquet"][:-300]}) or signed(files)
        ),
    ),
    ("of points without their columns", "points.parquet", raw("points.parquet", b"")),
    (
        "of points beyond the Earth",
        "points.parquet",
        column("points.parquet", "geometry", first(point(5.25, 143.2, 100.0))),
    ),
    (
        "of points infinitely high",
        "points.parquet",
        column("points.parquet", "geometry", first(point(5.25, 43.2, np.inf))),
    ),
    (
        "of points of 200 km height",
        "points.parquet",
        column("points.parquet", "geometry", first(point(5.25, 43.2, 2e5))),
    ),
    (
        "of points outside its outline",
        "points.parquet",
        column("points.parquet", "geometry", first(point(95.0, 43.2, 100.0))),
    ),
    (
        "of a geometry that is none",
        "points.parquet",
        column("points.parquet", "geometry", first(b"\x01\x02")),
    ),
    (
        "of a geometry that is a polygon",
        "points.parquet",
        column("points.parquet", "geometry", first(b"\x01\x03\0\0\0\0\0\0\0")),
    ),
    (
        "whose chips lie elsewhere",
        "chip_file",
        column("points.parquet", "chip_file", first("/etc/passwd")),
    ),
    (
        "whose chips lie above",
        "chip_file",
        column("points.parquet", "chip_file", first("../outside/canary.txt")),
    ),
    ("whose chips are beyond their file", "chip", column("points.parquet", "chip_row", first(10**9))),
    ("whose chips are before their file", "chip", column("points.parquet", "chip_row", first(-1))),
    ("with a point twice", "points.parquet", column("points.parquet", "id", lambda v: [v[1], *v[1:]])),
    ("whose views are no Parquet", "views.parquet", raw("views.parquet", b"x" * 100)),
    ("whose views are of no point", "views.parquet", column("views.parquet", "point_id", first(10**12))),
    (
        "whose views are at NaN metres",
        "views.parquet",
        column("views.parquet", "gsd_m", first(float("nan"))),
    ),
    ("whose chips are missing", "chips/0000.npy", lambda files: files.pop("block/chips/0000.npy")),
    ("whose chips are a pickle", "chips/0000.npy", chips(pickled)),
    ("whose chips declare 2 PB", "chips/0000.npy", chips(huge_header)),
    ("whose chips are real numbers", "chips/0000.npy", chips(lambda a: saved(a.astype(np.float64)))),
    ("whose chips are of another size", "chips/0000.npy", chips(lambda a: saved(a[:, :50, :50]))),
    ("whose chips are cut", "chips/0000.npy", chips(lambda a: saved(a)[:-1000])),
    ("whose chips are text", "chips/0000.npy", chips(lambda a: b"not an array")),
]


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory):
    folder = tmp_path_factory.mktemp("block") / "good"
    return make_block(folder, count=6, n_images=2, gsds_m=(2.0,), name="besieging").folder


@pytest.mark.parametrize(("name", "says", "spoil"), BLOCKS, ids=[f"block {case[0]}" for case in BLOCKS])
def test_a_bad_block_is_refused_by_its_job_with_the_reason(
    store: Installation, block, name, says, spoil
):
    before = store.digest(LEFT_BY_JOBS)
    uploaded = sent(store, folder_archive(block, spoil), "admin", filename="b.zip", purpose="block")
    assert uploaded.status_code == 204, uploaded.text
    body = {"upload": uploaded.headers["amers-upload"], "publish": True}
    reply = store.client.post("/blocks", json=body, headers=store.headers["admin"])
    assert reply.status_code == 201, reply.text
    failed(store, store.outcome(reply), says)
    assert store.digest(LEFT_BY_JOBS) == before


@pytest.mark.parametrize(
    "path", ["way-out", "way-out/block", "../outside", "/etc", "nowhere", "a\0b", "", "."], ids=repr
)
def test_a_folder_that_is_not_to_be_ingested_is_refused(store: Installation, path: str):
    before = store.digest(LEFT_BY_JOBS)
    reply = store.client.post("/blocks", json={"path": path}, headers=store.headers["admin"])
    if reply.status_code == 201:
        failed(store, store.outcome(reply), "")
    else:
        refused(store, reply, "")
    assert store.digest(LEFT_BY_JOBS) == before


def test_the_pattern_of_the_bad_blocks_is_good(store: Installation, block):
    uploaded = sent(store, folder_archive(block, signed), "admin", filename="b.zip", purpose="block")
    reply = store.client.post(
        "/blocks", json={"upload": uploaded.headers["amers-upload"]}, headers=store.headers["admin"]
    )
    assert store.outcome(reply)["status"] == "successful"


def test_no_two_bad_files_have_one_name():
    names = [*(case.name for case in (*IMAGES, *MODELS)), *(case[0] for case in (*ARCHIVES, *BLOCKS))]
    assert len(set(names)) == len(names) >= 100
    assert not set(names) & {case.name for case in BAD_REQUESTS}
