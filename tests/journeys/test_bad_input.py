"""Unusable scenes and blocks on a running service: it states the reason and changes nothing."""

import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pyarrow.parquet as pq
import pytest

from amers.services.formats.block.reader import file_sha256
from amers.services.formats.sensor_models.rpc_text import format_rpc_text, parse_rpc_text
from tests.app.flat_world import FlatWorld, make_flat_world
from tests.service_process import Service

pytestmark = [pytest.mark.long, pytest.mark.security, pytest.mark.thorough]

patience_s = 120.0
degrees_away = 3.0


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def client(service: Service, amers, secret: str, world: FlatWorld):
    amers("block", "ingest", world.block, "--publish")
    headers = {"Authorization": f"Bearer {secret}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=60.0) as client:
        yield client


@pytest.fixture
def store(service: Service, amers):
    """The content of the store: published and staged blocks, and the chip files."""

    def state() -> tuple[str, list[str]]:
        chips = sorted(path.name for path in (service.folder / "storage" / "chips").rglob("*.npy"))
        return json.dumps(amers("block", "list"), sort_keys=True), chips

    return state


def registered(client: httpx.Client, image: bytes, model: str | None) -> dict:
    """The ended job that registered an image."""
    scene = (
        client.post("/scenes?name=scene.tif&sigma_m=6", content=image).raise_for_status().json()["id"]
    )
    if model is not None:
        client.put(f"/scenes/{scene}/files/scene_RPC.TXT", content=model.encode()).raise_for_status()
    reply = client.post("/processes/register-scene/execution", json={"inputs": {"scene": scene}})
    assert reply.status_code == 201, reply.text
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        job = client.get(reply.headers["location"]).json()
        if job["status"] in ("successful", "failed", "dismissed"):
            return job
        time.sleep(0.3)
    raise AssertionError(f"the job did not end: {job}")


def with_denominators(text: str, value: float) -> str:
    model = parse_rpc_text(text)
    return format_rpc_text(replace(model, line_den=np.full(20, value)))


def moved_away(text: str) -> str:
    model = parse_rpc_text(text)
    return format_rpc_text(
        replace(model, ground_offset=model.ground_offset + [degrees_away, degrees_away, 0.0])
    )


@pytest.mark.parametrize(
    ("spoil_image", "spoil_model", "says"),
    [
        pytest.param(
            lambda image: image[: len(image) // 2], lambda text: text, "scene.tif", id="truncated"
        ),
        pytest.param(lambda image: image, lambda text: None, "RPC", id="no model"),
        pytest.param(
            lambda image: image,
            lambda text: with_denominators(text, 0.0),
            "denominator",
            id="zero denominator",
        ),
        pytest.param(lambda image: image, moved_away, "control point", id="outside every block"),
    ],
)
def test_a_scene_that_cannot_be_used_ends_its_job_with_the_reason(
    client, store, world, spoil_image, spoil_model, says
):
    before = store()
    job = registered(
        client, spoil_image(world.image.read_bytes()), spoil_model(world.rpc_text.read_text())
    )
    assert job["status"] == "failed", job
    job_text = json.dumps(job)
    assert says in job_text
    assert "Traceback" not in job_text
    assert "/tmp/" not in job_text
    results = client.get(f"/jobs/{job['jobID']}/results")
    assert results.status_code >= 400
    assert results.headers["content-type"] == "application/problem+json"
    (link,) = (link for link in job["links"] if link.get("title") == "report.json")
    report = client.get(link["href"])
    assert report.json()["verdict"] == job["amers:verdict"] == "not registered"
    assert says in report.text
    assert "/tmp/" not in report.text
    assert store() == before


def spoil_checksum(block: Path) -> None:
    chips = next((block / "chips").glob("*.npy"))
    content = bytearray(chips.read_bytes())
    content[-1] ^= 0xFF
    chips.write_bytes(content)
    rename(block)


def lose_chips(block: Path) -> None:
    next((block / "chips").glob("*.npy")).unlink()


def lose_coordinates(block: Path) -> None:
    """Set a point to NaN, NaN, NaN, in a file with the right checksum."""
    path = block / "points.parquet"
    table = pq.read_table(path)
    geometry = table.column("geometry").to_pylist()
    geometry[0] = geometry[0][:5] + np.full(3, np.nan).tobytes()
    column = table.schema.get_field_index("geometry")
    spoiled = table.set_column(column, table.schema.field(column), [geometry])
    pq.write_table(spoiled, path)
    document = json.loads((block / "block.json").read_text())
    document["amers:checksums"]["points.parquet"] = file_sha256(path)
    (block / "block.json").write_text(json.dumps(document))
    rename(block)


def rename(block: Path) -> None:
    """Rename the block, so that it is not the one in the store."""
    document = json.loads((block / "block.json").read_text())
    document["id"] = "nowhere"
    (block / "block.json").write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (spoil_checksum, "chips/0000.npy"),
        (lose_chips, "chips/0000.npy"),
        (lose_coordinates, "points.parquet"),
    ],
)
def test_a_block_that_contradicts_its_document_is_refused_completely(
    service, client, store, world, tmp_path, spoil, says
):
    block = shutil.copytree(world.block, tmp_path / "spoiled")
    spoil(block)
    before = store()
    refused = subprocess.run(
        [sys.executable, "-m", "amers", "block", "ingest", str(block), "--publish"],
        env=service.environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert refused.returncode == 2
    assert says in refused.stderr
    assert "Traceback" not in refused.stderr
    assert store() == before


@pytest.mark.parametrize("given", [None, "wrong" * 8])
def test_a_missing_or_wrong_token_opens_nothing(service, client, given):
    headers = {} if given is None else {"Authorization": f"Bearer {given}"}
    for method, path in (
        ("GET", "/collections/points/items"),
        ("GET", "/jobs"),
        ("POST", "/scenes?name=a.tif"),
    ):
        reply = httpx.request(method, service.url + path, headers=headers, timeout=30.0)
        assert reply.status_code == 401
        assert reply.headers["content-type"] == "application/problem+json"
        assert "www-authenticate" in reply.headers
