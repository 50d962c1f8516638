"""`amers scene mosaic` on files: what it writes, how it goes on, and what it says of bad inputs."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from rasterio.transform import from_origin

from amers.app.errors import InputError
from amers.app.usecases.executors import ComputeOptions
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.mosaic import MosaicFile, MosaicGround, run_mosaic
from amers.app.usecases.mosaic_scenes import MosaicFiles
from amers.services.errors import AmersError
from amers.services.formats.block.writer import write_block
from amers.services.formats.images.raster import write_raster
from amers.services.formats.sensor_models.correction_json import format_correction
from amers.services.mosaic import mosaic as mosaic_module
from amers.services.mosaic.layout import MosaicMap
from amers.services.mosaic.options import MosaicOptions
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import ImageCorrection
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Frame
from tests.command_line import amers_here
from tests.factories import BOX, affine_model, control_points, metadata, noise_chips
from tests.factories import images as images_of
from tests.geotiffs import write_geotiff
from tests.services.mosaic.worlds import picture

pytestmark = pytest.mark.long

HEIGHT_M = 200.0
_SHAPE = (400, 300)
_LEFT = (0, 180, 360)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """Three raw scenes in a row as files with their RPCs; the second is darker."""
    folder = tmp_path_factory.mktemp("row")
    paths = []
    for number, left in enumerate(_LEFT):
        pixels = picture()[0, : _SHAPE[0], left : left + _SHAPE[1]]
        paths.append(folder / f"scene_{number}.tif")
        write_raster(paths[-1], (pixels * (0.8 if number == 1 else 1.0)).astype(np.uint16), model(left))
    return tuple(paths)


def model(left: int) -> RpcModel:
    whole = affine_model(np.array([5.4, 43.6]))
    return replace(whole, image_offset=np.array([200.0, 330.0 - left]))


def made(images: tuple[Path, ...], output: Path, jobs: int = 1, **options: Any) -> MosaicFile:
    return run_mosaic(
        MosaicFiles(images),
        MosaicGround(None, HEIGHT_M),
        output,
        MosaicOptions(**options),
        wanted=MosaicMap(),
        place=WorkPlace(None, ComputeOptions(jobs, None)),
    )


def test_pixels_sources_and_seams_are_written(images: tuple[Path, ...], tmp_path: Path) -> None:
    mosaic = made(images, tmp_path / "m.tif", level=True)
    named = [(one["number"], one["scene"]) for one in mosaic.scenes]
    assert named == [(1, "scene_0"), (2, "scene_1"), (3, "scene_2")]
    assert sum(one["share"] for one in mosaic.scenes) == pytest.approx(1.0, abs=1e-3)
    assert mosaic.seam_step is not None
    assert mosaic.seam_step["median_m"] < 0.1 * mosaic.gsd_m
    assert mosaic.scenes[1]["gain"][0] / mosaic.scenes[0]["gain"][0] == pytest.approx(1.25, rel=0.01)
    assert not (tmp_path / "m.tif.work").exists()
    with rasterio.open(mosaic.path) as pixels, rasterio.open(mosaic.sources) as sources:
        assert pixels.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert pixels.dtypes == ("uint16",)
        assert (pixels.shape, pixels.transform) == (sources.shape, sources.transform)
        number, seen = sources.read(1), pixels.read(1) > 0
        assert (seen == (number > 0)).all()
        assert set(np.unique(number)) == {0, 1, 2, 3}
        assert mosaic.seen == pytest.approx(np.mean(seen))
        ground = shapely.box(*pixels.bounds)
    seams = pyogrio.raw.read(mosaic.seams)
    names = dict(zip(seams[0]["fields"], seams[3], strict=True))
    assert list(names["scene"]) == ["scene_0", "scene_1", "scene_2"]
    assert list(names["number"]) == [1, 2, 3]
    assert np.isfinite(names["sigma_m"].astype(float)).all()
    areas = shapely.area(shapely.from_wkb(seams[2]))
    shares = [np.mean(number == k) for k in (1, 2, 3)]
    assert areas / ground.area == pytest.approx(shares, abs=0.01)


def test_work_that_was_stopped_goes_on_to_the_same_bytes(
    images: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, stopped = tmp_path / "whole.tif", tmp_path / "stopped.tif"
    made(images, whole)

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(mosaic_module, "tile_task", stop)
        with pytest.raises(KeyboardInterrupt):
            made(images, stopped)
    assert not stopped.exists()
    again = made(images, stopped)
    assert "cells" not in again.effort  # kept from before
    assert stopped.read_bytes() == whole.read_bytes()


@pytest.mark.thorough
def test_two_processes_and_other_tiles_write_the_same_bytes(
    images: tuple[Path, ...], tmp_path: Path
) -> None:
    files = [tmp_path / f"{name}.tif" for name in ("one", "two", "tiles")]
    made(images, files[0], feather_px=6.0)
    made(images, files[1], jobs=2, feather_px=6.0)
    made(images, files[2], feather_px=6.0, tile_px=512)
    for kind in (".tif", ".sources.tif"):
        first, *others = [file.with_name(file.stem + kind).read_bytes() for file in files]
        assert all(other == first for other in others)


def test_the_command_tells_steps_and_scenes(images: tuple[Path, ...], tmp_path: Path) -> None:
    words = ["scene", "mosaic", *images, "-o", tmp_path / "m.tif", "--height-m", HEIGHT_M, "--jobs", 1]
    done = amers_here([*words, "--json"], {"PATH": ""})
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["seam_step"]["found"] > 10
    assert {tuple(pair["scenes"]) for pair in record["pairs"]} >= {("scene_0", "scene_1")}
    done = amers_here(words, {"PATH": ""})
    shown = {line.partition("  ")[0]: line for line in done.stdout.splitlines()}
    assert " median 0.0" in shown["seam step"]
    assert "pixel size (m)" in shown


def test_registered_scenes_fit_where_delivered_ones_do_not(tmp_path: Path) -> None:
    """The delivered model of the second scene is off by 6 lines and 8 samples: 10 pixels."""
    off = np.array([6.0, 8.0])
    paths = []
    for number, left in enumerate(_LEFT[:2]):
        delivered = model(left)
        shift = number * off
        paths.append(tmp_path / f"scene_{number}.tif")
        pixels = picture()[0, : _SHAPE[0], left : left + _SHAPE[1]].astype(np.uint16)
        write_raster(paths[-1], pixels, replace(delivered, image_offset=delivered.image_offset - shift))
        half = np.array(_SHAPE) / 2.0
        correction = ImageCorrection(np.column_stack([shift, np.zeros((2, 2))]), half, half)
        folder = tmp_path / "registered" / f"scene_{number}"
        folder.mkdir(parents=True)
        text = format_correction(
            CorrectionAccuracy(correction, np.diag([0.04, 0.0, 0.0, 0.04, 0.0, 0.0]), np.zeros(2)),
            "shift",
            applies_to="a test",
            carried="by nothing",
        )
        (folder / "correction.json").write_text(text)
    mosaic = run_mosaic(
        MosaicFiles(tuple(paths), registered=tmp_path / "registered"),
        MosaicGround(None, HEIGHT_M),
        tmp_path / "m.tif",
        MosaicOptions(),
        wanted=MosaicMap(),
        place=WorkPlace(None, ComputeOptions(1, None)),
    )
    assert mosaic.seam_step is not None
    assert mosaic.seam_step["median_m"] < 0.1 * mosaic.gsd_m
    assert mosaic.seam_step["delivered"]["median_m"] == pytest.approx(10.0 * mosaic.gsd_m, rel=0.02)
    assert mosaic.scenes[0]["sigma_m"] == pytest.approx(0.2 * mosaic.gsd_m, rel=0.05)


def test_models_of_a_block_have_the_accuracy_of_its_frame(
    images: tuple[Path, ...], tmp_path: Path
) -> None:
    names = [path.stem for path in images]
    points = control_points(4, np.random.default_rng(1), BOX, len(names))
    named = tuple(replace(one, image_id=name) for one, name in zip(images_of(3), names, strict=True))
    points = replace(points, views=replace(points.views, images=named))
    stated = replace(
        metadata("row"), frame=replace(Frame.from_sigmas(3.0, 9.0), shared_m2=np.eye(3) * 16)
    )
    models = {name: model(left) for name, left in zip(names, _LEFT, strict=True)}
    write_block(tmp_path / "block", stated, points, noise_chips(points), models)
    mosaic = run_mosaic(
        MosaicFiles(images, block=tmp_path / "block"),
        MosaicGround(None, HEIGHT_M),
        tmp_path / "m.tif",
        MosaicOptions(),
        wanted=MosaicMap(),
        place=WorkPlace(),
    )
    assert [one["sigma_m"] for one in mosaic.scenes] == [5.0] * 3


def test_a_scene_beyond_the_terrain_is_named(images: tuple[Path, ...], tmp_path: Path) -> None:
    dem = tmp_path / "dem.tif"
    place = from_origin(20.0, 20.0, 0.001, 0.001)
    write_geotiff(dem, np.zeros((20, 20), np.float32), crs="EPSG:4326", transform=place)
    words = ["scene", "mosaic", *images, "-o", tmp_path / "m.tif", "--dem", dem]
    done = amers_here([*words, "--vertical", "ellipsoid"], {"PATH": ""})
    assert done.returncode != 0
    assert "scene_0: the terrain does not cover" in " ".join(done.stderr.split())


def test_scenes_outside_the_box_are_named(images: tuple[Path, ...], tmp_path: Path) -> None:
    corner = model(0).locate(np.array([[100.0, 20.0], [300.0, 150.0]]), np.full(2, HEIGHT_M))
    (west, south), (east, north) = corner[:, :2].min(axis=0), corner[:, :2].max(axis=0)
    box = f"{west},{south},{east},{north}"
    words = ["scene", "mosaic", *images, "-o", tmp_path / "m.tif", "--height-m", HEIGHT_M, "--jobs", 1]
    done = amers_here([*words, "--bbox", box, "--json"], {"PATH": ""})
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["left_out"] == ["scene_1", "scene_2"]
    assert record["seam_step"] is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "give a terrain or surface (--dem), or one height above the ellipsoid (--height-m)"),
        (["--height-m", "200", "--anchor", "scene_0"], "without --level"),
        (["--height-m", "200", "--kernel", "nearest"], "cubic or bilinear expected"),
        (["--height-m", "200", "--level", "--anchor", "x"], "x found, the name of a scene"),
        (["--height-m", "200", "--bbox", "0,0,1,1"], "no scene reaches the box"),
        (["--height-m", "200", "--crs", "EPSG:1"], "no known reference system"),
    ],
)
def test_what_cannot_be_used_is_refused(
    images: tuple[Path, ...], tmp_path: Path, words: list[str], said: str
) -> None:
    done = amers_here(["scene", "mosaic", *images, "-o", tmp_path / "m.tif", *words], {"PATH": ""})
    assert done.returncode != 0
    assert said in " ".join(done.stderr.split())


def test_images_of_other_types_and_the_same_output_are_refused(
    images: tuple[Path, ...], tmp_path: Path
) -> None:
    other = tmp_path / "bytes.tif"
    write_raster(other, np.full(_SHAPE, 7, dtype=np.uint8), model(0))
    with pytest.raises(InputError, match="pixel type: uint8 found, uint16 expected"):
        made((images[0], other), tmp_path / "m.tif")
    with pytest.raises(InputError, match="would replace an image"):
        made(images, images[0])
    with pytest.raises(AmersError, match=r"0 images found"):
        made((), tmp_path / "m.tif")
