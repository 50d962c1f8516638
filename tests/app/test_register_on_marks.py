"""`amers scene register --control`: a scene registered on what a person marked in it, by command."""

import json
import os
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin

from amers.app.cli import scene_registration
from amers.app.cli.remote import _inputs_of_marks, _to_send
from amers.app.cli.scene_registration import Control, _environment
from amers.app.usecases.marked_files import PointStatements
from amers.app.usecases.registration.control_marks import MarkFiles, marks_as_opf
from amers.app.usecases.registration.reference_source import ReferenceFiles
from amers.app.usecases.registration.register import SceneFiles
from amers.app.usecases.terrain_file import TerrainFile
from amers.services.formats.gcp.reader import read_control_points
from amers.services.formats.images.raster import write_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.rpc_files import read_rpc
from amers.services.map_grid import utm_of, xy_of_lon_lat
from tests.command_line import Done, amers_here
from tests.geotiffs import write_geotiff
from tests.services.simulated import ring_of_geometries

GEOMETRY = ring_of_geometries(1, shape=(600, 800))[0]
TRUE = GEOMETRY.rpc
OFF_PX = np.array([24.0, -32.0])
HEAD = "id,image,lon,lat,height_m,line,sample"
SIGMAS = "sigma_horizontal_m,sigma_up_m,sigma_px"
two_hundredths_of_a_pixel = 0.02


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """An image whose RPC is 40 px off."""
    path = tmp_path / "view.tif"
    pixels = np.random.default_rng(0).integers(1, 255, GEOMETRY.plan.shape, dtype=np.uint8)
    write_raster(path, pixels, replace(TRUE, image_offset=TRUE.image_offset - OFF_PX))
    return path


def write_marks(
    path: Path, count: int = 6, head: str = f"{HEAD},{SIGMAS}", extra: str = ",0.1,0.1,0.3"
) -> Path:
    """Marks of exact ground, all over the image."""
    picked = np.random.default_rng(1).uniform([60.0, 60.0], [540.0, 740.0], (count, 2))
    ground = TRUE.locate(picked, np.linspace(80.0, 140.0, count))
    rows = [
        f"GCP{k},view.tif,{lon:.10f},{lat:.10f},{h:.4f},{line:.4f},{sample:.4f}{extra}"
        for k, ((lon, lat, h), (line, sample)) in enumerate(zip(ground, picked, strict=True))
    ]
    path.write_text("\n".join(["# pixel-origin=centre heights=ellipsoid", head, *rows]) + "\n")
    return path


def register(image: Path, *words: object) -> Done:
    command = ["scene", "register", image, *words, "-o", image.parent / "out"]
    return amers_here(command, dict(os.environ))


def report(image: Path) -> dict:
    return json.loads((image.parent / "out" / "report.json").read_text())


def test_the_refined_model_shows_the_ground_where_it_was_marked(image):
    marks = write_marks(image.parent / "marks.csv")
    ended = register(image, "--control", marks, "--control-frame-sigma-m", "0.05,0.05")
    assert ended.returncode == 0, ended.stderr
    refined = read_rpc(image, image.parent / "out" / "view_RPC.TXT").model
    corners = np.array([[0.0, 0.0], [599.0, 799.0]])
    ground = TRUE.locate(corners, np.full(2, 100.0))
    assert refined.project(ground) == pytest.approx(corners, abs=two_hundredths_of_a_pixel)
    assert "One more mark like these would lower the predicted CE90 from" in ended.stdout
    assert "GCP5" in (image.parent / "out" / "control_points_pci.txt").read_text()
    document = report(image)
    assert [mark["name"] for mark in document["marks"]["marks"]] == [f"GCP{k}" for k in range(6)]
    (only,) = document["run"]["blocks"]
    assert (only["id"], only["version"], only["active"]) == ("marks.csv", "marks", 6)
    assert document["on_the_earth"]["ce90_m"] < 1.0
    for page in ("report.html", "report.txt"):
        assert "GCP5" in (image.parent / "out" / page).read_text()


def test_a_blunder_is_named_in_every_place(image):
    marks = write_marks(image.parent / "marks.csv")
    rows = marks.read_text().splitlines()
    cells = rows[4].split(",")
    cells[5] = str(float(cells[5]) + 60.0)
    marks.write_text("\n".join([*rows[:4], ",".join(cells), *rows[5:]]))
    ended = register(image, "--control", marks)
    assert ended.returncode == 0, ended.stderr
    assert "Mark GCP2 is not used: it is 60.0 px off the other marks" in ended.stdout
    assert "Mark GCP2 is not used" in (image.parent / "out" / "report.html").read_text()


