"""The Python client on a service that is a separate process."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from amers.app.client import Client, Job, JobFailed, RequestRefused, ServiceFailure
from amers.app.client import client as client_module
from amers.app.client import upload as upload_module
from amers.app.client.connection import Connection
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.storage import Storage
from amers.app.usecases.tokens import create_token
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.flat_world import CENTRE, SIGMA_M, FlatWorld, make_flat_world, publish_world
from tests.app.registration_outputs import COMMON_FILES
from tests.app.running_service import running_service
from tests.service_process import free_port

pytestmark = pytest.mark.long

POINTS = 40


@dataclass(frozen=True)
class Installation:
    """A service with a worker and the points of a world, and the secret of a token for it."""

    url: str
    secret: str
    world: FlatWorld


@pytest.fixture(scope="module")
def installation(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    folder = tmp_path_factory.mktemp("installation")
    world = make_flat_world(folder / "world")
    with fresh_database(cluster, TEMPLATE) as dsn:
        settings = Settings(database_url=dsn, data_folder=folder / "data")
        publish_world(dsn, Storage(settings.data_folder / "storage"), world)
        with engine.connect(dsn) as connection:
            secret = create_token(connection, "a client", ["register"]).secret
        with running_service(settings, folder / "log") as url:
            yield Installation(url, secret, world)


@pytest.fixture
def service(installation: Installation) -> Iterator[Client]:
    with Client(installation.url, installation.secret) as client:
        yield client


def ids(features) -> list:
    return [feature["id"] for feature in features]


def test_points_come_page_by_page_each_once(service: Client, monkeypatch: pytest.MonkeyPatch):
    whole = ids(service.points())
    monkeypatch.setattr(client_module, "PAGE", 7)
    assert ids(service.points()) == whole
    assert len(set(whole)) == POINTS


def test_a_box_a_footprint_and_a_condition_select_points(service: Client):
    west, south, east, north = box = (*(CENTRE - 0.002), *CENTRE)
    inside = [
        point["id"]
        for point in service.points()
        if west <= point["geometry"]["coordinates"][0] <= east
        and south <= point["geometry"]["coordinates"][1] <= north
    ]
    assert 0 < len(inside) < POINTS
    assert ids(service.points(box)) == inside
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    assert ids(service.points(footprint={"type": "Polygon", "coordinates": [ring]})) == inside
    first = f"id = {inside[0]}"
    assert ids(service.points(box, where=first)) == inside[:1]


def test_blocks_have_their_extent(service: Client):
    (block,) = service.blocks()
    assert block["geometry"]["type"] in ("Polygon", "MultiPolygon")
    assert block["properties"]["state"] == "published"


@pytest.mark.thorough
def test_a_scene_is_uploaded_registered_and_its_results_downloaded(
    service: Client, installation: Installation, tmp_path: Path
):
    world, reported = installation.world, []
    scene = service.upload_scene(
        world.image, sigma_m=SIGMA_M, progress=lambda done, _: reported.append(done)
    )
    assert reported[-1] == 1.0
    assert service.upload_file(scene, world.rpc_text) == world.rpc_text.name
    waiting = service.execute("register-scene", {"scene": scene})
    assert waiting.process == "register-scene"
    job = service.wait(waiting, lambda done, _: reported.append(done), timeout_s=300.0)
    assert (job.status, job.progress, reported[-1]) == ("successful", 100, 1.0)
    assert job.verdict in ("good", "usable")
    assert service.report(job)["verdict"] == service.results(job)["verdict"] == job.verdict
    files = service.download(job, tmp_path / "out")
    assert {path.name for path in files} >= COMMON_FILES
    assert sorted(files) == sorted((tmp_path / "out").iterdir())
    assert json.loads((tmp_path / "out" / "report.json").read_text()) == service.report(job)
    # The points lie 8 m from where a model with a stated accuracy of 0.1 m expects them.
    hopeless = service.execute("register-scene", {"scene": scene, "sigma_m": 0.1})
    with pytest.raises(JobFailed, match=hopeless.id) as failure:
        service.wait(hopeless)
    assert (failure.value.job.status, failure.value.job.verdict) == ("failed", "not registered")
    assert failure.value.job.error != ""
    left = service.download(failure.value.job, tmp_path / "failed")
    assert "report.html" in {path.name for path in left}


def test_waiting_ends_after_its_time(service: Client, monkeypatch: pytest.MonkeyPatch):
    queued = {"jobID": "1", "processID": "p", "status": "accepted", "progress": 0, "message": "queued"}
    monkeypatch.setattr(service, "job", lambda _: Job.of(queued))
    with pytest.raises(TimeoutError, match="job 1: accepted after 0 s: queued"):
        service.wait(Job.of(queued), timeout_s=0)


def breaking(monkeypatch: pytest.MonkeyPatch, breaks: int, part: Callable[[int], int]) -> list[int]:
    """Let connections break after a part of what an upload sends; returns the offsets of all pieces."""
    offsets: list[int] = []
    whole = upload_module._rest

    def rest(path: Path, offset: int, *more) -> Iterator[bytes]:
        offsets.append(offset)
        for chunk in whole(path, offset, *more):
            if len(offsets) <= breaks:
                yield chunk[: part(len(chunk))]
                raise httpx.WriteError("the connection breaks")
            yield chunk

    monkeypatch.setattr(upload_module, "PAUSE_S", 0.2)
    monkeypatch.setattr(upload_module, "_rest", rest)
    return offsets


def test_an_upload_goes_on_where_its_connection_broke(
    service: Client, installation: Installation, monkeypatch: pytest.MonkeyPatch
):
    image = installation.world.image
    offsets = breaking(monkeypatch, upload_module.MOST_BREAKS + 1, lambda size: size // 3)
    scene = service.upload_scene(image)
    assert len(offsets) > upload_module.MOST_BREAKS
    assert offsets == sorted(offsets)
    assert 0 == offsets[0] < offsets[-1] < image.stat().st_size
    authorization = {"Authorization": f"Bearer {installation.secret}"}
    sent = httpx.get(
        f"{installation.url}/scenes/{scene}/files/{image.name}", headers=authorization, timeout=60.0
    )
    assert sent.content == image.read_bytes()


def test_an_upload_goes_on_behind_bytes_that_its_broken_connection_left(
    service: Client, installation: Installation, monkeypatch: pytest.MonkeyPatch
):
    image = installation.world.image
    left = image.read_bytes()[: image.stat().st_size // 3]
    request, offsets = Connection.request, []

    def after_others(connection: Connection, method: str, path: str, **options) -> httpx.Response:
        if method == "PATCH":
            offsets.append(int(options["headers"]["Upload-Offset"]))
            if offsets == [0]:
                headers = {**options["headers"], "Content-Length": str(len(left))}
                request(connection, method, path, content=left, headers=headers)
        return request(connection, method, path, **options)

    monkeypatch.setattr(upload_module, "PAUSE_S", 0.2)
    monkeypatch.setattr(Connection, "request", after_others)
    service.upload_scene(image)
    assert offsets == [0, len(left)]


def test_an_upload_of_which_no_byte_arrives_is_given_up(
    service: Client, installation: Installation, monkeypatch: pytest.MonkeyPatch
):
    offsets = breaking(monkeypatch, 100, lambda _: 0)
    with pytest.raises(ServiceFailure, match="the connection breaks"):
        service.upload_scene(installation.world.image)
    assert offsets == [0] * (upload_module.MOST_BREAKS + 1)


def test_a_refusal_has_the_words_and_the_kind_of_the_service(
    service: Client, installation: Installation, tmp_path: Path
):
    with pytest.raises(RequestRefused, match="saliencyy") as refusal:
        next(service.points(where="saliencyy > 1"))
    assert (refusal.value.status, refusal.value.error) == (400, "InvalidParameter")
    with pytest.raises(RequestRefused) as refusal:
        service.execute("no-such-process", {})
    assert (refusal.value.status, refusal.value.error) == (404, "NoSuchProcess")
    with (
        Client(installation.url, "wrong") as stranger,
        pytest.raises(RequestRefused, match="token") as refusal,
    ):
        stranger.upload_scene(installation.world.image)
    assert refusal.value.status == 401


def test_a_service_that_is_not_there_is_named():
    url = f"http://127.0.0.1:{free_port()}"
    with Client(url) as client, pytest.raises(ServiceFailure, match=url):
        client.blocks()


@pytest.mark.parametrize("name", ["../secret", "/etc/passwd", "", "a/../../b"])
def test_a_result_is_never_written_outside_of_its_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    document = {"jobID": "1", "processID": "p", "status": "successful", "progress": 100, "message": ""}
    monkeypatch.setattr(Client, "results", lambda *_: {name: {"href": "here"}})
    with Client("http://127.0.0.1:1") as client, pytest.raises(ServiceFailure, match="not a file name"):
        client.download(Job.of(document), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
