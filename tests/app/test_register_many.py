"""Scenes registered together by `amers scene register-many`."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from jsonschema import validate

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.storage import Storage
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.reports.document import failure_schema, joint_schema, report_schema
from tests.app.flat_world import SIGMA_M, FlatWorld, make_flat_world, publish_world
from tests.app.joint_world import (
    A_FIFTH_OF_A_PIXEL,
    SCENES,
    true_model,
    write_scenes,
)
from tests.app.registration_outputs import largest_error_px
from tests.command_line import Done, amers_here, environment_of
from tests.statements import run_sql

pytestmark = pytest.mark.long

Amers = Callable[..., Done]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> FlatWorld:
    return make_flat_world(tmp_path_factory.mktemp("world"), size=800, points=30)


@pytest.fixture(scope="module")
def folder(world: FlatWorld, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes of the ground of the block, and one of other ground."""
    return write_scenes(world, tmp_path_factory.mktemp("scenes"))


@pytest.fixture
def amers(settings: Settings) -> Amers:
    environment = environment_of(settings)
    return lambda *words: amers_here(words, environment)


def documents(output: Path) -> dict[str, dict]:
    return {path.parent.name: json.loads(path.read_text()) for path in output.glob("*/report.json")}


def on_block(world: FlatWorld, output: Path, *words: object) -> Done:
    """What the command does on the block folder, without any store."""
    control = ("--block", world.block, "--sigma-m", SIGMA_M, "-o", output)
    return amers_here(("scene", "register-many", *words, *control), os.environ)


@pytest.fixture(scope="module")
def three(world: FlatWorld, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Done, Path]:
    """All scenes of the folder, registered together, and the folder of the results."""
    output = tmp_path_factory.mktemp("three") / "out"
    return on_block(world, output, folder, "--json"), output


def test_scenes_are_registered_together_and_the_wrong_one_is_named(
    world: FlatWorld, folder: Path, three: tuple[Done, Path]
):
    result, output = three
    assert result.returncode == 3, result.stderr
    assert "wrong" in result.stderr
    printed = json.loads(result.stdout)
    assert printed["verdict_on_all"] == "incomplete"
    verdicts = {Path(one["scene"]).stem: one["verdict"] for one in printed["scenes"]}
    assert verdicts.pop("wrong") == "not registered"
    assert set(verdicts.values()) <= {"good", "usable"}
    found = documents(output)
    assert set(found) == {"east", "south", "wrong", "block"}
    validate(found["block"], joint_schema())
    assert [one["name"] for one in found["block"]["left"]] == ["wrong"]
    validate(found["wrong"], failure_schema())
    for name in SCENES:
        validate(found[name], report_schema())
        refined = read_rpc(folder / f"{name}.tif", output / name / f"{name}_RPC.TXT").model
        assert largest_error_px(refined, true_model(world, name)) < A_FIFTH_OF_A_PIXEL
        assert found["block"]["scenes"][0]["tie_points"] > 100
    page, text = ((output / "block" / f"report.{kind}").read_text() for kind in ("html", "txt"))
    for words in ("ectZ_amer", "Popini_app", "dXc", "dXY_ect", "wrong"):
        assert words in page
    for label in ("Relative to the control points: CE90", "On the Earth: "):
        assert label in page
        assert label in text
    assert (output / "block" / "images.npz").exists()


@pytest.mark.thorough
def test_a_scene_joins_later_and_the_earlier_files_stay(
    world: FlatWorld, folder: Path, three: tuple[Done, Path], tmp_path: Path
):
    first, second = tmp_path / "first", tmp_path / "second"
    done = on_block(world, first, folder / "east.tif")
    assert done.returncode == 0, done.stderr
    # Metadata of the image, or its file, may name it otherwise than the block does.
    renamed = Path(shutil.copy(folder / "east.tif", tmp_path / "renamed.tif"))
    list_of_scenes = first / "block" / "scenes.json"
    text = list_of_scenes.read_text()
    list_of_scenes.write_text(text.replace(str(folder / "east.tif"), str(renamed)))
    before = {path: path.read_bytes() for path in first.rglob("*") if path.is_file()}
    done = on_block(world, second, folder / "south.tif", "--join", first)
    assert done.returncode == 0, done.stderr
    assert {path: path.read_bytes() for path in first.rglob("*") if path.is_file()} == before
    assert set(documents(second)) == {"south", "block"}
    assert documents(second)["block"]["joined"] != []
    joined, redone = (documents(each)["south"]["correction"] for each in (second, three[1]))
    moved_px = np.subtract(joined["parameters_px"], redone["parameters_px"])
    assert (np.abs(moved_px) < 2.0 * np.array(joined["std_px"])).all()


@pytest.mark.thorough
def test_registrations_on_the_store_are_recorded(
    amers: Amers, world: FlatWorld, folder: Path, tmp_path: Path, dsn: str, storage: Storage
):
    publish_world(dsn, storage, world)
    names = [folder / f"{name}.tif" for name in SCENES]
    done = amers("scene", "register-many", *names, "--sigma-m", SIGMA_M, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "east" in done.stdout
    assert "2 scenes" in done.stdout
    with engine.connect(dsn) as connection:
        assert run_sql(connection, "select count(*) as n from registration").fetchone() == {"n": 2}


def test_nothing_is_written_when_a_folder_holds_other_files(
    world: FlatWorld, folder: Path, tmp_path: Path
):
    output = tmp_path / "out"
    (output / "block").mkdir(parents=True)
    (output / "block" / "mine.txt").write_text("mine")
    done = on_block(world, output, folder / "east.tif")
    assert done.returncode == 2
    assert "block: contains files" in done.stderr
    assert [path.name for path in output.iterdir()] == ["block"]
