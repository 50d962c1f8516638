"""`amers production points --chips`: a base becomes a block with its own chips."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amers.app.cli.main import main
from amers.services.formats.block.check import check_block
from amers.services.formats.block.reader import FolderChips
from amers.services.imagery.scene import Scene
from amers.services.imagery.source import ArrayImage
from amers.services.map_grid import lon_lat_of_xy, xy_of_lon_lat
from amers.services.registration.on_points import register_scene
from amers.services.sensors.ortho import OrthoModel
from amers.services.types import Acquisition, Array
from tests.services.chip_bases import (
    CORNER_XY,
    LAND_M,
    SIDE,
    UTM,
    BasePoint,
    base_points,
    image,
    north_up,
    write_copernicus,
    write_gcplib,
)
from tests.services.textures import as_pixels

pytestmark = pytest.mark.thorough

NEXT_ZONE = "EPSG:32632"
POINT_SIGMA_M, FRAME_SIGMA_M = 2.0, 1.5
SCENE_M = 5600.0
"""Side of a scene in the middle of the land."""
WRONG_BY_M = np.array([31.0, -24.0])
a_hundredth_of_a_pixel = 0.01
STATED = ("--vertical", "ellipsoid", "--point-sigma-m", f"{POINT_SIGMA_M},5")


def run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: object
) -> tuple[int, str]:
    """The exit code of `amers production points`, and what it prints, or else says, in one line."""
    monkeypatch.setattr(sys, "argv", ["amers", "production", "points", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr()
    return int(end.value.code or 0), " ".join((said.out or said.err).split())


def base_of(rng: np.random.Generator, share: float) -> tuple[list[BasePoint], Array]:
    """Points that a base places beside their details by a share of what it declares; what they share."""
    frame_m = share * FRAME_SIGMA_M * rng.standard_normal(2)
    own_m = share * POINT_SIGMA_M * rng.standard_normal((len(base_points()), 2))
    points = [replace(p, off_m=frame_m + one_m) for p, one_m in zip(base_points(), own_m, strict=True)]
    return points, frame_m


def delivered_scene(gsd_m: float, seed: int) -> tuple[Scene, OrthoModel]:
    """A noisy scene on the map of the next zone, whose grid is wrong; and its true model."""
    middle = np.array(CORNER_XY) + [SIDE * LAND_M / 2.0, -SIDE * LAND_M / 2.0]
    middle = xy_of_lon_lat(NEXT_ZONE, lon_lat_of_xy(UTM, middle[None, :]))[0]
    side = int(SCENE_M / gsd_m)
    true = north_up(NEXT_ZONE, middle + np.array([-1.0, 1.0]) * SCENE_M / 2.0, gsd_m, side)
    noise = 0.2 * np.random.default_rng(seed).standard_normal((side, side))
    wrong = replace(true, origin_xy=true.origin_xy + WRONG_BY_M)
    taken = Acquisition("scene", incidence_deg=0.0, azimuth_deg=0.0)
    pixels = ArrayImage(as_pixels(image(true) + noise))
    return Scene(pixels, OrthoModel(wrong), taken, 30.0), OrthoModel(true)


@pytest.mark.parametrize(
    ("base", "scene_m", "origin"), [("gcplib", 15.0, "centre-1"), ("copernicus", 10.0, "")]
)
@pytest.mark.long
def test_a_scene_registers_on_the_chips_of_a_base_as_accurately_as_declared(
    base: str,
    scene_m: float,
    origin: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lines: list[str] = []
    for seed, share in enumerate([0.0, 1.0]):
        points, frame_m = base_of(np.random.default_rng(seed), share)
        folder = tmp_path / str(seed)
        file = write_gcplib(folder, points) if origin else write_copernicus(folder, points)
        block = folder / "block"
        chips = ["--chips", folder / "chips", *(["--chip-origin", origin] if origin else [])]
        frame = ("--frame-sigma-m", FRAME_SIGMA_M, "--frame-sigma-up-m", 3)
        code, said = run(capsys, monkeypatch, file, *chips, "-o", block, *STATED, *frame, "--json")
        assert code == 0, said
        assert json.loads(said)["points"] == len(points)
        contents = check_block(block)
        scene, true = delivered_scene(scene_m, seed)
        with FolderChips(block) as stored:
            found = register_scene(scene, contents.points, stored)
        assert found.qualification.verdict == "good"
        place = np.array(scene.image.shape) * np.random.default_rng(seed).random((50, 2))
        place = true.locate(place, np.zeros(50))
        off_px = found.model.project(place) - true.project(place)
        error_m = scene_m * off_px @ [[0.0, -1.0], [1.0, 0.0]]  # east, north
        declared = found.qualification.accuracy
        relative_m = np.hypot(*(error_m + frame_m).T)
        lines += [f"{base}: {relative_m.max():.2f} m off the base, {declared.words}"]
        assert share > 0.0 or relative_m.max() < a_hundredth_of_a_pixel * scene_m
        assert relative_m.max() < declared.relative_to_control_points.ce90_m
        assert np.hypot(*error_m.T).max() < declared.on_the_earth.ce90_m
    print(*lines, sep="\n")


@pytest.mark.long
def test_chips_and_views_of_a_block_are_those_of_the_base(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    points = base_points()
    file, block = write_copernicus(tmp_path, points, measures=2), tmp_path / "block"
    (tmp_path / "chips" / "P0_01.TIF").unlink()
    for number in range(2):
        (tmp_path / "chips" / f"P1_0{number}.TIF").write_bytes(b"II*\0 but no more")
    code, said = run(
        capsys, monkeypatch, file, "--chips", tmp_path / "chips", "-o", block, *STATED, "--json"
    )
    assert code == 0, said
    printed = json.loads(said)
    assert (printed["points"], printed["views"]) == (63, 125)
    assert printed["left_out"] == {"its chip cannot be read": 1}
    contents = check_block(block)
    assert [view.image_id for view in contents.points.views.images] == ["GRI-00", "GRI-01"]
    assert contents.document.metadata.specification.gsds_m == tuple(printed["chip_gsds_m"])
    assert 5.0 < printed["chip_gsds_m"][0] < 5.6
    assert contents.document.metadata.description == "63 points of gcp_db.json, chips of the base itself"
    expected = sorted(point.lon_lat for point in points if point.name != "P1")
    np.testing.assert_allclose(sorted(map(tuple, contents.points.lon_lat_h[:, :2])), expected, atol=1e-8)
    sigma_m = np.sqrt(np.diagonal(contents.points.covariance_m2, 0, 1, 2))
    np.testing.assert_allclose(sigma_m, np.tile([POINT_SIGMA_M, POINT_SIGMA_M, 5.0], (63, 1)), rtol=1e-6)
    assert np.isnan(contents.points.frames[0].covariance_m2).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "either images that show its points (--images) or the folder of its own chips (--chips)"),
        (("--chips", "chips", "--images", "x.tif"), "either images that show its points (--images)"),
        (
            ("--chips", "chips"),
            "nothing given; state it (--chip-origin): centre, corner, centre-1, corner-1",
        ),
        (("--chips", "chips", "--chip-origin", "middle"), "middle given; state it (--chip-origin)"),
        (("--chips", "chips", "--gsd-m", "5,20"), "--sigma-m, --bands and --gsd-m are for images"),
        (("--chips", "none", "--chip-origin", "centre"), "expected the folder of the chips"),
        (("--images", "x.tif", "--chip-origin", "centre"), "--chip-origin is for --chips; leave it out"),
    ],
)
def test_what_is_missing_or_meaningless_is_refused_and_nothing_is_written(
    words: tuple[str, ...],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = write_gcplib(tmp_path, base_points(3))
    (tmp_path / "x.tif").touch()
    monkeypatch.chdir(tmp_path)
    code, said = run(capsys, monkeypatch, file, "-o", tmp_path / "block", *STATED, *words)
    assert code == 2
    assert message in said
    assert not (tmp_path / "block").exists()
