"""`amers surface make` on files: what it writes, how it goes on, and what it says of bad inputs."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from amers.app.errors import InputError
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.surface import SurfaceFile, SurfaceFiles, run_surface
from amers.services.errors import AmersError
from amers.services.formats.block.writer import write_block
from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.images.surfaces import BANDS
from amers.services.surface import surface as surface_module
from tests.app.surface_world import LOOKS, OFF_PX, OPTIONS, model_of, write_pair, write_registrations
from tests.command_line import amers_here
from tests.factories import BOX, control_points, metadata, noise_chips
from tests.factories import images as images_of
from tests.services.surface.worlds import town

EVERYWHERE = '{"type": "Polygon", "coordinates": [[[-9, -9], [9, -9], [9, 89], [-9, 89], [-9, -9]]]}'
OPEN_GROUND = town().centre_lon_lat[None, :] + [[0.0, -0.0004]]


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """A pair as files with their RPCs."""
    return write_pair(tmp_path_factory.mktemp("pair"))


@pytest.fixture(scope="module")
def images_off(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """The same with models that do not agree."""
    return write_pair(tmp_path_factory.mktemp("off"), OFF_PX)


def made(images: tuple[Path, ...], output: Path, jobs: int = 1) -> SurfaceFile:
    place = WorkPlace(None, ComputeOptions(jobs, None))
    return run_surface(SurfaceFiles(images), output, OPTIONS, place=place)


def test_the_file_has_heights_above_the_ellipsoid(images: tuple[Path, ...], tmp_path: Path) -> None:
    output = tmp_path / "surface.tif"
    surface = made(images, output)
    assert surface.gsd_m == 0.5
    assert sum(surface.cells.values()) == surface.lines * surface.samples
    assert not output.with_name("surface.tif.work").exists()
    with rasterio.open(output) as file:
        assert file.descriptions == BANDS
        assert file.shape == (surface.lines, surface.samples)
    terrain = read_dem(output)
    assert terrain.geoid is None
    assert terrain.height_m(OPEN_GROUND) == pytest.approx(town().height_m(OPEN_GROUND), abs=0.3)


def test_empty_cells_on_stated_water_say_so(images: tuple[Path, ...], tmp_path: Path) -> None:
    (tmp_path / "sea.geojson").write_text(EVERYWHERE)
    command = ["surface", "make", *images, "-o", tmp_path / "surface.tif", "--gsd-m", 0.5, "--json"]
    command += ["--heights-m", "140,180", "--water", tmp_path / "sea.geojson"]
    done = amers_here(command, {"PATH": ""})
    assert set(json.loads(done.stdout)["cells"]) == {"has a height", "stated as water"}


def test_work_that_was_stopped_goes_on_to_the_same_bytes(
    images: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, stopped = tmp_path / "whole.tif", tmp_path / "stopped.tif"
    made(images, whole)

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(surface_module, "fuse_task", stop)
        with pytest.raises(KeyboardInterrupt):
            made(images, stopped)
    assert not stopped.exists()
    assert (tmp_path / "stopped.tif.work").exists()
    again = made(images, stopped)
    assert "pairs" not in again.effort  # kept from before
    assert stopped.read_bytes() == whole.read_bytes()


def test_the_command_tells_pairs_and_cells(images: tuple[Path, ...], tmp_path: Path) -> None:
    output = tmp_path / "surface.tif"
    words = [
        "surface",
        "make",
        *images,
        "-o",
        output,
        "--gsd-m",
        "1",
        "--heights-m",
        "140,180",
        "--json",
    ]
    done = amers_here(words, {"PATH": ""})
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["pairs"][0]["base_to_height"] == pytest.approx(0.5, abs=0.01)
    assert record["cells"]["has a height"] > 10_000
    page = Path(record["report"]).read_text(encoding="utf-8")
    assert Path(record["report"]) == tmp_path / "surface.html"
    assert page.count("<svg viewBox") == 2
    assert f"{record['sigma_m']:.2f} m" in page
    assert "left + right" in page or "right + left" in page
    for label, count in record["cells"].items():
        assert label in page
        assert f"{count:,}" in page
    assert "m above the ellipsoid" in page


def centre_height_m(surface: Path) -> float:
    """The height of a surface in the middle of the town, on open ground."""
    return float(read_dem(surface).height_m(OPEN_GROUND)[0])


def command(images: tuple[Path, ...], output: Path, *models: object) -> subprocess.CompletedProcess[str]:
    words = ["surface", "make", *images, "-o", output, *models, "--gsd-m", 1, "--heights-m", "140,180"]
    return amers_here([*words, "--json"], {"PATH": ""})


def write_block_of_pair(folder: Path) -> Path:
    """Write a block whose images are the pair, with their true models."""
    points = control_points(4, np.random.default_rng(1), BOX, len(LOOKS))
    named = tuple(replace(one, image_id=look) for one, look in zip(images_of(2), LOOKS, strict=True))
    points = replace(points, views=replace(points.views, images=named))
    models = {look: model_of(look) for look in LOOKS}
    write_block(folder, metadata("town"), points, noise_chips(points), models)
    return folder


def test_registered_models_and_those_of_a_block_are_used(
    images_off: tuple[Path, ...], tmp_path: Path
) -> None:
    registered = write_registrations(images_off, tmp_path / "registered")
    block = write_block_of_pair(tmp_path / "block")
    truth_m = float(town().height_m(OPEN_GROUND)[0])
    found = {}
    for name, models in {"registered": registered, "block": block}.items():
        output = tmp_path / f"{name}.tif"
        done = command(images_off, output, f"--{name}", models)
        assert done.returncode == 0, done.stderr
        found[name] = json.loads(done.stdout)["cells"]["has a height"]
        assert centre_height_m(output) == pytest.approx(truth_m, abs=0.3), name
    assert found["registered"] == pytest.approx(found["block"], rel=0.01)
    delivered = json.loads(command(images_off, tmp_path / "off.tif").stdout)
    assert delivered["cells"]["has a height"] < 0.7 * found["block"]


def test_models_that_are_not_there_are_named(images: tuple[Path, ...], tmp_path: Path) -> None:
    block = write_block_of_pair(tmp_path / "block")
    other = tmp_path / "other.tif"
    other.write_bytes(images[0].read_bytes())
    done = command((images[0], other), tmp_path / "s.tif", "--block", block)
    assert done.returncode != 0
    assert "no image of" in done.stderr
    assert "its images: left, right" in " ".join(done.stderr.split())
    done = command(images, tmp_path / "s.tif", "--registered", tmp_path)
    assert done.returncode != 0
    assert "no correction.json found" in " ".join(done.stderr.split())
    assert not (tmp_path / "s.tif").exists()


@pytest.mark.parametrize(
    ("heights", "said"),
    [("180,140", "the lower height first expected"), ("low", "LOW,HIGH in metres expected")],
)
def test_heights_that_are_none_are_refused(
    images: tuple[Path, ...], tmp_path: Path, heights: str, said: str
) -> None:
    words = ["surface", "make", *images, "-o", tmp_path / "s.tif", "--heights-m", heights]
    done = amers_here(words, {"PATH": ""})
    assert done.returncode != 0
    assert said in " ".join(done.stderr.split())


def test_one_image_and_the_same_output_are_refused(images: tuple[Path, ...], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="a surface needs two or more"):
        made(images[:1], tmp_path / "s.tif")
    with pytest.raises(InputError, match="would replace an image"):
        made(images, images[0])
    with pytest.raises(AmersError, match="base over height"):
        made((images[0], images[0]), tmp_path / "s.tif")
