"""Odd values in every parameter and member: each gets a reply below 500, and the service lives on."""

import os
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from amers.app.config import Settings
from amers.app.main import create_app
from amers.app.usecases.jobs import PROCESSES
from tests.app.odd_values import Target, in_url, json_text, targets, with_member
from tests.app.running_service import Served, service_with_a_block
from tests.app.test_access_matrix import OPERATIONS
from tests.factories import make_block

pytestmark = [pytest.mark.long, pytest.mark.security, pytest.mark.thorough]

VALUES = {"bounded": 800, "full": 10_000}
LONGEST_REPLY_S = 30.0
POINT = str(2**26 + 7)
NO_ID = "00000000-0000-0000-0000-000000000001"
PLACES = {
    "point_id": POINT,
    "feature_id": POINT,
    "item_id": NO_ID,
    "view": "1",
    "reference": "calanques",
    "matrix_set": "WebMercatorQuad",
    "z": "0",
    "y": "0",
    "x": "0",
    "process_id": "register-scene",
    "token_id": NO_ID,
    "name": "nothing",
}
"""Usual values of the path parameters that are not the odd one, beside `things`."""
TUS = {"Tus-Resumable": "1.0.0", "Upload-Length": "10", "Upload-Metadata": "filename YS50aWY="}
BODIES: dict[str, Any] = {
    "/points/{point_id}/suspend": {"because": "it is gone"},
    "/blocks": {"path": "nothing"},
    "/blocks/{reference}": {"priority": 0},
    "/scenes/reference": {"path": "nothing.tif"},
    "/references": {"name": "north", "image": "nothing.tif"},
    "/tokens": {"name": "odd", "scopes": ["read"]},
}
"""Usual bodies, around the odd member."""


@pytest.fixture(scope="module")
def served(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A service in a process of its own, with a published block and an administrator."""
    folder = tmp_path_factory.mktemp("odd")
    made = make_block(folder / "block", count=20)
    quotas = {"AMERS_QUOTA_JOBS": "100000"}
    with service_with_a_block(cluster, folder, "admin", made, **quotas) as served:
        yield served


@pytest.fixture(scope="module")
def things(served: Served) -> dict[str, str]:
    """Ids of a scene, an upload and a job, so that requests with one odd value get far."""
    with httpx.Client(base_url=served.url, headers=served.authorization) as client:
        scene = client.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100)).json()["id"]
        upload = client.post("/uploads", headers=TUS).headers["location"]
        body = {"inputs": {"scene": scene}}
        job = client.post("/processes/register-scene/execution", json=body).json()["jobID"]
    return {"scene_id": scene, "upload_id": upload.rsplit("/", 1)[1], "job_id": job}


@pytest.fixture(scope="module")
def all_targets() -> list[Target]:
    """Every parameter and member of the API, and of the inputs of its processes."""
    document = create_app(Settings(data_folder=Path("unused"))).openapi()
    return targets(document, {name: process.input_schema() for name, process in PROCESSES.items()})


def request_of(served: Served, things: dict[str, str], target: Target, value: Any) -> dict[str, Any]:
    """The request in which one value is odd."""
    path, headers = target.path, dict(served.authorization)
    for name, usual in {**PLACES, **things}.items():
        odd = target.place == "path" and target.name == (name,)
        path = path.replace(f"{{{name}}}", in_url(value) if odd else usual)
    if target.place == "query":
        path += f"?{target.name[0]}={in_url(value)}"
    request: dict[str, Any] = {"method": target.method, "url": f"{served.url}{path}"}
    if path.startswith("/uploads"):
        headers |= {**TUS, "Upload-Offset": "0"}
    if target.place == "header":
        text = value if isinstance(value, str) else json_text(value).decode()
        headers[target.name[0]] = text.encode("utf-8", "surrogatepass").decode("latin-1")
    usual_body = BODIES.get(target.path, {})
    if "/execution" in path:
        usual_body = {"inputs": {"scene": things["scene_id"]}}
    if target.place == "body":
        request["content"] = json_text(with_member(usual_body, target.name, value))
        headers["Content-Type"] = "application/json"
    elif target.method in ("post", "put", "patch"):
        request["content"] = json_text(usual_body)
        headers["Content-Type"] = "application/json"
    request["headers"] = {name: text.encode("latin-1") for name, text in headers.items()}
    return request


def test_every_place_of_a_value_is_tried(all_targets: list[Target]):
    assert len(all_targets) > 400
    assert {(target.method, target.path) for target in all_targets if target.place != "body"} >= {
        (item.method, item.path) for item in OPERATIONS if "{" in item.path
    }
    members = {target.name for target in all_targets if target.place == "body"}
    assert ("inputs", "options", "matching", "max_views") in members


def test_an_odd_value_is_answered_below_500_and_the_process_lives_on(
    served: Served,
    things: dict[str, str],
    all_targets: list[Target],
    request: pytest.FixtureRequest,
):
    chance = random.Random(10)
    count = VALUES[request.config.getoption("--attacks")]
    failures, sent = [], 0
    chance.shuffle(all_targets)
    with httpx.Client(timeout=LONGEST_REPLY_S) as client:
        while sent < count:
            target = all_targets[sent % len(all_targets)]
            value = target.value(chance)
            sent += 1
            try:
                reply = client.request(**request_of(served, things, target, value))
            except httpx.LocalProtocolError:
                continue  # The client refuses to send a header of such bytes.
            except httpx.InvalidURL:
                continue
            except httpx.HTTPError as error:
                failures.append(f"{target} {value!r:.100}: {type(error).__name__} {error}")
                continue
            if reply.status_code >= 500 or "Traceback" in reply.text:
                failures.append(f"{target} {value!r:.100}: {reply.status_code} {reply.text:.200}")
    log = (served.folder / "log").read_text(errors="replace")
    assert failures == [], "\n".join(failures)
    assert "Traceback" not in log, log[-3000:]
    os.kill(served.pid, 0)
    assert httpx.get(f"{served.url}/healthz").status_code == 200
