"""Images in a bucket and on a server, read where they are; a cluster makes the same block of them."""

import json
import logging
import os
import pickle
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import obstore
import pytest
import rasterio.shutil
from obstore.store import S3Store

from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import (
    ProductionImages,
    WorkPlace,
    _file_facts,
    run_image_production,
)
from amers.app.usecases.image_selection import CatalogueRequest, run_selection
from amers.app.usecases.new_block import BlockIdentity
from amers.services.errors import FormatError
from amers.services.formats import addresses
from amers.services.formats.addresses import BLOCK_BYTES, Address, file_place
from amers.services.formats.images.raster import open_raster, write_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.rpc_text import format_rpb, format_rpc_text
from amers.services.imagery.scene import scene_footprint
from amers.services.imagery.source import Window
from tests.app.s3_server import running_bucket
from tests.app.test_production_run import content, dask_cluster
from tests.command_line import amers_here
from tests.services.simulated import BLOCK_SIGMA_M, OPTIONS, block_views

SECRET = "of%20a%20test-secret"
WINDOW = Window(700, 900, 300, 200)


class Bucket:
    """A bucket of a local server."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._name, _, self._prefix = url.removeprefix("s3://").partition("/")
        self._store = S3Store(self._name, client_options={"allow_http": True})

    def put(self, key: str, file: bytes | Path) -> Address:
        obstore.put(self._store, f"{self._prefix}/{key}", file)
        return Address(f"{self.url}/{key}")

    def delete(self, key: str) -> None:
        obstore.delete(self._store, f"{self._prefix}/{key}")


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bucket]:
    with running_bucket(monkeypatch) as url:
        yield Bucket(url)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An image of 18 MB of noise, which nothing compresses, with a model beside it."""
    folder = tmp_path_factory.mktemp("noise")
    pixels = np.random.default_rng(5).integers(1, 60000, (3000, 3000), dtype=np.uint16)
    write_raster(folder / "noise é.tif", pixels)
    return folder / "noise é.tif"