def test_sigmas_that_nobody_states_are_said_to_be_assumed(image):
    marks = write_marks(image.parent / "marks.csv", head=HEAD, extra="")
    ended = register(image, "--control", marks)
    assert "ground of the marks: accuracy: " in ended.stderr
    assert "one pixel of the image: assumed (state it with --control-sigma-m" in ended.stderr
    assert "0.5 px: assumed (state it with --control-mark-sigma-px)" in ended.stderr
    ended = register(image, "--control", marks, "--control-sigma-m", "0.2,0.3")
    assert "ground of the marks" not in ended.stderr
    sigma_m = [mark["sigma_m"] for mark in report(image)["marks"]["marks"]]
    assert sigma_m == [[0.2, 0.2, 0.3]] * 6


def test_check_points_of_the_file_are_held_out(image):
    marks = write_marks(image.parent / "marks.csv", head=f"{HEAD},{SIGMAS},check")
    rows = marks.read_text().splitlines()
    flags = ["", "", *(f",{int(k >= 4)}" for k in range(6))]
    marks.write_text("\n".join(row + flag for row, flag in zip(rows, flags, strict=True)))
    ended = register(image, "--control", marks)
    assert ended.returncode == 0, ended.stderr
    document = report(image)
    assert [mark["name"] for mark in document["marks"]["marks"]] == [f"GCP{k}" for k in range(4)]
    assert document["checks"][0]["against"] == "independent check points of marks.csv"
    assert document["checks"][0]["accuracy"]["n"] == 2
    marks.write_text("\n".join([*rows[:2], *(row + ",1" for row in rows[2:])]))
    ended = register(image, "--control", marks)
    assert "marks.csv: all 6 marks are check points, none is left" in ended.stderr


def test_one_mark_is_enough(image):
    ended = register(image, "--control", write_marks(image.parent / "marks.csv", count=1))
    assert ended.returncode == 0, ended.stderr
    assert "A single mark is used, and nothing checks it" in ended.stdout
    assert "is not stated; give --control-frame-sigma-m HORIZONTAL,UP" in ended.stdout


def test_several_files_are_one_set_of_marks(image):
    one = write_marks(image.parent / "one.csv", count=2)
    two = write_marks(image.parent / "two.csv", count=3)
    ended = register(image, "--control", one, "--control", two)
    assert ended.returncode == 0, ended.stderr
    names = [mark["name"] for mark in report(image)["marks"]["marks"]]
    assert names == ["one.csv:GCP0", "one.csv:GCP1", "two.csv:GCP0", "two.csv:GCP1", "two.csv:GCP2"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--control-sigma-m", "3,5"],
            "--control-sigma-m: given without --control, to which it belongs; add --control FILE",
        ),
        (
            ["--control", "MARKS", "--server", "http://localhost", "--control-crs", "EPSG:32631"],
            "the file has lon and lat, degrees of WGS 84; leave --control-crs out",
        ),
        (
            ["--control", "UNSURE", "--control", "MARKS", "--server", "http://localhost"],
            "unsure.csv: marks that are converted for a service need all their sigmas: state those of",
        ),
    ],
)
def test_options_that_do_not_go_together_are_refused(image, words, said):
    files = {
        "MARKS": write_marks(image.parent / "marks.csv"),
        "UNSURE": write_marks(image.parent / "unsure.csv", head=HEAD, extra=""),
    }
    ended = register(image, *(files.get(word, word) for word in words))
    assert ended.returncode == 2
    assert said in ended.stderr


def test_marks_on_a_map_and_a_terrain_are_sent_as_longitude_latitude_and_height(image):
    """A service is sent what this machine has worked out; check points stay check points."""
    columns = "id,image,x,y,line,sample,sigma_horizontal_m,sigma_px,check"
    scene = read_scene(image, sigma_m=5.0)
    picked = np.array([[100.0, 100.0], [300.0, 500.0], [500.0, 200.0]])
    ground = TRUE.locate(picked, np.full(3, 120.0))
    crs = utm_of(*ground[0, :2])
    rows = [
        f"GCP{k},view.tif,{x!r},{y!r},{line!r},{sample!r},0.1,0.3,{int(k == 2)}"
        for k, ((x, y), (line, sample)) in enumerate(
            zip(xy_of_lon_lat(crs, ground[:, :2]).tolist(), picked.tolist(), strict=True)
        )
    ]
    path = image.parent / "map.csv"
    path.write_text("\n".join([f"# pixel-origin=centre crs={crs}", columns, *rows]))
    dem = image.parent / "dem.tif"
    west, south = ground[:, :2].min(axis=0) - 0.01
    place = from_origin(west, south + 0.03, 0.001, 0.001)
    with rasterio.open(dem, "w", "GTiff", 30, 30, 1, "EPSG:4326", place, "float32") as file:
        file.write(np.full((30, 30), 120.0, np.float32), 1)
    marks = MarkFiles((path,), terrain=TerrainFile(dem, "ellipsoid"), terrain_sigma_m=0.2)
    sent = image.parent / "sent.json"
    sent.write_text(marks_as_opf(marks, image, scene))
    read = read_control_points(sent)
    scene.image.close()  # type: ignore[attr-defined]
    assert np.allclose(read.lon_lat_h, ground, rtol=0.0, atol=[1e-9, 1e-9, 1e-3])
    assert np.allclose(read.line_sample, picked)
    assert read.check.tolist() == [False, False, True]
    assert np.allclose(read.sigma_m, [[0.1, 0.1, 0.2]] * 3)


