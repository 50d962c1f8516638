"""`amers scene register-many --control`: scenes in one adjustment on marks of a person."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from amers.services.formats.sensor_models.rpc_files import read_rpc
from tests.app.flat_world import GROUND_H, SIGMA_M, FlatWorld, make_flat_world
from tests.app.joint_world import A_FIFTH_OF_A_PIXEL, SCENES, true_model, write_scenes
from tests.app.registration_outputs import largest_error_px
from tests.command_line import Done, amers_here

pytestmark = pytest.mark.long

PLACES = np.array(
    [[200.0, 200.0], [250.0, 950.0], [950.0, 250.0], [900.0, 900.0], [600.0, 550.0], [400.0, 700.0]]
)
HEAD = "id,image,lon,lat,height_m,line,sample,sigma_horizontal_m,sigma_up_m,sigma_px"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="module")
def images(world: FlatWorld, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = write_scenes(world, tmp_path_factory.mktemp("scenes"))
    return [folder / f"{name}.tif" for name in SCENES]


def write_marks(path: Path, world: FlatWorld, counts: dict[str, int], wrong: str = "") -> Path:
    """The first of some ground points, marked in each scene; one of a scene is 40 px off."""
    ground = true_model(world, "east").locate(PLACES, np.full(len(PLACES), GROUND_H))
    rows = []
    for name, count in counts.items():
        picked = true_model(world, name).project(ground[:count])
        for k, ((lon, lat, h), (line, sample)) in enumerate(
            zip(ground[:count].tolist(), picked.tolist(), strict=True)
        ):
            off = 40.0 if name == wrong and k == 1 else 0.0
            rows.append(f"GCP{k},{name}.tif,{lon!r},{lat!r},{h!r},{line + off!r},{sample!r},0.1,0.1,0.2")
    path.write_text("\n".join(["# pixel-origin=centre heights=ellipsoid", HEAD, *rows]) + "\n")
    return path


def register(images: list[Path], folder: Path, *words: object) -> Done:
    command = ["scene", "register-many", *images, "--sigma-m", SIGMA_M, *words, "-o", folder]
    return amers_here(command, dict(os.environ))


def errors_px(images: list[Path], folder: Path, world: FlatWorld) -> list[float]:
    """Largest error of the refined model of each scene."""
    return [
        largest_error_px(
            read_rpc(image, folder / image.stem / f"{image.stem}_RPC.TXT").model,
            true_model(world, image.stem),
        )
        for image in images
    ]


def statuses(folder: Path, name: str) -> dict[str, str]:
    marks = json.loads((folder / name / "report.json").read_text())["marks"]["marks"]
    return {mark["name"]: mark["status"] for mark in marks}


def test_two_marks_and_ties_place_a_scene_beside_one_with_six(
    world: FlatWorld, images: list[Path], tmp_path: Path
) -> None:
    marks = write_marks(tmp_path / "marks.csv", world, {"east": 6, "south": 2})
    ended = register(images, tmp_path / "out", "--control", marks)
    assert ended.returncode == 0, ended.stderr
    assert max(errors_px(images, tmp_path / "out", world)) < 2.0 * A_FIFTH_OF_A_PIXEL
    assert statuses(tmp_path / "out", "east") == {f"GCP{k}": "used" for k in range(6)}
    report = json.loads((tmp_path / "out" / "south" / "report.json").read_text())
    (only,) = report["run"]["blocks"]
    assert (only["id"], only["version"], only["active"]) == ("marks.csv", "marks", None)


def test_check_points_are_reported_with_their_scene_and_a_wrong_mark_is_rejected_by_name(
    world: FlatWorld, images: list[Path], tmp_path: Path
) -> None:
    marks = write_marks(tmp_path / "marks.csv", world, {"east": 6, "south": 6}, wrong="south")
    origin, head, *rows = marks.read_text().splitlines()
    held_out = [f"{row},{int(row.startswith(('GCP3,', 'GCP4,')))}" for row in rows]
    marks.write_text("\n".join([origin, f"{head},check", *held_out]))
    ended = register(images, tmp_path / "out", "--control", marks)
    assert ended.returncode == 0, ended.stderr
    for image in images:
        report = json.loads((tmp_path / "out" / image.stem / "report.json").read_text())
        (check,) = report["checks"]
        assert check["against"] == "independent check points of marks.csv"
        assert check["accuracy"]["n"] == 2
        assert not {"GCP3", "GCP4"} & set(statuses(tmp_path / "out", image.stem))
    assert statuses(tmp_path / "out", "south")["GCP1"] == "rejected"
    assert max(errors_px(images, tmp_path / "out", world)) < 2.0 * A_FIFTH_OF_A_PIXEL


def test_a_scene_without_marks_says_what_ties_leave_open(
    world: FlatWorld, images: list[Path], tmp_path: Path
) -> None:
    marks = write_marks(tmp_path / "marks.csv", world, {"east": 6})
    register(images, tmp_path / "out", "--control", marks)
    east_px, south_px = errors_px(images, tmp_path / "out", world)
    report = json.loads((tmp_path / "out" / "south" / "report.json").read_text())
    assert report["marks"] is None
    # A parallax of all tie points together is a height that no mark of this scene contradicts.
    assert east_px < A_FIFTH_OF_A_PIXEL
    assert report["verdict"] == "failed"
    assert south_px < report["predicted"]["worst_px"]


def test_marks_are_added_to_the_points_of_a_base(
    world: FlatWorld, images: list[Path], tmp_path: Path
) -> None:
    marks = write_marks(tmp_path / "marks.csv", world, {"east": 4, "south": 5})
    ended = register(images, tmp_path / "out", "--control", marks, "--block", world.block)
    assert ended.returncode == 0, ended.stderr
    assert max(errors_px(images, tmp_path / "out", world)) < A_FIFTH_OF_A_PIXEL
    assert statuses(tmp_path / "out", "south") == {f"GCP{k}": "used" for k in range(5)}


def test_marks_of_other_images_are_refused(world: FlatWorld, images: list[Path], tmp_path: Path) -> None:
    marks = write_marks(tmp_path / "marks.csv", world, {"east": 6})
    marks.write_text(marks.read_text().replace("east.tif", "west.tif"))
    ended = register(images, tmp_path / "out", "--control", marks)
    assert ended.returncode == 2
    assert "marks.csv: expected marks in one of 2 images, found none" in ended.stderr
