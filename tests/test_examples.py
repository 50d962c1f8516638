"""The examples, run as their readers run them."""

import os
import re
import subprocess
import sys
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest

from amers.services.formats.block.reader import read_block
from amers.services.formats.sensor_models.rpc_files import read_rpc
from tests.service_process import Service

pytestmark = [pytest.mark.long, pytest.mark.thorough]

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(*arguments: object, **environment: str) -> str:
    """What a command prints, once it has ended well."""
    result = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env={**os.environ, "MPLBACKEND": "agg", **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the example of a block has filled."""
    folder = tmp_path_factory.mktemp("examples")
    assert "points in" in run(EXAMPLES / "make_block.py", folder)
    return folder


def test_a_block_is_made_from_images(made):
    assert len(read_block(made / "block").points) >= 40
    assert (made / "chips.png").stat().st_size > 10_000


@pytest.fixture(scope="module")
def registered(made: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder that the example of a registration has filled, and what it printed."""
    folder = tmp_path_factory.mktemp("registered")
    return folder, run(EXAMPLES / "register_scene.py", made / "block", folder)


def test_a_scene_is_registered_on_the_block(made, registered):
    tmp_path, printed = registered
    assert "verdict: good" in printed
    image = tmp_path / "images" / "scene.tif"
    delivered, refined = read_rpc(image), read_rpc(image, tmp_path / "refined_RPC.TXT")
    ground = read_block(made / "block").points.lon_lat_h
    moved_px = refined.model.project(ground) - delivered.model.project(ground)
    assert 45.0 < float(np.median(np.hypot(*moved_px.T))) < 55.0


def test_what_is_drawn_on_a_scene_is_where_the_truth_is(registered):
    printed = run(EXAMPLES / "draw_on_scene.py", registered[0])
    off_m, stated_m = (
        float(re.search(text, printed)[1]) for text in (r"([\d.]+) m at most", r"CE90 ([\d.]+) m")
    )
    assert "2 features" in printed
    assert off_m < stated_m < 10.0


def test_points_are_queried_from_a_service_and_drawn(made, open_folder, tmp_path):
    settings = {"AMERS_PUBLIC_POINTS": "true"}
    with Service(open_folder / uuid4().hex[:8], "--no-worker", **settings) as service:
        run("-m", "amers", "block", "ingest", made / "block", "--publish", **service.environment)
        points = read_block(made / "block").points
        (west, south), (east, north) = (f(points.lon_lat_h[:, :2], axis=0) for f in (np.min, np.max))
        box = f"{west},{south},{east},{north}"
        printed = run(EXAMPLES / "query_points.py", box, tmp_path / "map.png", service.url)
    assert "control points" in printed
    assert (tmp_path / "map.png").stat().st_size > 10_000