@pytest.fixture
def read_bytes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Lengths of all ranges that are read; no range is in memory."""
    lengths: list[int] = []
    read = Address.read_range

    def counted(address: Address, start: int, length: int) -> bytes:
        lengths.append(length)
        return read(address, start, length)

    monkeypatch.setattr(Address, "read_range", counted)
    return lengths


@pytest.mark.long
def test_an_image_in_a_bucket_is_read_by_parts_and_pixel_for_pixel(bucket, image, read_bytes) -> None:
    at = open_raster(bucket.put("a folder/noise é.tif", image))
    here = open_raster(image)
    np.testing.assert_array_equal(at.read(WINDOW), here.read(WINDOW))
    assert sum(read_bytes) < 0.4 * image.stat().st_size, read_bytes
    whole = Window(-10, 0, 3020, 3000)
    np.testing.assert_array_equal(at.read(whole), here.read(whole))
    before = len(read_bytes)
    again = pickle.loads(pickle.dumps(at))
    np.testing.assert_array_equal(again.read(WINDOW), here.read(WINDOW))
    assert len(read_bytes) == before, "parts in memory were read again"
    for opened in (at, here, again):
        opened.close()


@pytest.mark.long
def test_the_parts_in_memory_are_bounded(bucket, image, monkeypatch) -> None:
    monkeypatch.setattr(addresses, "KEPT_BLOCKS", 5)
    kept = addresses._KeptBlocks()
    monkeypatch.setattr(addresses, "_KEPT", kept)
    at, here = open_raster(bucket.put("noise.tif", image)), open_raster(image)
    np.testing.assert_array_equal(at.read(Window(0, 0, 3000, 3000)), here.read(Window(0, 0, 3000, 3000)))
    assert len(kept._blocks) == 5
    assert max(map(len, kept._blocks.values())) == BLOCK_BYTES
    at.close()


@pytest.mark.parametrize("name", ["scene_RPC.TXT", "scene.RPB", "inside"])
def test_the_model_beside_an_image_in_a_bucket_is_found(bucket, tmp_path, name) -> None:
    view = block_views()[0]
    path = tmp_path / "scene.tif"
    write_raster(path, view.pixels, view.geometry.delivered if name == "inside" else None)
    if name != "inside":
        form = format_rpb if name.endswith("RPB") else format_rpc_text
        (tmp_path / name).write_text(form(view.geometry.delivered))
        bucket.put(name, tmp_path / name)
    there, here = read_scene(bucket.put("scene.tif", path)), read_scene(path)
    assert pickle.dumps(there.model) == pickle.dumps(here.model)
    assert there.acquisition == here.acquisition
    assert there.sigma_m == here.sigma_m


def test_an_image_without_a_model_names_what_is_missing(bucket, image) -> None:
    with pytest.raises(FormatError, match=r"s3://.*noise\.tif: no sensor model found.*noise_RPC\.TXT"):
        read_scene(bucket.put("noise.tif", image))


def test_a_missing_object_is_named_with_what_to_do(bucket) -> None:
    message = (
        r"s3://[\w-]+/test/none\.tif: nothing found there, a file expected; correct .*AWS_ENDPOINT_URL"
    )
    with pytest.raises(FormatError, match=message):
        open_raster(Address(f"{bucket.url}/none.tif"))


def test_a_bucket_that_does_not_answer_is_named(monkeypatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_SKIP_SIGNATURE", "true")
    with pytest.raises(FormatError, match=r"s3://nobody/a\.tif: no usable reply .*where workers run"):
        open_raster(Address("s3://nobody/a.tif"))


def test_what_is_no_image_in_a_bucket_is_refused_like_a_file(bucket) -> None:
    with pytest.raises(FormatError, match=r"a\.tif: expected a GeoTIFF, JPEG 2000 or NITF image"):
        open_raster(bucket.put("a.tif", b"<VRTDataset/>"))


@pytest.mark.parametrize("name", ["a.tif", "a.jp2", "a.ntf"])
@pytest.mark.thorough
def test_an_image_that_vanishes_gives_an_error_and_no_pixels(bucket, image, tmp_path, name) -> None:
    driver = {"a.tif": "GTiff", "a.jp2": "JP2OpenJPEG", "a.ntf": "NITF"}[name]
    exact = {"QUALITY": "100", "REVERSIBLE": "YES"} if name == "a.jp2" else {}
    rasterio.shutil.copy(image, tmp_path / name, driver=driver, **exact)
    at, here = open_raster(bucket.put(name, tmp_path / name)), open_raster(tmp_path / name)
    np.testing.assert_array_equal(at.read(Window(0, 0, 5, 5)), here.read(Window(0, 0, 5, 5)))
    bucket.delete(name)
    addresses._KEPT._blocks.clear()
    for _ in range(2):
        with pytest.raises(FormatError, match=rf"{re.escape(name)}: nothing found there"):
            at.read(Window(1000, 1000, 500, 500))
    at.close()


@pytest.mark.long
def test_a_process_ends_well_with_an_image_open(bucket, image) -> None:
    address = bucket.put("noise.tif", image)
    code = f"""
