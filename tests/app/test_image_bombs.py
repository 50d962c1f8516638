"""Small files that expand, loop or lie about their lengths, through the service to a real worker."""

import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio

from amers.app.config import MEBIBYTE
from tests.app.bad_images import LONG, SHORT, always, jpeg2000, rpc, tiff
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.flat_world import FlatWorld, make_flat_world
from tests.app.hostile_installation import CANARY, LEFT_BY_JOBS, Installation, hostile_installation
from tests.app.worker_processes import running_worker, wait_until
from tests.statements import run_in

pytestmark = [pytest.mark.long, pytest.mark.security]

GOLDEN = Path(__file__).parents[1] / "golden"
MEMORY_BYTES = 768 * MEBIBYTE
JOB_S = 60.0
PATIENCE_S = 420.0
NITF = (GOLDEN / "invented_rpc00b.ntf").read_bytes()
NITF_HEADER = 404
FILE_LENGTH, HEADER_LENGTH, SEGMENTS = 342, 354, 360
"""Positions of fields in the file header of the golden NITF."""
LEFT_BY_WORKERS = (*LEFT_BY_JOBS, "procrastinate_workers", "installation")
LEFT_BY_WORKERS += ("installation.json",)

Make = Callable[[FlatWorld], bytes]


def expanding(size: int, **profile: object) -> Make:
    """An image of zeros in one of the compressions of GDAL, as far as the limit of uploads allows."""

    def make(world: FlatWorld) -> bytes:
        with rasterio.MemoryFile() as file:
            shape = {"width": size, "height": size, "count": 1, "dtype": "uint8"}
            with file.open(driver="GTiff", **shape | profile) as image:
                if not profile.get("sparse_ok"):
                    rows = np.zeros((512, size), shape["dtype"])
                    for first in range(0, size, 512):
                        window = rasterio.windows.Window(0, first, size, min(512, size - first))
                        image.write(rows[: window.height], 1, window=window)
            return bytes(file.read())

    return make


def directories(count: int) -> bytes:
    """A TIFF of so many directories without entries, after that of an image."""
    first = 520
    image = tiff(following=first + 200)
    content = bytearray(image.ljust(first + 200, b"\0"))
    for _ in range(count):
        content += struct.pack("<HI", 0, len(content) + 6)
    return bytes(content[:-4]) + bytes(4)


def overviews(target: int) -> bytes:
    """A TIFF whose only directory names a directory of smaller copies: itself, or none."""
    return tiff(t330=(LONG, target))


def many_tiles() -> bytes:
    """A TIFF of 2^31 pixels in tiles of 16 x 16, whose tables lie beyond its end."""
    return tiff(
        t256=(LONG, 2**17), t257=(LONG, 2**17), t322=(SHORT, 16), t323=(SHORT, 16), t324=(LONG, 2**31)
    )


def nitf(position: int, text: str, tail: bytes = b"") -> bytes:
    """The golden NITF with other bytes in its header."""
    content = bytearray(NITF)
    content[position : position + len(text)] = text.encode()
    return bytes(content) + tail


def nitf_record(length: str) -> bytes:
    """The golden NITF whose record of the model declares another length."""
    return NITF.replace(b"RPC00B01041", b"RPC00B" + length.encode())


def nitf_extension(name: str, data: bytes, overflow: str = "") -> bytes:
    """The golden NITF with a data extension segment whose own lengths are right.

    Args:
        name: of the extension (DESID).
        data: of the extension.
        overflow: for TRE_OVERFLOW, the header and the item that its records belong to.
    """
    number = SEGMENTS + 28
    subheader = f"DE{name:<25}01U".ljust(197).encode() + overflow.encode() + b"0000"
    lengths = f"001{len(subheader):04d}{len(data):09d}".encode()
    content = bytearray(NITF[:number] + lengths + NITF[number + 3 :] + subheader + data)
    content[FILE_LENGTH:HEADER_LENGTH] = f"{len(content):012d}".encode()
    content[HEADER_LENGTH:SEGMENTS] = f"{NITF_HEADER + len(lengths) - 3:06d}".encode()
    return bytes(content)


