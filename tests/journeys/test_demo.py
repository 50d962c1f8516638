"""The demonstration on the simulated world, as a new user runs it."""

import json
import os
from pathlib import Path

import pytest

from tests.command_line import Done, amers_here, amers_process

pytestmark = pytest.mark.long

half_a_pixel = 0.5
injected_m = 50.0


def amers(*words: str | Path) -> Done:
    return amers_here(words, os.environ)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> dict:
    words = ("demo", "-o", tmp_path_factory.mktemp("demo") / "out", "--json")
    result = amers_process(words, os.environ)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def test_all_points_made_are_ingested_and_served(demo):
    assert demo["points_produced"] >= 100
    assert demo["points_ingested"] == demo["points_produced"]
    assert demo["points_served"] == demo["points_produced"]


def test_a_model_wrong_by_fifty_metres_comes_to_agree_with_the_block(demo):
    assert demo["ce90_delivered_on_the_earth_m"] == pytest.approx(injected_m, rel=0.05)
    assert demo["ce90_registered_in_frame_px"] < half_a_pixel
    assert demo["verdict"] == "good"
    assert 20 <= demo["points_active"] <= demo["points_matched"] <= demo["points_visible"]


def test_the_error_of_the_block_itself_is_shown_too(demo):
    assert len(demo["frame_error_east_north_up_m"]) == 3
    assert demo["ce90_registered_on_the_earth_m"] > 0.0


def test_the_report_is_at_the_printed_path(demo):
    report = Path(demo["report"])
    assert "<html" in report.read_text(encoding="utf-8")
    assert (report.parent / "refined_RPC.TXT").is_file()
    manifest = json.loads((report.parent / "manifest.json").read_text())
    files = {path.name for path in report.parent.iterdir()}
    assert files == {*manifest["files"], "manifest.json"}, "a whole result, as any registration leaves"


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    refused = amers("demo", "-o", tmp_path)
    assert refused.returncode == 2
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--images", "one.tif"), "one.tif"),
        (("--images", "one.tif", "--images", "two.tif", "--gsd-m", "2"), "--gsd-m"),
        (("--images", "one.tif", "--images", "two.tif", "--gsd-m", "20,2"), "finer first"),
    ],
)
def test_an_impossible_production_states_the_reason_and_leaves_nothing(tmp_path, words, says):
    images = [tmp_path / "one.tif", tmp_path / "two.tif"]
    for image in images:
        image.touch()
    there = {image.name: image for image in images}
    refused = amers(
        "production", "run", *(there.get(word, word) for word in words), "-o", tmp_path / "block"
    )
    assert refused.returncode == 2
    assert says in refused.stderr
    assert "Traceback" not in refused.stderr
    assert sorted(tmp_path.iterdir()) == images


def test_a_block_that_is_there_is_not_written_over(tmp_path):
    (tmp_path / "block").mkdir()
    first, second = tmp_path / "a.tif", tmp_path / "b.tif"
    first.touch()
    second.touch()
    refused = amers("production", "run", "--images", first, "--images", second, "-o", tmp_path / "block")
    assert refused.returncode == 2
    assert "already exists" in refused.stderr
