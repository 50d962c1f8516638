"""`amers scene register --block --control`: marks in addition to the points of a base."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amers.services.formats.images.raster import write_raster
from amers.services.formats.sensor_models.rpc_files import read_rpc
from tests.app.flat_world import GROUND_H, SHIFT_PX, SIGMA_M, FlatWorld, make_flat_world
from tests.app.registration_outputs import A_TENTH_OF_A_PIXEL, largest_error_px
from tests.command_line import Done, amers_here
from tests.services.simulated import ring_of_geometries

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def marks(world: FlatWorld) -> Path:
    """Four marks on the true model, of 0.1 m and 0.2 px."""
    picked = np.array([[200.0, 200.0], [200.0, 1000.0], [1000.0, 250.0], [900.0, 900.0]])
    ground = world.true_model.locate(picked, np.full(4, GROUND_H))
    rows = [
        f"GCP{k},{lon:.10f},{lat:.10f},{h},{line},{sample},0.1,0.1,0.2"
        for k, ((lon, lat, h), (line, sample)) in enumerate(
            zip(ground.tolist(), picked.tolist(), strict=True)
        )
    ]
    head = "id,lon,lat,height_m,line,sample,sigma_horizontal_m,sigma_up_m,sigma_px"
    path = world.block.parent / "marks.csv"
    path.write_text("\n".join(["# pixel-origin=centre heights=ellipsoid", head, *rows]) + "\n")
    return path


def register(image: Path, folder: Path, *words: object) -> Done:
    command = ["scene", "register", image, *words, "--sigma-m", SIGMA_M, "-o", folder]
    return amers_here(command, dict(os.environ))


def test_marks_and_points_are_one_adjustment(world: FlatWorld, marks: Path, tmp_path: Path) -> None:
    ended = register(world.tagged, tmp_path / "out", "--block", world.block, "--control", marks)
    assert ended.returncode == 0, ended.stderr
    refined = read_rpc(world.tagged, tmp_path / "out" / "tagged_RPC.TXT").model
    assert largest_error_px(refined, world.true_model) < A_TENTH_OF_A_PIXEL
    document = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [mark["status"] for mark in document["marks"]["marks"]] == ["used"] * 4
    last = document["run"]["blocks"][-1]
    assert (last["id"], last["version"], last["active"]) == ("marks.csv", "marks", 4)
    assert len(document["run"]["blocks"]) == 2
    assert document["point_counts"]["active"] > 20
    assert "GCP3" in (tmp_path / "out" / "gcp_list.txt").read_text()
    numbers = {
        feature["id"]
        for feature in json.loads((tmp_path / "out" / "control_points.geojson").read_text())["features"]
    }
    assert {-1, -2, -3, -4} < numbers


def test_where_the_base_shows_nothing_the_marks_are_alone(
    world: FlatWorld, marks: Path, tmp_path: Path
) -> None:
    geometry = ring_of_geometries(1, shape=(300, 300))[0]
    image = tmp_path / "elsewhere.tif"
    delivered = replace(geometry.rpc, image_offset=geometry.rpc.image_offset - SHIFT_PX)
    write_raster(image, np.ones((300, 300), np.uint8), delivered)
    lon, lat, _ = geometry.rpc.locate(np.array([[150.0, 150.0]]), np.array([100.0]))[0]
    own = tmp_path / "own.csv"
    own.write_text(
        "# pixel-origin=centre heights=ellipsoid\nid,lon,lat,height_m,line,sample\n"
        f"GCP,{lon:.10f},{lat:.10f},100,150,150\n"
    )
    ended = register(image, tmp_path / "out", "--block", world.block, "--control", own)
    assert ended.returncode == 0, ended.stderr
    document = json.loads((tmp_path / "out" / "report.json").read_text())
    assert document["correction"]["shift_px"] == pytest.approx(SHIFT_PX, abs=0.2)
    (only,) = document["run"]["blocks"]
    assert (only["id"], only["version"]) == ("own.csv", "marks")