BOMBS: dict[str, tuple[str, Make]] = {
    "deflate": ("scene.tif", expanding(6_000, compress="deflate", zlevel=9, blockysize=512)),
    "zstd": ("scene.tif", expanding(10_000, compress="zstd", blockysize=512)),
    "zstd of one strip": ("scene.tif", expanding(8_000, compress="zstd", blockysize=8_000)),
    "lerc": ("scene.tif", expanding(6_000, compress="lerc", blockysize=512)),
    "lerc and zstd": ("scene.tif", expanding(6_000, compress="lerc_zstd", blockysize=512)),
    "lzw": ("scene.tif", expanding(6_000, compress="lzw", blockysize=512)),
    "jpeg": ("scene.tif", expanding(6_000, compress="jpeg", tiled=True)),
    "packbits": ("scene.tif", expanding(4_000, compress="packbits")),
    "a tile larger than memory": (
        "scene.tif",
        expanding(30_000, tiled=True, blockxsize=29_952, blockysize=29_952, sparse_ok=True),
    ),
    "nothing but holes": ("scene.tif", expanding(60_000, tiled=True, sparse_ok=True, bigtiff="yes")),
    "tiny tiles": ("scene.tif", always(many_tiles())),
    "700,000 directories": ("scene.tif", always(directories(700_000))),
    "a copy that is itself": ("scene.tif", always(overviews(520))),
    "a copy beyond the end": ("scene.tif", always(overviews(2**31))),
    "a strip of 4 GB in lerc": ("scene.tif", always(tiff(t259=(SHORT, 34_887), t279=(LONG, 2**32 - 1)))),
    "a strip of 4 GB in zstd": ("scene.tif", always(tiff(t259=(SHORT, 50_000), t279=(LONG, 2**32 - 1)))),
    "jpeg 2000 of a gigapixel": ("scene.jp2", always(jpeg2000(40_000, 40_000))),
    "nitf of 999 images": ("scene.ntf", always(nitf(SEGMENTS, "999"))),
    "nitf of a long header": ("scene.ntf", always(nitf(HEADER_LENGTH, "999999"))),
    "nitf of an endless file": ("scene.ntf", always(nitf(FILE_LENGTH, "999999999999"))),
    "nitf of an endless image": ("scene.ntf", always(nitf(SEGMENTS + 9, "9999999999"))),
    "nitf of an endless image header": ("scene.ntf", always(nitf(SEGMENTS + 3, "999999"))),
    "nitf of 999 data extensions": ("scene.ntf", always(nitf(SEGMENTS + 19 + 9, "999"))),
    "nitf of an endless extension": ("scene.ntf", always(nitf(394, "99999"))),
    "nitf of an endless record": ("scene.ntf", always(nitf_record("99999"))),
    "nitf of a negative record": ("scene.ntf", always(nitf_record("-1041"))),
    "nitf of an empty record": ("scene.ntf", always(nitf_record("00000"))),
    "nitf with an entity in its extension": (
        "scene.ntf",
        always(
            nitf_extension(
                "XML_DATA_CONTENT",
                b"<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///etc/passwd'>]><a>&b;</a>",
            )
        ),
    ),
    "nitf with lying records in its extension": (
        "scene.ntf",
        always(nitf_extension("TRE_OVERFLOW", b"RPC00B99999" + b"9" * 1041, "UDID  001")),
    ),
    "nitf with a catalogue of numbers in its extension": (
        "scene.ntf",
        always(nitf_extension("CSATTB DES", b"9" * 200_000)),
    ),
    "nitf of 10^16 pixels": (
        "scene.ntf",
        always(NITF.replace(b"0000003200000048INT", b"9999999999999999INT")),
    ),
    "nitf of blocks without number": (
        "scene.ntf",
        always(NITF.replace(b"00010001004800320", b"99999999000100010")),
    ),
}
PAM = (
    "<PAMDataset><Metadata domain='OVERVIEWS'><MDI key='OVERVIEW_FILE'>{}</MDI></Metadata></PAMDataset>"
)


