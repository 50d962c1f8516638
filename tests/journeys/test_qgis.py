"""QGIS of the distribution on a running service: layers with a token, styles, and the plugin.

QGIS runs on a virtual screen with a profile of its own, where the plugin is installed from its zip.
"""

import json
import os
import re
import shutil
import signal
import socket
import socketserver
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import Any
from zipfile import ZipFile

import httpx
import numpy as np
import pytest
from numpy.testing import assert_allclose

from amers.services.conventions import STATUS_COLOURS
from amers.services.formats.vector.qgis_styles import COLOURS
from scripts.make_plugin import write_plugin
from tests.app.flat_world import CENTRE, GROUND_H, SIGMA_M, FlatWorld, make_flat_world
from tests.service_process import Service, free_port

pytestmark = [
    pytest.mark.qgis,
    pytest.mark.skipif(shutil.which("qgis") is None, reason="QGIS is not installed"),
]

ARTEFACTS = Path(__file__).parents[1] / "artefacts"
INSIDE = Path(__file__).with_name("in_qgis.py")
SCREEN = ("xvfb-run", "-a", "-s", "-screen 0 1280x900x24 -nolisten tcp")
SETTINGS = "[PythonPlugins]\namers=true\n\n[locale]\noverrideFlag=true\nuserLocale=en_US\n"
POINTS = 40
SIZE = 1200
a_pixel_m = 0.5
metres_per_degree = 111_320.0

InQgis = Callable[..., Any]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"), SIZE, POINTS)


@pytest.fixture(scope="module")
def url(service: Service, amers, world: FlatWorld) -> str:
    """The address of a service with one published block."""
    amers("block", "ingest", world.block, "--publish")
    return service.url


