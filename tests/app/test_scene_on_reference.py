"""Registration on a reference image on the command line, without control points."""

import json
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from amers.app.cli.main import main
from amers.services.imagery.source import ArrayImage, sample_image
from tests.geotiffs import write_geotiff

pytestmark = pytest.mark.thorough

SHIFT_PX = np.array([5.3, -3.6])
SHIFT_ALLOWED_PX = 0.1
SIZE = 420


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A reference on a map, and a scene of the same ground whose map is a few pixels wrong."""
    folder = tmp_path_factory.mktemp("reference")
    ground = cv2.GaussianBlur(np.random.default_rng(4).normal(size=(512, 512)), (0, 0), 1.5)
    ground = (500.0 + 80.0 * ground / ground.std()).astype(np.float32)
    pixel = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij"), -1) + 40.0
    written = []
    for name, moved in (("reference", np.zeros(2)), ("scene", SHIFT_PX)):
        seen = sample_image(ArrayImage(ground), pixel - moved, 1.0)
        path = folder / f"{name}.tif"
        place = Affine(10, 0, 5e5, 0, -10, 5e6)
        write_geotiff(path, np.clip(seen, 1, 65535).astype(np.uint16), crs="EPSG:32632", transform=place)
        written.append(path)
    return written[0], written[1]


def run(*arguments: str | Path) -> int:
    with (
        patch("sys.argv", ["amers", *(str(argument) for argument in arguments)]),
        pytest.raises(SystemExit) as ended,
    ):
        main()
    return int(ended.value.code or 0)


@pytest.mark.long
def test_a_scene_is_registered_on_a_reference_without_any_database(
    images: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reference, scene = images
    command = ["scene", "register", scene, "--reference", reference, "--sigma-m", "40", "--json"]
    assert run(*command, "-o", tmp_path) == 0
    output = json.loads(capsys.readouterr().out)
    assert output["verdict"] == "good"
    assert np.abs(np.array(output["shift_px"]) - SHIFT_PX).max() < SHIFT_ALLOWED_PX
    assert output["on_the_earth"]["ce90_m"] is None
    assert output["on_the_earth"]["words"].startswith("CE90 unknown")
    report = json.loads((tmp_path / "report.json").read_text())
    (only,) = report["run"]["blocks"]
    assert (only["id"], only["version"]) == ("reference.tif", "reference image")
    assert {"report.html", "correction.json", "control_points.geojson"} <= {
        path.name for path in tmp_path.iterdir()
    }


@pytest.mark.long
def test_the_stated_frame_of_a_reference_gives_an_accuracy_on_the_earth(
    images: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reference, scene = images
    command = ["scene", "register", scene, "--sigma-m", "40", "-o", tmp_path / "out", "--json"]
    frame = ["--reference-sigma-m", "5", "--reference-sigma-up-m", "3"]
    assert run(*command, "--reference", reference, *frame) == 0
    output = json.loads(capsys.readouterr().out)
    relative, earth = output["relative_to_control_points"], output["on_the_earth"]
    assert earth["ce90_m"] == pytest.approx(np.hypot(2.146 * 5.0, relative["ce90_m"]), rel=0.01)
    assert earth["le90_m"] == pytest.approx(1.645 * 3.0, rel=1e-3)
    assert run(*command, *frame) == 2
    assert "add --reference" in capsys.readouterr().err


def write_marks(path: Path) -> Path:
    """Three marks of the ground that the reference shows, without heights."""
    places = np.array([[80.0, 90.0], [300.0, 340.0], [200.0, 100.0]])
    rows = [
        f"GCP{k},{5e5 + 10.0 * (sample + 0.5)},{5e6 - 10.0 * (line + 0.5)},{seen[0]},{seen[1]},2,0.2"
        for k, ((line, sample), seen) in enumerate(zip(places, places + SHIFT_PX, strict=True))
    ]
    head = ["# pixel-origin=centre crs=EPSG:32632", "id,x,y,line,sample,sigma_horizontal_m,sigma_px"]
    path.write_text("\n".join([*head, *rows]) + "\n")
    return path


@pytest.mark.long
@pytest.mark.parametrize("alone", [True, False])
def test_marks_need_no_heights_on_a_map_and_are_added_to_a_reference(
    images: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], alone: bool
) -> None:
    reference, scene = images
    command = ["scene", "register", scene, "--sigma-m", "40", "-o", tmp_path / "out", "--json"]
    marks = ["--control", write_marks(tmp_path / "marks.csv")]
    assert run(*command, *marks, *([] if alone else ["--reference", reference])) == 0
    output = json.loads(capsys.readouterr().out)
    assert np.abs(np.array(output["shift_px"]) - SHIFT_PX).max() < 2.0 * SHIFT_ALLOWED_PX
    assert [mark["status"] for mark in output["marks"]["marks"]] == ["used"] * 3
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    names = [block["id"] for block in report["run"]["blocks"]]
    assert names == (["marks.csv"] if alone else ["reference.tif", "marks.csv"])


def test_terrain_without_a_reference_is_a_mistake(images: tuple[Path, Path], tmp_path: Path) -> None:
    reference, scene = images
    assert run("scene", "register", scene, "--dem", reference, "-o", tmp_path / "none") == 2
    assert not (tmp_path / "none").exists()


def test_a_reference_that_lies_on_no_map_is_refused_by_name(
    images: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = tmp_path / "plain.tif"
    with rasterio.open(plain, "w", driver="GTiff", width=64, height=64, count=1, dtype="uint8") as file:
        file.write(np.full((64, 64), 7, np.uint8), 1)
    output = tmp_path / "registered"
    command = ["scene", "register", images[1], "--reference", plain, "--sigma-m", "40", "-o", output]
    assert run(*command) == 2
    assert "plain.tif: expected an ortho-image on a map" in capsys.readouterr().err
    assert not output.exists(), "a mistake in the command, not a failed registration"
