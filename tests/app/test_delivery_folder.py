"""Commands that start processes, run in a folder that a hostile delivery was unpacked into."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from amers.app.config import Settings
from tests.app.flat_world import SIGMA_M, make_flat_world
from tests.app.joint_world import SCENES, write_scenes
from tests.app.worker_processes import wait_until
from tests.hostile_folder import executed, fill_with_modules
from tests.service_process import free_port

pytestmark = [pytest.mark.long, pytest.mark.thorough]

AMERS = Path(sys.executable).with_name("amers")
PATIENCE_S = 240.0


@pytest.fixture
def delivery(tmp_path: Path) -> Path:
    return tmp_path / "delivery"


@pytest.fixture
def environment(settings: Settings) -> dict[str, str]:
    assert settings.database_url is not None
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return inherited | {
        "AMERS_DATABASE_URL": settings.database_url.get_secret_value(),
        "AMERS_DATA_FOLDER": str(settings.data_folder),
        "AMERS_PUBLIC_POINTS": "true",
    }


def test_scenes_are_registered_beside_hostile_modules(
    delivery: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    world = make_flat_world(tmp_path, size=800, points=30)
    marker = fill_with_modules(delivery)
    write_scenes(world, delivery)
    scenes = [f"{name}.tif" for name in SCENES]
    control = ("--block", str(world.block), "--sigma-m", str(SIGMA_M), "--jobs", "2")
    for command, output in (("register", "one"), ("register-many", "many")):
        words = [AMERS, "scene", command, *scenes, *control, "-o", tmp_path / output]
        done = subprocess.run(
            words,
            cwd=delivery,
            env=environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert executed(marker) == []


@pytest.mark.endurance
def test_the_demonstration_runs_beside_hostile_modules(delivery: Path, tmp_path: Path) -> None:
    marker = fill_with_modules(delivery)
    words = [AMERS, "demo", "-o", tmp_path / "demo"]
    done = subprocess.run(
        words, cwd=delivery, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    assert executed(marker) == []


def test_service_and_worker_run_beside_hostile_modules(
    delivery: Path, environment: dict[str, str], tmp_path: Path
) -> None:
    marker, log, port = fill_with_modules(delivery), tmp_path / "log", free_port()
    url = f"http://127.0.0.1:{port}/collections/points/items?filter=n_views%3E1"

    def answers() -> bool:
        try:
            return httpx.get(url, timeout=30).status_code == 200
        except httpx.TransportError:
            return False

    with log.open("ab") as output:
        service = subprocess.Popen(
            [AMERS, "serve", "--port", str(port)],
            cwd=delivery,
            env=environment,
            stderr=output,
            stdout=output,
        )
    try:
        wait_until(answers, "the service answers a filter")
        wait_until(lambda: "waits for jobs" in log.read_text(), "its worker waits for jobs")
    finally:
        service.send_signal(signal.SIGTERM)
        service.wait(PATIENCE_S)
    assert "the server of warm processes ended" not in log.read_text()
    assert executed(marker) == []
