"""`amers surface make` on files: what it writes, how it goes on, and what it says of bad inputs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from amers.app.errors import InputError
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.surface import BANDS, SurfaceFile, SurfaceFiles, run_surface
from amers.services.errors import AmersError
from amers.services.formats.elevation.dem import read_dem
from amers.services.formats.images.raster import write_raster
from amers.services.imagery.source import Window
from amers.services.sensors.rpc import RpcModel
from amers.services.surface import surface as surface_module
from amers.services.surface.options import SurfaceOptions
from tests.command_line import amers_here
from tests.services.surface.worlds import scene, town

OPTIONS = SurfaceOptions(gsd_m=0.5, heights_m=(140.0, 180.0))


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """A pair as files with their RPCs."""
    folder = tmp_path_factory.mktemp("pair")
    paths = []
    for look in ("left", "right"):
        one = scene(look)
        assert isinstance(one.model, RpcModel)
        lines, samples = one.image.shape
        pixels = one.image.read(Window(0, 0, lines, samples)).astype(np.uint16)
        paths.append(folder / f"{look}.tif")
        write_raster(paths[-1], pixels, one.model)
    return tuple(paths)


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
    lon_lat = town().centre_lon_lat[None, :] + [[0.0, -0.0004]]
    assert terrain.height_m(lon_lat) == pytest.approx(town().height_m(lon_lat), abs=0.3)


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


@pytest.mark.thorough
def test_two_processes_write_the_same_bytes(images: tuple[Path, ...], tmp_path: Path) -> None:
    one, two = tmp_path / "one.tif", tmp_path / "two.tif"
    made(images, one)
    made(images, two, jobs=2)
    assert one.read_bytes() == two.read_bytes()


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
