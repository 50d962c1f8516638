"""What `amers scene register-many` takes for its scenes: several blocks, masks, check points."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import rasterio

from services.formats.block.check import check_block
from services.formats.block.reader import FolderChips
from services.formats.block.writer import write_block
from services.formats.gcp.marked_points import marked_points
from services.formats.gcp.odm import format_gcp_list
from services.formats.sensor_models.rpc_files import read_rpc
from services.types import IntArray, point_chips
from tests.app.flat_world import GROUND_H, GSD_M, SIGMA_M, FlatWorld, make_flat_world
from tests.app.joint_world import A_FIFTH_OF_A_PIXEL, SCENES, true_model, write_scenes
from tests.app.registration_outputs import largest_error_px
from tests.command_line import Done, amers_here

pytestmark = pytest.mark.long

SIZE = 800
MASKED_FROM = 450
"""Sample of the image in the east from which it is masked."""
CHECKED = 5
"""Check points in each image."""


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"), size=SIZE, points=40)


@pytest.fixture(scope="module")
def folder(world: FlatWorld, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes of the ground of the block."""
    folder = write_scenes(world, tmp_path_factory.mktemp("scenes"))
    (folder / "wrong.tif").unlink()
    return folder


@pytest.fixture(scope="module")
def halves(world: FlatWorld, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The block in two, whose points have the same ids."""
    contents = check_block(world.block)
    points, metadata = contents.points, contents.document.metadata
    folders = []
    with FolderChips(world.block) as chips:
        for number in (0, 1):
            rows: IntArray = np.arange(number, len(points), 2)
            half = points.take(rows)
            folder = tmp_path_factory.mktemp("half") / "block"
            write_block(folder, metadata, half, lambda row, half=half: point_chips(half, chips, row), {})
            folders.append(folder)
    return folders


def write_marks(path: Path, world: FlatWorld, *, named: bool = True) -> Path:
    """Write check points: where the images show some places of the ground."""
    rng = np.random.default_rng(3)
    middle, offset = world.true_model.ground_offset, world.true_model.ground_scale
    ground = middle + offset * rng.uniform(-0.6, 0.6, (CHECKED, 3)) * [1.0, 1.0, 0.0]
    assert (ground[:, 2] == GROUND_H).all()
    places = np.concatenate([true_model(world, name).project(ground) for name in SCENES])
    images = [f"{name}.tif" for name in SCENES for _ in ground]
    marks = marked_points(
        [f"p{k}" for k in range(len(places))],
        np.tile(ground, (len(SCENES), 1)),
        places,
        image=images,
        check=np.ones(len(places), dtype=bool),
    )
    text = format_gcp_list(marks)
    if not named:
        document = {
            "type": "FeatureCollection",
            "features": [
                {
                    "type": "Feature",
                    "geometry": {"type": "Point", "coordinates": list(ground[0])},
                    "properties": {"line": places[0, 0], "sample": places[0, 1]},
                }
            ],
        }
        text = json.dumps(document)
    path.write_text(text)
    return path


def register(output: Path, *words: object) -> Done:
    command = ("scene", "register-many", *words, "--sigma-m", SIGMA_M, "-o", output)
    return amers_here(command, os.environ)


def test_points_of_several_blocks_masks_and_check_points_of_each_scene(
    world: FlatWorld, folder: Path, halves: list[Path], tmp_path: Path
):
    masks, output = tmp_path / "masks", tmp_path / "out"
    masks.mkdir()
    mask = np.zeros((SIZE, SIZE), np.uint8)
    mask[:, MASKED_FROM:] = 1
    profile = {"driver": "GTiff", "width": SIZE, "height": SIZE, "count": 1, "dtype": "uint8"}
    with rasterio.open(masks / "east.tif", "w", **profile) as file:
        file.write(mask, 1)
    marks = (
        "--check-points",
        write_marks(tmp_path / "gcp_list.txt", world),
        "--check-heights",
        "ellipsoid",
    )
    blocks = [word for half in halves for word in ("--block", half)]
    done = register(output, folder, *blocks, "--mask", masks, *marks)
    assert done.returncode == 0, done.stderr
    seen = {}
    for name in SCENES:
        report = json.loads((output / name / "report.json").read_text())
        assert len(report["run"]["blocks"]) == 2
        (check,) = report["checks"]
        assert check["against"] == "independent check points of gcp_list.txt"
        assert check["accuracy"]["n"] == CHECKED, check
        assert check["accuracy"]["ce90_m"]["value"] < A_FIFTH_OF_A_PIXEL * GSD_M, check
        refined = read_rpc(folder / f"{name}.tif", output / name / f"{name}_RPC.TXT").model
        assert largest_error_px(refined, true_model(world, name)) < A_FIFTH_OF_A_PIXEL
        points = json.loads((output / name / "control_points.geojson").read_text())["features"]
        active = [one for one in points if one["properties"]["status"] == "active"]
        assert len({one["id"] for one in active}) == len(active)
        seen[name] = max(one["properties"]["sample"] for one in active)
    assert seen["east"] < MASKED_FROM < seen["south"]


def test_what_cannot_belong_to_the_scenes_is_refused_by_name(
    world: FlatWorld, folder: Path, halves: list[Path], tmp_path: Path
):
    masks = tmp_path / "masks"
    masks.mkdir()
    unnamed = write_marks(tmp_path / "marks.geojson", world, named=False)
    elsewhere = tmp_path / "gcp_list.txt"
    text = write_marks(elsewhere, world).read_text()
    elsewhere.write_text(text.replace("east.tif", "a.tif").replace("south.tif", "b.tif"))
    block, heights = ("--block", halves[0]), ("--check-heights", "ellipsoid")
    for words, says in (
        ((*block, "--mask", folder / "east.tif"), "belongs to one scene, but 2 scenes are given"),
        ((*block, "--mask", masks), "no file in this folder is named as one of the images"),
        ((*block, *block), "a folder is given twice"),
        ((*block, "--check-points", unnamed), "1 of 1 marks name no image"),
        ((*block, "--check-points", elsewhere, *heights), "no marks in any of 2 scenes found"),
        ((*block, "--reference", folder / "east.tif"), "No such option"),
    ):
        done = register(tmp_path / "out", folder, *words)
        assert done.returncode == 2, done.stderr
        assert says in " ".join(done.stderr.split()), done.stderr
