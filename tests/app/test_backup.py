"""Backup and restore as in docs/operations.md: a destroyed installation gives the same replies again."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from uuid import uuid4

import httpx
import numpy as np
import pytest
from pyogrio.raw import read

from amers.app.db import engine
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from amers.app.usecases.tokens import create_token
from tests.app.flat_world import SIGMA_M, make_flat_world
from tests.app.worker_processes import wait_until
from tests.factories import make_block
from tests.service_process import Service

pytestmark = [pytest.mark.long, pytest.mark.thorough]

ENDED = ("successful", "failed", "dismissed")
SAME_HOST = {"Host": "localhost"}
PATHS = (
    "/collections",
    "/collections/points/items?limit=1000",
    "/collections/points/items?limit=50&f=csv",
    "/collections/blocks/items",
    "/collections/density/items",
    "/collections/scenes/items",
    "/blocks/calanques/quality",
    "/blocks/flat/quality",
    "/scenes",
    "/jobs",
    "/tokens",
    "/audit?limit=1000",
)


TILED = (("points", 6), ("points", 14), ("density", 8), ("blocks", 10))
"""Collections and the zooms of their tiles."""


def tile_paths(lon: float, lat: float) -> tuple[str, ...]:
    """The tiles that contain a place."""
    east = (lon + 180.0) / 360.0
    south = 0.5 - np.arctanh(np.sin(np.radians(lat))) / (2.0 * np.pi)
    return tuple(
        f"/collections/{collection}/tiles/WebMercatorQuad/{z}/{int(south * 2**z)}/{int(east * 2**z)}"
        for collection, z in TILED
    )


def features(tile: bytes, folder: Path) -> list[tuple[object, ...]]:
    """The features of a vector tile, sorted, because a tile has no order."""
    path = folder / "tile.mvt"
    path.write_bytes(tile)
    meta, _, geometry, values = read(path)
    columns = [geometry, *values]
    assert len(geometry), "there is something in every tile"
    return sorted(
        (*map(str, meta["fields"]), *(str(column[row]) for column in columns))
        for row in range(len(geometry))
    )


def amers(service: Service, *words: str | Path) -> dict[str, object]:
    result = subprocess.run(
        [sys.executable, "-m", "amers", *map(str, words), "--json"],
        env=service.environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    answer: dict[str, object] = json.loads(result.stdout)
    return answer


def answers(service: Service, secret: str, paths: tuple[str, ...]) -> dict[str, tuple[int, bytes]]:
    """The replies to an administrator for each path, without the address of the service."""
    headers = SAME_HOST | {"Authorization": f"Bearer {secret}"}
    with httpx.Client(base_url=service.url, headers=headers, timeout=60.0) as client:
        replies = {path: client.get(path) for path in paths}
    return {path: (reply.status_code, reply.content) for path, reply in replies.items()}


@pytest.fixture
def place(open_folder: Path):
    folder = open_folder / uuid4().hex[:8]
    folder.mkdir(mode=0o755)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def test_a_destroyed_installation_is_restored_and_gives_the_same_answers(place: Path, tmp_path: Path):
    world = make_flat_world(tmp_path / "world", size=800)
    with Service(place / "data") as service:
        with service.cluster.lease() as dsn, engine.connect(dsn) as connection:
            storage = Storage(service.folder / "storage")
            for block in (world.block, make_block(tmp_path / "block").folder):
                publish_block(connection, str(ingest_block(connection, storage, block).block.number))
            secret = create_token(connection, "administrator", ["admin"]).secret
        headers = SAME_HOST | {"Authorization": f"Bearer {secret}"}
        with httpx.Client(base_url=service.url, headers=headers, timeout=60.0) as client:
            image = world.tagged.read_bytes()
            scene = client.post(f"/scenes?name=s.tif&sigma_m={SIGMA_M}", content=image).json()["id"]
            body = {"inputs": {"scene": scene}}
            job = client.post("/processes/register-scene/execution", json=body).json()["jobID"]
            wait_until(lambda: client.get(f"/jobs/{job}").json()["status"] in ENDED, "the job ends")
            results = client.get(f"/jobs/{job}/results").json()
            points = client.get("/collections/points/items?limit=3").json()["features"]
        files = tuple(f"/jobs/{job}/results/{name}" for name in results if "." in name)
        assert len(files) >= 3, results
        chips = tuple(f"/collections/points/items/{point['id']}/chips?f=npz" for point in points)
        lon, lat = points[0]["geometry"]["coordinates"][:2]
        tiles = tile_paths(lon, lat)
        paths = (
            *PATHS,
            *tiles,
            f"/scenes/{scene}",
            f"/jobs/{job}",
            f"/jobs/{job}/results",
            *files,
            *chips,
        )

        backup = place / "backup"
        assert amers(service, "db", "backup", backup)["damaged"] == []
        before = answers(service, secret, paths)
        assert {path: status for path, (status, _) in before.items() if status != 200} == {}

    shutil.rmtree(place / "data")
    amers(service, "db", "restore", backup)
    with Service(place / "data") as restored:
        after = answers(restored, secret, paths)
        for path, said in before.items():
            if path in tiles:
                assert features(after[path][1], tmp_path) == features(said[1], tmp_path), path
            else:
                assert after[path] == said, path
        with httpx.Client(base_url=restored.url, headers=headers, timeout=60.0) as client:
            again = client.post("/processes/register-scene/execution", json=body).json()["jobID"]
            wait_until(lambda: client.get(f"/jobs/{again}").json()["status"] in ENDED, "the job ends")
            assert client.get(f"/jobs/{again}").json()["status"] == "successful", "it works on"
