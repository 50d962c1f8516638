"""`amers production points`: a block of another base, or a refusal that says what to do."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import Transformer
from rasterio.transform import from_origin

from amers.app.cli.main import main
from amers.app.errors import InputError
from amers.app.usecases.image_production import ProductionImages, run_image_production
from amers.app.usecases.new_block import BlockIdentity
from amers.services.formats.block.check import check_block
from amers.services.types import Array
from tests.services.textures import as_pixels, texture

GSD_M = 2.0
SIDE = 500
CORNER_XY = (400_000.0, 5_800_000.0)
UTM = "EPSG:32633"


@dataclass(frozen=True)
class Said:
    """The exit code and the output of a command."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def amers(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """Runs `amers production` in this process."""

    def run(*words: object) -> Said:
        monkeypatch.setattr(sys, "argv", ["amers", "production", *map(str, words)])
        with pytest.raises(SystemExit) as end:
            main()
        output = capsys.readouterr()
        return Said(int(end.value.code or 0), output.out, output.err)

    return run


@pytest.fixture
def image(tmp_path: Path) -> Path:
    return written_image(tmp_path / "ortho.tif")


def written_image(path: Path) -> Path:
    pixels = as_pixels(texture(np.random.default_rng(8), SIDE, 1.5)).astype(np.uint16)
    place = from_origin(*CORNER_XY, GSD_M, GSD_M)
    with rasterio.open(
        path, "w", "GTiff", SIDE, SIDE, 1, dtype=np.uint16, crs=UTM, transform=place
    ) as file:
        file.write(pixels, 1)
    return path


def places() -> Array:
    """Map positions (16, 2) of points whose chips the image shows."""
    side = np.linspace(120.0, SIDE * GSD_M - 120.0, 4)
    x, y = np.meshgrid(side, side)
    return np.column_stack([CORNER_XY[0] + x.ravel(), CORNER_XY[1] - y.ravel()])


def csv(folder: Path, sigmas: bool = True, extra: str = "") -> Path:
    path = folder / "base.csv"
    lines = ["NAME;E;N;H" + (";SH;SV" if sigmas else "")]
    lines += [f"a{i};{x};{y};90" + (";1;2" if sigmas else "") for i, (x, y) in enumerate(places())]
    path.write_text("\n".join(lines) + "\n" + extra)
    return path


COLUMNS = "id=NAME,x=E,y=N,height_m=H"
SIGMA_COLUMNS = COLUMNS + ",sigma_horizontal_m=SH,sigma_up_m=SV"


def test_a_csv_of_another_base_becomes_a_block(amers, image: Path, tmp_path: Path) -> None:
    block = tmp_path / "block"
    far = f"far;{CORNER_XY[0] - 9e3};{CORNER_XY[1]};90;1;2\n"
    words = ("--columns", SIGMA_COLUMNS, "--crs", UTM, "--vertical", "ellipsoid", "--sigma-m", "2")
    frame = ("--frame-sigma-m", "1", "--frame-sigma-up-m", "3")
    said = amers(
        "points", csv(tmp_path, extra=far), "--images", image, "-o", block, *words, *frame, "--json"
    )
    assert said.returncode == 0, said.stderr
    printed = json.loads(said.stdout)
    assert printed["points"] == 16
    assert printed["left_out"] == {"no image shows the whole chip": 1}
    contents = check_block(block)
    to_lon_lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)
    expected = sorted(zip(*to_lon_lat.transform(*places().T), strict=True))
    np.testing.assert_allclose(sorted(map(tuple, contents.points.lon_lat_h[:, :2])), expected, atol=1e-9)
    assert (contents.points.lon_lat_h[:, 2] == 90.0).all()
    sigma_m = np.sqrt(np.diagonal(contents.points.covariance_m2, 0, 1, 2))
    np.testing.assert_allclose(sigma_m[:, 0], np.hypot(1.0, 0.3 * GSD_M), rtol=1e-3)
    np.testing.assert_allclose(sigma_m[:, 2], 2.0, rtol=1e-6)
    frame_m = contents.points.frames[0]
    assert (frame_m.sigma_m, frame_m.sigma_up_m) == pytest.approx((5.0**0.5, 3.0))


def test_a_frame_that_nobody_states_is_unknown(amers, image: Path, tmp_path: Path) -> None:
    block = tmp_path / "block"
    words = ("--columns", SIGMA_COLUMNS, "--crs", UTM, "--vertical", "ellipsoid", "--sigma-m", "2")
    said = amers("points", csv(tmp_path), "--images", image, "-o", block, *words)
    assert said.returncode == 0, said.stderr
    assert "unknown" in said.stdout
    assert np.isnan(check_block(block).points.frames[0].covariance_m2).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--columns", COLUMNS, "--crs", UTM), "does not state the datum of its heights"),
        (("--columns", COLUMNS, "--vertical", "ellipsoid"), "found none; state it (--crs)"),
        (("--vertical", "ellipsoid"), "found none; state it (--crs)"),
        (("--columns", "east=E"), "expected NAME=COLUMN of the file"),
        (("--columns", COLUMNS, "--crs", UTM, "--vertical", "EGM2008"), "pyproj sync --file"),
        (("--columns", COLUMNS, "--crs", UTM, "--vertical", "sea"), "sea given; expected ellipsoid"),
        (
            ("--columns", COLUMNS, "--crs", UTM, "--vertical", "ellipsoid"),
            "--point-sigma-m HORIZONTAL,UP",
        ),
        (("--point-sigma-m", "3"), "HORIZONTAL,UP such as 3,5 expected"),
        (("--point-sigma-m", "3,-5"), "two positive lengths in metres expected"),
        (("--sigma-axes", "xyz"), "ecef or lat-lon-height expected"),
        (("--gsd-m", "20,2"), "with the finer first expected"),
    ],
)
def test_what_nobody_states_is_refused_and_nothing_is_written(
    amers, image: Path, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    file = csv(tmp_path, sigmas=False)
    before = sorted(tmp_path.iterdir())
    said = amers("points", file, "--images", image, "-o", tmp_path / "block", "--sigma-m", "2", *words)
    assert said.returncode == 2
    assert message in " ".join(said.stderr.split())
    assert sorted(tmp_path.iterdir()) == before


def test_heights_may_come_from_a_terrain(amers, image: Path, tmp_path: Path) -> None:
    dem, file = tmp_path / "dem.tif", tmp_path / "flat.csv"
    place = from_origin(CORNER_XY[0] - 100, CORNER_XY[1] + 100, 30.0, 30.0)
    with rasterio.open(dem, "w", "GTiff", 60, 60, 1, dtype=np.float32, crs=UTM, transform=place) as out:
        out.write(np.full((60, 60), 55.0, np.float32), 1)
    file.write_text("x,y\n" + "".join(f"{x},{y}\n" for x, y in places()))
    words = ("--crs", UTM, "--point-sigma-m", "1,9", "--sigma-m", "2")
    refused = amers("points", file, "--images", image, "-o", tmp_path / "block", *words)
    assert "16 of 16 points, such as 1, have no height: give a terrain (--dem FILE)" in " ".join(
        refused.stderr.split()
    )
    heights = ("--dem", dem, "--dem-vertical", "ellipsoid", "--height-sigma-m", "4")
    said = amers("points", file, "--images", image, "-o", tmp_path / "block", *words, *heights)
    assert said.returncode == 0, said.stderr
    points = check_block(tmp_path / "block").points
    np.testing.assert_allclose(points.lon_lat_h[:, 2], 55.0)
    np.testing.assert_allclose(np.sqrt(points.covariance_m2[:, 2, 2]), 4.0, rtol=1e-6)


def test_an_existing_block_is_not_overwritten(amers, image: Path, tmp_path: Path) -> None:
    (tmp_path / "block").mkdir()
    said = amers("points", csv(tmp_path), "--images", image, "-o", tmp_path / "block")
    assert said.returncode == 2
    assert "already exists; a block is written into a new folder" in " ".join(said.stderr.split())


def test_what_cannot_be_written_is_refused_before_the_work(tmp_path: Path) -> None:
    """The images do not exist: nothing was read."""
    (tmp_path / "made.adjustment").write_text("a file in place of the folder of the report")
    (tmp_path / "other.adjustment" / "report.json").mkdir(parents=True)
    (tmp_path / "file").touch()
    images = ProductionImages((tmp_path / "one.tif", tmp_path / "two.tif"))
    for name, why in (
        ("made", "made.adjustment: is a file, a folder expected"),
        ("other", "other.adjustment: contains files, but no manifest.json"),
        ("file/made", "cannot be written"),
    ):
        with pytest.raises(InputError, match=why):
            run_image_production(images, tmp_path / name, BlockIdentity("made"))


@pytest.mark.long
def test_two_ortho_images_make_one_block_on_the_command_line(amers, image: Path, tmp_path: Path) -> None:
    again = written_image(tmp_path / "again.tif")
    heights = ("--height-m", "90", "--height-sigma-m", "5", "--sigma-m", "2", "--points", "25")
    said = amers("ortho", image, again, "-o", tmp_path / "block", *heights, "--json")
    assert said.returncode == 0, said.stderr
    printed = json.loads(said.stdout)
    np.testing.assert_allclose(printed["image_shifts_east_north_m"], np.zeros((2, 2)), atol=0.05)
    contents = check_block(tmp_path / "block")
    assert [view.image_id for view in contents.points.views.images] == ["ortho", "again"]