from amers.services.formats.addresses import Address
from amers.services.formats.images.raster import open_raster
image = open_raster(Address({address.url!r}))
"""
    ended = subprocess.run([sys.executable, "-c", code], env={**os.environ}, check=False)
    assert ended.returncode == 0


# What stays closed


@pytest.mark.parametrize("path", ["s3://bucket/a.tif", "/vsis3/bucket/a.tif", "https://host/a.tif"])
def test_a_path_is_never_an_address(path) -> None:
    """Whatever arrives over the API becomes a path."""
    with pytest.raises(FormatError, match="expected the name of an existing image file"):
        open_raster(Path(path))


def test_only_the_operator_s_production_makes_addresses() -> None:
    """Nothing that callers send becomes one.

    The map of a surface reads a result out of the bucket of the storage, by a key of its own making.
    References and terrains in pieces are those of commands; references of a store are no catalogues.
    Bases are made from catalogues that the operator's settings name.
    """
    root = Path(__file__).parents[2]
    makers = {
        str(file.relative_to(root))
        for folder in ("app", "services")
        for file in (root / folder).rglob("*.py")
        if re.search(r"\b(file_place|read_item_scene)\b|\bAddress\(", file.read_text())
    }
    assert makers == {
        "app/cli/image_production.py",
        "app/usecases/base/windows.py",
        "app/usecases/image_production.py",
        "app/usecases/surface_map.py",
        "services/formats/addresses.py",
        "services/formats/pieces.py",
        "services/formats/stac/documents.py",
        "services/formats/stac/places.py",
        "services/formats/stac/scenes.py",
    }
    importers = [
        file
        for file in (root / "app").rglob("*.py")
        if re.search(r"image_production|image_selection|formats\.stac", file.read_text())
    ]
    assert not [file for file in importers if {"api", "worker"} & set(file.relative_to(root).parts)]


@pytest.mark.parametrize("url", ["https://me:pass-word@host/a.tif", "s3://key:pass-word@bucket/a.tif"])
def test_a_password_in_an_address_is_refused_and_not_repeated(url) -> None:
    with pytest.raises(FormatError, match=r"an address without them expected; set the AWS_") as caught:
        file_place(url)
    assert "pass-word" not in str(caught.value)


@pytest.mark.parametrize("url", ["s3://bucket", "https://host/", "s3:///key"])
def test_an_address_without_a_file_is_refused(url) -> None:
    with pytest.raises(FormatError, match=r"s3://BUCKET/KEY or https://SERVER/FILE expected"):
        file_place(url)


class Server(BaseHTTPRequestHandler):
    """Serves one file to those who send the signature; parts of it unless told otherwise."""

    file: bytes = b""
    ranges = True

    def do_HEAD(self) -> None:
        self._reply(body=False)

    def do_GET(self) -> None:
        self._reply(body=True)

    def _reply(self, *, body: bool) -> None:
        path, _, query = self.path.partition("?")
        status = 200 if path.endswith("/noise%20%C3%A9.tif") else 404
        if query != f"sig={SECRET}":
            status = 403
        content, first = self.file, 0
        wanted = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range") or "")
        if status == 200 and wanted and self.ranges:
            status, first, last = 206, int(wanted[1]), int(wanted[2]) + 1
            content = self.file[first:last]
        self.send_response(status)
        if status == 206:
            end = first + len(content) - 1
            self.send_header("Content-Range", f"bytes {first}-{end}/{len(self.file)}")
        self.send_header("Last-Modified", "Mon, 01 Jan 2024 00:00:00 GMT")
        self.send_header("Content-Length", str(len(content) if status < 300 else 0))
        self.end_headers()
        if body and status < 300:
            self.wfile.write(content)

    def log_message(self, *arguments: object) -> None:
        """Nothing."""


@pytest.fixture
def server(image: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(Server, "file", image.read_bytes())
    with ThreadingHTTPServer(("127.0.0.1", 0), Server) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{running.server_port}"
        running.shutdown()


def test_an_image_on_a_server_is_read_by_parts_and_its_signature_is_told_to_nobody(
    server, image, read_bytes, caplog
) -> None:
    caplog.set_level(logging.DEBUG)
    address = Address(f"{server}/a/noise%20%C3%A9.tif?sig={SECRET}")
    assert (address.name, address.stem) == ("noise é.tif", "noise é")
    at, here = open_raster(address), open_raster(image)
    np.testing.assert_array_equal(at.read(WINDOW), here.read(WINDOW))
    assert sum(read_bytes) < 0.4 * image.stat().st_size
    told = [repr(at), str(address), caplog.text]
    for url in (
        f"{server}/none.tif?sig={SECRET}",
        f"{address.url}x",
        f"http://127.0.0.1:9/a?sig={SECRET}",
    ):
        with pytest.raises(FormatError) as caught:
            open_raster(Address(url))
        told += [str(caught.value), repr(caught.value)]
    assert not [text for text in told if SECRET in text]
    at.close()


def test_a_server_that_sends_no_parts_is_named(server, monkeypatch) -> None:
    monkeypatch.setattr(Server, "ranges", False)
    with pytest.raises(FormatError, match=r"no parts of files .*copy the file into a bucket"):
        open_raster(Address(f"{server}/noise%20%C3%A9.tif?sig={SECRET}"))


# A block


def item(name: str, address: str, geometry: list[list[float]], mask: str) -> dict[str, object]:
    return {
        "type": "Feature",
        "stac_version": "1.1.0",
        "id": name,
        "geometry": {"type": "Polygon", "coordinates": [geometry]},
        "properties": {"datetime": "2024-05-01T10:00:00Z", "eo:cloud_cover": 1},
        "assets": {
            "image": {"href": address, "type": "image/tiff", "roles": ["data"]},
            "clouds": {"href": mask, "type": "application/geo+json", "roles": ["cloud"]},
        },
        "links": [],
    }


def write_catalogue(folder: Path) -> list[Path]:
    """Files: images with their models beside them, cloud masks, an item collection of them all."""
    items = []
    for number, view in enumerate(block_views()):
        name = view.geometry.acquisition.image_id
        write_raster(folder / f"{name}.tif", view.pixels)
        (folder / f"{name}_RPC.TXT").write_text(format_rpc_text(view.geometry.delivered))
        corners = scene_footprint(view.as_scene(BLOCK_SIGMA_M))
        lon, lat = corners.mean(axis=0)
        cloud = [[lon, lat], [lon + 4e-4 * (number + 1), lat], [lon, lat + 4e-4], [lon, lat]]
        mask = {"type": "Polygon", "coordinates": [cloud]}
        (folder / f"{name}.geojson").write_text(json.dumps(mask))
        ring = [*corners.tolist(), corners[0].tolist()]
        items.append(item(name, f"./{name}.tif", ring, f"{name}.geojson"))
    collection = {"type": "FeatureCollection", "features": items}
    (folder / "items.json").write_text(json.dumps(collection))
    return sorted(folder.iterdir())


@pytest.mark.long
@pytest.mark.endurance
def test_a_cluster_makes_the_same_block_from_a_bucket_bit_for_bit(bucket, tmp_path) -> None:
    """Catalogue, masks, images and models lie in the bucket; workers get addresses."""
    images = tmp_path / "images"
    images.mkdir()
    for file in write_catalogue(images):
        bucket.put(f"catalogue/{file.name}", file)
    made = {}
    with dask_cluster(2) as cluster:
        for name, source, place in (
            ("files", str(images / "items.json"), WorkPlace()),
            (
                "bucket",
                f"{bucket.url}/catalogue/items.json",
                WorkPlace(compute=ComputeOptions(cluster=cluster.address)),
            ),
        ):
            (tmp_path / name).mkdir()
            selection = tmp_path / name / "selection"
            run_selection(CatalogueRequest(source), selection)
            if name == "bucket":
                for file in images.iterdir():
                    file.unlink()
            given = ProductionImages(selection=selection, sigma_m=BLOCK_SIGMA_M)
            run_image_production(
                given, tmp_path / name / "block", BlockIdentity("made"), OPTIONS, place=place
            )
            made[name] = content(tmp_path / name / "block")
    assert made["bucket"] == made["files"]
    told = [file.read_bytes() for file in (tmp_path / "bucket").rglob("*.json")]
    assert not any(b"of a test" in text for text in told), "credentials in a document"


def test_an_interrupted_production_knows_the_images_of_a_bucket_again(bucket, image) -> None:
    address = bucket.put("noise.tif", image)
    facts = _file_facts(address)
    assert facts == _file_facts(replace(address))
    assert facts["bytes"] == image.stat().st_size
    bucket.put("noise.tif", image.read_bytes()[:-1])
    assert _file_facts(address) != facts


@pytest.mark.parametrize("words", [("--images", "{url}/none.tif"), ("--catalogue", "{url}/none.json")])
def test_the_command_names_an_address_that_does_not_exist(bucket, tmp_path, words) -> None:
    option, address = words
    given = [option, address.format(url=bucket.url)] * (2 if option == "--images" else 1)
    ended = amers_here(["production", "run", *given, "-o", tmp_path / "block"], os.environ)
    assert ended.returncode != 0
    assert "nothing found there" in " ".join(ended.stderr.split())