def test_what_is_stated_of_marks_goes_with_them_to_a_service(image, tmp_path):
    """Beside one file, which is sent as it is; within one file made of two, but for the common error."""
    paths = tuple(write_marks(tmp_path / f"{name}.csv", 3, HEAD, "") for name in "ab")
    stated = PointStatements(sigma_m=(1.7, 1.9), frame_sigma_m=(2.3, 2.9), mark_sigma_px=0.7)
    inputs = {"control_frame_sigma_m": (2.3, 2.9)}
    made = _to_send(MarkFiles(paths, stated), SceneFiles(image), tmp_path)
    assert _inputs_of_marks(made) == inputs
    read = read_control_points(made.paths[0])
    assert np.allclose(read.sigma_m, [1.7, 1.7, 1.9])
    assert np.allclose(read.sigma_px, 0.7)
    given = _to_send(MarkFiles(paths[:1], stated), SceneFiles(image), tmp_path)
    assert given.paths == paths[:1]
    inputs |= {"control_sigma_m": (1.7, 1.9), "control_mark_sigma_px": 0.7}
    assert _inputs_of_marks(given) == inputs


def test_scenes_on_control_of_their_own_open_no_store(monkeypatch, tmp_path):
    def opened(_settings: object) -> None:
        raise AssertionError

    monkeypatch.setattr(scene_registration.engine, "opened", opened)
    reference = ReferenceFiles(tmp_path, None)
    own = (
        Control(tmp_path, None),
        Control(None, reference),
        Control(None, None, MarkFiles((tmp_path,))),
    )
    with ExitStack() as stack:
        assert [_environment(stack, control) for control in own] == [{}, {}, {}]


def test_marks_of_other_images_are_refused_by_their_names(image):
    marks = write_marks(image.parent / "marks.csv")
    marks.write_text(marks.read_text().replace("view.tif", "other.tif"))
    ended = register(image, "--control", marks)
    assert ended.returncode == 2
    assert "marks.csv: expected marks in view.tif, found marks in other.tif" in ended.stderr


def test_a_point_is_marked_once(image):
    marks = write_marks(image.parent / "marks.csv")
    rows = marks.read_text().splitlines()
    marks.write_text("\n".join([*rows, rows[2]]))
    ended = register(image, "--control", marks)
    assert "point GCP0 is marked 2 times in the image; leave one mark of each point" in ended.stderr


def test_marks_of_several_scenes_are_told_apart_by_their_names(image):
    other = image.with_name("other.tif")
    other.write_bytes(image.read_bytes())
    marks = write_marks(image.parent / "other.csv")
    marks.write_text(marks.read_text().replace(",view.tif,", ",,"))
    command = ["scene", "register", image, other, "--control", marks, "-o", image.parent / "out"]
    ended = amers_here(command, dict(os.environ))
    assert "other.csv: expected marks in view.tif, found marks in other" in ended.stderr
    document = json.loads((image.parent / "out" / "other" / "report.json").read_text())
    assert document["verdict"] == "usable"


def test_marks_of_qgis_take_their_heights_from_a_terrain(image):
    picked = np.array([[100.0, 120.0], [480.0, 700.0], [300.0, 90.0]])
    ground = TRUE.locate(picked, np.full(3, 120.0))
    rows = [
        f"{lon:.10f},{lat:.10f},{sample + 0.5:.4f},{-(line + 0.5):.4f},1"
        for (lon, lat, _), (line, sample) in zip(ground, picked, strict=True)
    ]
    points = image.with_name("view.points")
    head = ["#CRS: EPSG:4326", "mapX,mapY,sourceX,sourceY,enable"]
    points.write_text("\n".join([*head, *rows]) + "\n")
    ended = register(image, "--control", points)
    assert "3 of 3 points have no height" in ended.stderr
    assert "--control-dem" in ended.stderr
    dem = image.with_name("dem.tif")
    west, north = ground[:, 0].min() - 0.01, ground[:, 1].max() + 0.01
    place = from_origin(west, north, 0.0005, 0.0005)
    write_geotiff(dem, np.full((1, 60, 60), 120.0, np.float32), crs="EPSG:4326", transform=place)
    stated = ["--control-dem", dem, "--control-dem-vertical", "ellipsoid", "--control-dem-sigma-m", "2"]
    ended = register(image, "--control", points, *stated)
    assert ended.returncode == 0, ended.stderr
    document = report(image)
    assert document["correction"]["shift_px"] == pytest.approx(OFF_PX, abs=0.1)
    assert [mark["sigma_m"][2] for mark in document["marks"]["marks"]] == pytest.approx([2.0] * 3)