@pytest.fixture
def in_qgis(tmp_path: Path) -> InQgis:
    """Runs a function of `in_qgis.py` in a QGIS with the plugin; returns its result."""
    home = tmp_path / "home"
    profile = home / "profiles" / "default"
    (profile / "QGIS").mkdir(parents=True)
    (profile / "QGIS" / "QGIS3.ini").write_text(SETTINGS)
    write_plugin(tmp_path / "plugin.zip")
    with ZipFile(tmp_path / "plugin.zip") as archive:
        archive.extractall(profile / "python" / "plugins")

    def run(name: str, **arguments: Any) -> Any:
        outcome = tmp_path / "outcome.json"
        step = {"name": name, "arguments": arguments, "outcome": str(outcome)}
        environment = {
            "PATH": os.environ["PATH"],
            "HOME": str(home),
            "LANG": "C.UTF-8",
            "AMERS_QGIS_STEP": json.dumps(step),
        }
        options = ("--nologo", "--noversioncheck", "--profiles-path", str(home), "--code", str(INSIDE))
        done = subprocess.run(
            [*SCREEN, "timeout", "300", "qgis", *options],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert outcome.exists(), done.stdout + done.stderr
        document = json.loads(outcome.read_text())
        assert "error" not in document, document["error"]
        return document["result"]

    return run


def image_with_model(world: FlatWorld, folder: Path) -> Path:
    """A copy of the scene with the file of its model beside it."""
    folder.mkdir()
    shutil.copy(world.rpc_text, folder)
    return Path(shutil.copy(world.image, folder))


def true_extent(world: FlatWorld) -> np.ndarray:
    """West, south, east, north of the ground of the scene: that of the outer edges of its pixels."""
    edges = np.array([[-0.5, -0.5], [-0.5, SIZE - 0.5], [SIZE - 0.5, -0.5], [SIZE - 0.5, SIZE - 0.5]])
    corners = world.true_model.locate(edges, np.full(4, GROUND_H))[:, :2]
    return np.concatenate([corners.min(axis=0), corners.max(axis=0)])


def test_qgis_adds_points_and_blocks_with_the_token_as_password(in_qgis, url, secret):
    layers = in_qgis("layers_with_a_token", url=url, secret=secret)
    assert len(layers) == 4
    for name, layer in layers.items():
        assert layer["valid"], name
        assert layer["features"] == (POINTS if name.startswith("points") else 1), name
        west, south, east, north = layer["extent"]
        assert west < CENTRE[0] < east, name
        assert south < CENTRE[1] < north, name


def test_qgis_without_a_valid_token_gets_no_layer(in_qgis, url):
    outcome = in_qgis("layer_with_a_wrong_token", url=url)
    assert outcome == {"valid": False, "asked": True}


def test_qgis_applies_the_style_of_a_geopackage_of_points(in_qgis, url, secret, tmp_path):
    path = tmp_path / "points.gpkg"
    headers = {"Authorization": f"Bearer {secret}"}
    items = f"{url}/collections/points/items?f=gpkg&limit=100"
    path.write_bytes(httpx.get(items, headers=headers, timeout=60.0).raise_for_status().content)
    layer = in_qgis("styles_of_a_geopackage", path=str(path))
    assert layer["error"] == ""
    assert sorted(layer["styles"]) == ["Horizontal sigma", "Number of views"]
    assert_sigma_style(layer)


def assert_sigma_style(layer: dict[str, Any]) -> None:
    assert layer["features"] == POINTS
    assert layer["renderer"] == "graduatedSymbol"
    assert layer["attribute"] == 'max("sigma_east_m", "sigma_north_m")'
    labels = ["up to 0.5 m", "up to 1 m", "up to 2 m", "up to 5 m", "over 5 m"]
    assert layer["classes"] == [list(pair) for pair in zip(labels, COLOURS, strict=True)]


def test_the_plugin_registers_the_active_raster_and_loads_it_where_it_lies(
    in_qgis, url, secret, world, tmp_path
):
    image = image_with_model(world, tmp_path / "images")
    ARTEFACTS.mkdir(exist_ok=True)
    seen = in_qgis(
        "round_trip",
        url=url,
        secret=secret,
        image=str(image),
        sigma_m=SIGMA_M,
        pictures=str(ARTEFACTS),
    )
    assert_sigma_style(seen["points"])
    assert seen["messages"][0].startswith("scene.tif is registered")

    loaded = seen["loaded"]
    assert list(loaded) == ["control points", "residuals", f"scene at {GROUND_H:.0f} m"]
    points, residuals, on_map = loaded.values()
    assert all(layer["valid"] for layer in loaded.values())
    for layer in (points, residuals):
        assert layer["renderer"] == "categorizedSymbol"
        assert layer["attribute"] == "status"
        assert layer["classes"] == [list(pair) for pair in STATUS_COLOURS.items()]
    assert (points["drawn"], residuals["drawn"]) == ("SimpleMarker", "ArrowLine")
    assert 20 < residuals["features"] <= points["features"] <= POINTS
    assert on_map["crs"] == "EPSG:4326"
    # The delivered model is wrong by 14 lines and 9 samples.
    east_m = np.cos(np.radians(CENTRE[1])) * metres_per_degree
    scale = np.array([east_m, metres_per_degree, east_m, metres_per_degree])
    assert_allclose((on_map["extent"] - true_extent(world)) * scale, 0.0, atol=2 * a_pixel_m)

    (folder,) = image.parent.glob("scene_registered_*")
    assert (folder / "report.html").is_file()
    again = in_qgis("load_again", url=url, secret=secret, image=str(image))
    assert again["loaded"] == list(loaded), again["messages"]
    assert again["messages"][0].startswith("scene.tif is registered")


def test_an_upload_that_breaks_off_goes_on_where_it_was(in_qgis, url, secret, world, tmp_path):
    image = image_with_model(world, tmp_path / "images")
    size = image.stat().st_size
    with breaking_once(url, after_bytes=size // 3) as (address, received):
        seen = in_qgis(
            "register_and_load", url=address, secret=secret, image=str(image), sigma_m=SIGMA_M
        )
    assert seen["messages"][0].startswith("scene.tif is registered"), seen["messages"]
    offsets = [int(one) for one in re.findall(rb"(?i)upload-offset: (\d+)", b"".join(received))]
    assert offsets[0] == 0
    assert size // 4 < offsets[-1] < size // 2
    headers = {"Authorization": f"Bearer {secret}"}
    newest = httpx.get(f"{url}/scenes?limit=1", headers=headers).raise_for_status().json()["scenes"][0]
    file = f"{url}/scenes/{newest['id']}/files/scene.tif"
    assert httpx.get(file, headers=headers, timeout=60.0).content == image.read_bytes()


@contextmanager
def breaking_once(url: str, after_bytes: int) -> Iterator[tuple[str, list[bytearray]]]:
    """A way to a service that closes the first connection when it has brought so many bytes.

    Yields its address, and what each connection has brought.
    """
    service = httpx.URL(url)
    received: list[bytearray] = []

    class Way(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            brought = bytearray()
            is_first = not received
            received.append(brought)
            with socket.create_connection((service.host, service.port)) as there:
                back = Thread(target=pass_on, args=(there, self.request))
                back.start()
                while content := self.request.recv(1 << 16):
                    there.sendall(content)
                    brought += content
                    if is_first and len(brought) >= after_bytes:
                        break
                self.request.shutdown(socket.SHUT_RDWR)
                there.shutdown(socket.SHUT_WR)
                back.join()

    def pass_on(source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while content := source.recv(1 << 16):
                target.sendall(content)
            target.shutdown(socket.SHUT_RDWR)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Way) as server:
        Thread(target=server.serve_forever).start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}", received
        finally:
            server.shutdown()


def test_cancelling_the_task_dismisses_the_job(in_qgis, service, url, secret, world, tmp_path):
    image = image_with_model(world, tmp_path / "images")
    workers = service.workers()
    for worker in workers:
        os.kill(worker, signal.SIGSTOP)
    try:
        seen = in_qgis("cancel_a_registration", url=url, secret=secret, image=str(image))
    finally:
        for worker in workers:
            os.kill(worker, signal.SIGCONT)
    assert seen == {"messages": [], "layers": 0}
    headers = {"Authorization": f"Bearer {secret}"}
    jobs = httpx.get(f"{url}/jobs?limit=1", headers=headers).raise_for_status().json()["jobs"]
    assert [job["status"] for job in jobs] == ["dismissed"]


def test_the_plugin_says_what_went_wrong_in_one_sentence(in_qgis, url, secret, world, tmp_path):
    (tmp_path / "images").mkdir()
    image = Path(shutil.copy(world.image, tmp_path / "images" / "bare.tif"))
    text = tmp_path / "images" / "notes.txt"
    text.write_text("no image")
    closed = f"http://127.0.0.1:{free_port()}"
    said = in_qgis(
        "sentences_of_errors", url=url, secret=secret, closed=closed, image=str(image), text=str(text)
    )
    expected = {
        "no service": "No service is set",
        "no raster": "Select a raster layer",
        "no image": "notes.txt cannot be opened",
        "never sent": f"{url} has no registered scene with the name bare.tif",
        "no model": "bare.tif was not registered: .*RPC",
        "wrong token": f"{url}: .*unknown, expired or revoked",
        "no answer": f"{closed}: .*refused",
    }
    assert list(said) == list(expected)
    for what, sentence in expected.items():
        assert re.search(sentence, said[what]), (what, said[what])
        assert "\n" not in said[what]