def model_of(content: bytes) -> str:
    """A model that covers the whole image, so that its job goes on to the pixels."""
    try:
        with rasterio.MemoryFile(content) as file, file.open() as image:
            half = str(image.height // 2)
    except rasterio.errors.RasterioError:
        half = "300"
    return rpc(dict.fromkeys(("LINE_OFF", "LINE_SCALE", "SAMP_OFF", "SAMP_SCALE"), half))


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"), size=600)


@pytest.fixture(scope="module")
def store(cluster, world: FlatWorld, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    folder = tmp_path_factory.mktemp("hostile_installation")
    with fresh_database(cluster, TEMPLATE) as dsn, hostile_installation(dsn, folder, world) as store:
        yield store


@pytest.mark.endurance
def test_bombs_end_as_failed_jobs_within_their_limits(
    store: Installation, world: FlatWorld, tmp_path: Path
):
    me = store.headers["register"]
    others_job = f"/jobs/{store.names['others_job']}"
    assert store.client.delete(others_job, headers=store.headers["other"]).status_code == 200
    limits = {"job_memory_bytes": MEMORY_BYTES, "job_seconds": JOB_S}
    before = store.digest(LEFT_BY_WORKERS)
    jobs: dict[str, str] = {}
    for name, (file_name, make) in BOMBS.items():
        content = make(world)
        sent = store.client.post(f"/scenes?name={file_name}&sigma_m=6", content=content, headers=me)
        assert sent.status_code == 201, (name, len(content), sent.text)
        scene = sent.json()["id"]
        beside = {f"{file_name}.aux.xml": PAM.format(store.outside / "canary.txt")}
        if file_name != "scene.ntf":  # which brings its own model
            beside["scene_RPC.TXT"] = model_of(content)
        for side_name, text in beside.items():
            url = f"/scenes/{scene}/files/{side_name}"
            assert store.client.put(url, content=text.encode(), headers=me).status_code == 200
        inputs = {"scene": scene}
        body = {"inputs": inputs}
        reply = store.client.post("/processes/register-scene/execution", json=body, headers=me)
        assert reply.status_code == 201, reply.text
        jobs[name] = reply.json()["jobID"]
    settings = store.settings.model_copy(update=limits)
    storage = settings.data_folder / "storage"
    with running_worker(settings, tmp_path / "log") as worker:

        def open_jobs() -> list[str]:
            assert store.client.get("/healthz").status_code == 200
            documents = {
                name: store.client.get(f"/jobs/{job}", headers=me) for name, job in jobs.items()
            }
            return [
                name
                for name, job in documents.items()
                if job.json()["status"] in ("accepted", "running")
            ]

        wait_until(lambda: not open_jobs(), f"{len(jobs)} jobs end", PATIENCE_S)
        assert worker.poll() is None, "the worker lives"
    rows = run_in(store.database.transaction(), "select id::text, state, attempt, error from job")
    ended = {row["id"]: row for row in rows}
    for name, job in jobs.items():
        outcome = ended[job]
        assert (outcome["state"], outcome["attempt"]) == ("failed", 1), (name, outcome)
        assert outcome["error"]["title"] not in ("Internal error", "Time limit"), (name, outcome)
        assert CANARY not in json.dumps(outcome["error"])
    # Each failed job leaves its report, and nothing else changes.
    left = store.digest((*LEFT_BY_WORKERS, "result_file", "results"))
    assert left == {key: value for key, value in before.items() if key in left}
    assert {key for key in before if key not in left} == {"result_file"}
    for job in jobs.values():
        files = {path.name for path in (storage / "results" / job).rglob("*") if path.is_file()}
        assert files == {"report.html", "report.json", "report.txt"}


@pytest.mark.parametrize("suffix", [".ovr", ".aux", ".vrt", ".png", ".hdr", ".lrc"])
def test_side_files_that_a_driver_would_follow_are_refused(store: Installation, suffix: str):
    me = store.headers["register"]
    scene = store.names["own_scene"]
    for name in (f"a.tif{suffix}", f"a{suffix}"):
        reply = store.client.put(f"/scenes/{scene}/files/{name}", content=b"II*\0", headers=me)
        assert reply.status_code == 422, reply.text


@pytest.mark.parametrize(
    "content",
    [
        b"<VRTDataset rasterXSize='1' rasterYSize='1'/>",
        b"<?xml version='1.0'?><VRTDataset/>",
        b"<GDAL_WMS><Service name='TMS'><ServerUrl>http://127.0.0.1:9/</ServerUrl></Service></GDAL_WMS>",
        b"\xef\xbb\xbf<OGRVRTDataSource/>",
        b"\x89PNG\r\n\x1a\n" + bytes(100),
        b"\xff\xd8\xff\xe0" + bytes(100),
        b"Lerc2 " + bytes(100),
        b"GIF89a" + bytes(100),
        b"BM" + bytes(100),
        b"GTXR" + bytes(100),
    ],
)
def test_other_formats_that_call_themselves_tiff_are_refused(store: Installation, content: bytes):
    me = store.headers["register"]
    reply = store.client.post("/scenes?name=scene.tif", content=content, headers=me)
    assert reply.status_code == 422
    assert "neither TIFF" in reply.json()["detail"]
