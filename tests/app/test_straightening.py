"""Scenes whose lines moved, straightened and orthorectified by the command line and by a service."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from amers.app.cli.main import app
from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.errors import AmersError
from amers.app.storage import Storage
from amers.services.formats.images.raster import write_raster
from amers.services.formats.images.scenes import read_scene
from amers.services.formats.sensor_models.rpc_text import format_rpc_text
from amers.services.sensors.correction import CorrectedModel
from amers.services.types import Array
from tests.app.callers import Bearer
from tests.app.ledger import job_runner
from tests.app.moved_lines import jittered, registration, shifted, stored_registration
from tests.app.test_orthorectification import in_the_image, write_inputs

SHAPE = (300, 400)
a_tenth = 0.1

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def run(*words: object) -> dict:
    result = CliRunner().invoke(app, ["scene", *(str(word) for word in words), "--json"])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    printed: dict = json.loads(result.stdout)
    return printed


def grey_at(image: Path, line_sample: Array) -> Array:
    """Values at positions (n, 2), bilinear."""
    with rasterio.open(image) as file:
        pixels = file.read(1).astype(np.float64)
    first = np.floor(line_sample).astype(int)
    part = line_sample - first
    i, j = first.T
    top = pixels[i, j] * (1 - part[:, 1]) + pixels[i, j + 1] * part[:, 1]
    below = pixels[i + 1, j] * (1 - part[:, 1]) + pixels[i + 1, j + 1] * part[:, 1]
    return np.asarray(top * (1 - part[:, 0]) + below * part[:, 0])


def places() -> Array:
    """Positions (n, 2) of the delivered model all over the image."""
    axes = np.linspace(30.0, 260.0, 12), np.linspace(30.0, 370.0, 9)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def test_the_rpc_of_a_straightened_scene_leads_to_what_the_corrected_model_shows(tmp_path: Path) -> None:
    """Values of the image are its line numbers, so that a value is a position."""
    image, _ = write_inputs(tmp_path)
    folder, output = registration(tmp_path / "registered", jittered()), tmp_path / "out" / "straight.tif"
    made = run("straighten", image, "--registered", folder, "-o", output)
    assert (made["lines"], made["samples"], made["bands"]) == (*SHAPE, 1)
    assert made["largest_px"] == pytest.approx(4.0, abs=0.05)
    assert 0.9 < made["seen"] <= 1.0
    assert made["model"] == "an RPC, exactly"
    delivered = in_the_image()
    ground = delivered.locate(places(), np.full(len(places()), delivered.ground_offset[2]))
    straight = read_scene(output, sigma_m=1.0).model
    corrected = CorrectedModel(delivered, jittered()).project(ground)
    shown = grey_at(output, straight.project(ground))
    assert np.abs(shown - grey_at(image, corrected)).max() < 0.5 + a_tenth
    assert np.abs(straight.project(ground) - corrected)[:, 0].max() > 3.0


def test_an_ortho_image_of_a_registration_follows_lines_that_no_rpc_follows(tmp_path: Path) -> None:
    """Also where an RPC was written beside the correction: it is the nearest, and off."""
    image, dem = write_inputs(tmp_path)
    folder = registration(tmp_path / "registered", jittered())
    (folder / "refined_RPC.TXT").write_text(format_rpc_text(in_the_image(lines_off=5)))
    straight = tmp_path / "straight.tif"
    run("straighten", image, "--registered", folder, "-o", straight)
    on_ground = ("--dem", dem, "--vertical", "ellipsoid", "--crs", "EPSG:32631", "--gsd-m", 0.5)
    followed = run("ortho", image, "--registered", folder, *on_ground, "-o", tmp_path / "followed.tif")
    run("ortho", straight, *on_ground, "-o", tmp_path / "of_straight.tif")
    assert followed["error_px"] < a_tenth
    with (
        rasterio.open(tmp_path / "followed.tif") as first,
        rasterio.open(tmp_path / "of_straight.tif") as second,
    ):
        window = first.window(*second.bounds).round_offsets().round_lengths()
        one = first.read(1, window=window, boundless=True, fill_value=0).astype(float)
        other = second.read(1).astype(float)
    both = (one > 20.0) & (other > 20.0) & (one < 280.0)
    assert both.mean() > 0.3
    assert np.quantile(np.abs(one - other)[both], 0.99) <= 1.0


def test_what_cannot_be_straightened_is_refused_and_named(tmp_path: Path) -> None:
    image, _ = write_inputs(tmp_path)
    output = ("-o", tmp_path / "straight.tif")
    affine = registration(tmp_path / "affine", shifted(5.0))
    with pytest.raises(AmersError, match=r"affine: the correction is affine.*use the image as it is"):
        run("straighten", image, "--registered", affine, *output)
    of_rigorous = registration(tmp_path / "rigorous", jittered(), "rigorous model of scene.tif: nearest")
    with pytest.raises(AmersError, match=r"corrects a rigorous model.*without --rigorous"):
        run("straighten", image, "--registered", of_rigorous, *output)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(AmersError, match=r"empty: no correction\.json found, the folder of a registrat"):
        run("straighten", image, "--registered", empty, *output)
    moving = registration(tmp_path / "moving", jittered())
    with pytest.raises(AmersError, match="would replace an input file"):
        run("straighten", image, "--registered", moving, "-o", image)
    assert not (tmp_path / "straight.tif").exists()


def test_bands_types_and_missing_pixels_are_kept(tmp_path: Path) -> None:
    image = tmp_path / "scene.tif"
    write_raster(image, np.zeros(SHAPE, np.uint16), in_the_image())
    with rasterio.open(image) as file:
        rpcs = file.rpcs
    profile = {
        "driver": "GTiff",
        "height": 300,
        "width": 400,
        "count": 3,
        "dtype": "uint16",
        "nodata": 7,
    }
    with rasterio.open(image, "w", **profile) as file:
        file.rpcs = rpcs
        for band in (1, 2, 3):
            pixels = np.full(SHAPE, 1000 * band, np.uint16)
            pixels[100:150, 200:260] = 7
            file.write(pixels, band)
    folder, output = registration(tmp_path / "registered", jittered()), tmp_path / "straight.tif"
    record = run("straighten", image, "--registered", folder, "-o", output)
    assert record["bands"] == 3
    assert record["seen"] == pytest.approx(1.0 - 50 * 60 / (300 * 400), abs=0.02)
    with rasterio.open(output) as file:
        assert (file.dtypes, file.nodata) == (("uint16",) * 3, 7.0)
        bands = file.read()
    assert [set(np.unique(band).tolist()) for band in bands] == [{7, 1000}, {7, 2000}, {7, 3000}]
    assert (bands[0, 110:140, 210:250] == 7).all()


def test_a_service_straightens_what_it_registered(
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    storage: Storage,
    database: Database,
    dsn: str,
    tmp_path: Path,
) -> None:
    image, _ = write_inputs(tmp_path)
    me = bearer("register")
    scene = me.scene(image.read_bytes())
    folder = registration(tmp_path / "registered", jittered())
    job = stored_registration(dsn, storage, scene, folder)
    done = job_runner(client, database, settings, me)("straighten-scene", scene=scene, registration=job)
    assert done["status"] == "successful", done
    results = me.get(f"/jobs/{done['jobID']}/results").json()
    assert results["largest_px"] == pytest.approx(4.0, abs=0.05)
    (tmp_path / "served.tif").write_bytes(me.get(results["straightened.tif"]["href"]).content)
    run("straighten", image, "--registered", folder, "-o", tmp_path / "own.tif")
    with rasterio.open(tmp_path / "served.tif") as ours, rasterio.open(tmp_path / "own.tif") as own:
        np.testing.assert_array_equal(ours.read(), own.read())
        assert ours.rpcs.to_dict() == own.rpcs.to_dict()
