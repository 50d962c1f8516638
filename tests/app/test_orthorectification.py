"""Orthorectification of scenes on the command line and by a service."""

import json
from dataclasses import replace
from pathlib import Path
from uuid import UUID

import cv2
import numpy as np
import pytest
import rasterio
import rasterio.vrt
import rasterio.warp
from fastapi.testclient import TestClient
from rasterio.transform import from_origin
from typer.testing import CliRunner

from amers.app.cli.main import app
from amers.app.config import Settings
from amers.app.db import engine, scenes
from amers.app.db.engine import Database
from amers.app.errors import AmersError, InputError
from amers.app.storage import Storage
from amers.app.usecases.jobs import do_attempt
from amers.services.formats.images.raster import write_raster
from amers.services.formats.sensor_models.rpc_text import format_rpc_text, parse_rpc_text
from amers.services.geodesy import metres_per_degree
from amers.services.sensors.rpc import RpcModel
from amers.services.types import Acquisition
from tests.app.callers import Bearer
from tests.app.job_queue import claim
from tests.app.ledger import job_runner, make_token
from tests.app.moved_lines import registration, shifted, stored_registration

MODEL = parse_rpc_text((Path(__file__).parents[1] / "golden" / "invented_RPC.TXT").read_text())
a_pixel = 1.0
a_thousandth = 1e-3

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def in_the_image(lines_off: int = 0) -> RpcModel:
    """The model of an image of 300 x 400 pixels, shifted by a number of lines."""
    line, sample = (int(number) for number in MODEL.image_offset)
    return replace(MODEL, image_offset=MODEL.image_offset - [line - 150 + lines_off, sample - 200])


def write_inputs(folder: Path) -> tuple[Path, Path]:
    """Write an image whose values are its line numbers, and flat ground under it."""
    lon, lat, height_m = (float(number) for number in MODEL.ground_offset)
    pixels = np.repeat(np.arange(1, 301, dtype=np.uint16)[:, None], 400, axis=1)
    write_raster(folder / "scene.tif", pixels, in_the_image())
    heights = np.full((40, 40), height_m, np.float32)
    with rasterio.open(
        folder / "dem.tif",
        "w",
        driver="GTiff",
        height=40,
        width=40,
        count=1,
        dtype="float32",
        crs="EPSG:4326",
        transform=from_origin(lon - 0.02, lat + 0.02, 0.001, 0.001),
    ) as file:
        file.write(heights, 1)
    return folder / "scene.tif", folder / "dem.tif"


def ortho(*words: object) -> dict:
    result = CliRunner().invoke(app, ["scene", "ortho", *(str(word) for word in words), "--json"])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    printed: dict = json.loads(result.stdout)
    return printed


def test_a_scene_is_orthorectified_by_one_command(tmp_path: Path) -> None:
    scene, dem = write_inputs(tmp_path)
    output = ortho(scene, "--dem", dem, "--vertical", "ellipsoid", "-o", tmp_path / "out" / "ortho.tif")
    assert output["error_px"] < 0.1
    assert 0.4 < output["seen"] <= 1.0
    with rasterio.open(tmp_path / "out" / "ortho.tif") as file:
        assert (file.height, file.width, file.count) == (
            output["lines"],
            output["samples"],
            output["bands"],
        )
        row, column = file.height // 2, file.width // 2
        x, y = file.transform @ (column + 0.5, row + 0.5)
        shown = int(file.read(1)[row, column])
        crs = file.crs
    lon, lat = rasterio.warp.transform(crs, "EPSG:4326", [x], [y])
    expected = MODEL.project(np.array([[lon[0], lat[0], MODEL.ground_offset[2]]]))[0, 0]
    line = expected - int(MODEL.image_offset[0]) + 150
    assert shown == pytest.approx(line + 1.0, abs=a_pixel)


def test_the_ground_sampling_of_a_map_in_degrees_is_that_of_its_pixels_on_the_ground(
    tmp_path: Path,
) -> None:
    scene, dem = write_inputs(tmp_path)
    output = tmp_path / "ortho.tif"
    made = ortho(scene, "--dem", dem, "--vertical", "ellipsoid", "--crs", "EPSG:4326", "-o", output)
    with rasterio.open(output) as file:
        step_lon_deg, step_lat_deg = file.res
        lat_deg = (file.bounds.bottom + file.bounds.top) / 2.0
    east_m, north_m = metres_per_degree(lat_deg, 0.0)
    pixel_m2 = step_lon_deg * east_m * step_lat_deg * north_m
    assert made["gsd_m"] == pytest.approx(pixel_m2**0.5, rel=a_thousandth)


def test_a_map_in_links_has_the_metres_that_were_asked_for(tmp_path: Path) -> None:
    """A link is 0.2 m."""
    image, dem = write_inputs(tmp_path)
    words = ("--dem", dem, "--vertical", "ellipsoid", "--gsd-m", 2, "--crs", "EPSG:30200")
    assert ortho(image, *words, "-o", tmp_path / "ortho.tif")["gsd_m"] == pytest.approx(2.0, rel=0.01)


def test_a_scene_that_no_pixel_shows_leaves_the_older_file_and_says_why(tmp_path: Path) -> None:
    image, dem = write_inputs(tmp_path)
    write_raster(image, np.zeros((300, 400), np.uint16), in_the_image())
    with rasterio.open(image, "r+", IGNORE_COG_LAYOUT_BREAK="YES") as file:
        file.nodata = 0
    (tmp_path / "ortho.tif").write_text("older")
    words = ("--dem", dem, "--vertical", "ellipsoid", "-o", tmp_path / "ortho.tif")
    with pytest.raises(InputError, match="no pixel of the map shows the scene: all pixels"):
        ortho(image, *words)
    assert (tmp_path / "ortho.tif").read_text() == "older"
    assert {path.name for path in tmp_path.iterdir()} == {"scene.tif", "dem.tif", "ortho.tif"}


def test_heights_without_a_datum_and_outputs_over_inputs_are_refused(tmp_path: Path) -> None:
    scene, dem = write_inputs(tmp_path)
    with pytest.raises(AmersError, match=r"dem\.tif.*does not state its vertical datum"):
        ortho(scene, "--dem", dem, "-o", tmp_path / "ortho.tif")
    with pytest.raises(AmersError, match="would replace an input file"):
        ortho(scene, "--dem", dem, "--vertical", "ellipsoid", "-o", scene)
    with pytest.raises(AmersError, match="cubic or bilinear"):
        ortho(scene, "--dem", dem, "--kernel", "lanczos", "-o", tmp_path / "ortho.tif")


def test_a_service_rectifies_a_scene_on_a_terrain_uploaded_beside_it(
    client: TestClient, bearer: Bearer, settings: Settings, storage: Storage, dsn: str, tmp_path: Path
) -> None:
    image, dem = write_inputs(tmp_path)
    me = bearer("register")
    scene = me.scene(image.read_bytes())
    laid = me.put(f"/scenes/{scene}/files/dem.tif", content=dem.read_bytes())
    assert laid.status_code == 200, laid.text

    def outcome(**more_inputs: object) -> dict:
        reply = me.execute("orthorectify", {"scene": scene, "dem": "dem.tif", **more_inputs})
        assert reply.status_code == 201, reply.text
        job_id = reply.json()["jobID"]
        with engine.pooled(dsn, settings) as database:
            with database.transaction() as connection:
                assert claim(connection, UUID(job_id), "a worker", 30.0)
            do_attempt(database, settings, UUID(job_id), 1)
        job: dict = me.get(f"/jobs/{job_id}").json()
        if job["status"] == "failed":
            return job
        job_results: dict = me.get(f"/jobs/{job_id}/results").json()
        return job_results

    unsaid = outcome()
    assert unsaid["error"]["error"] == "VerticalDatumError"
    assert "dem.tif" in unsaid["error"]["detail"]
    results = outcome(vertical="ellipsoid")
    assert results["error_px"] < 0.1
    served = me.get(results["ortho.tif"]["href"])
    assert served.headers["content-type"].startswith("image/tiff")
    (tmp_path / "served.tif").write_bytes(served.content)
    ortho(image, "--dem", dem, "--vertical", "ellipsoid", "-o", tmp_path / "own.tif")
    with rasterio.open(tmp_path / "served.tif") as ours, rasterio.open(tmp_path / "own.tif") as own:
        assert (ours.crs, ours.transform) == (own.crs, own.transform)
        np.testing.assert_array_equal(ours.read(), own.read())
    folder = registration(tmp_path / "registered", shifted(20.0))
    (folder / "refined_RPC.TXT").write_text(format_rpc_text(in_the_image(lines_off=20)))
    job = stored_registration(dsn, storage, scene, folder)
    refined = me.get(outcome(vertical="ellipsoid", registration=job)["ortho.tif"]["href"])
    (tmp_path / "refined.tif").write_bytes(refined.content)
    words = ["--dem", dem, "--vertical", "ellipsoid", "--model", folder / "refined_RPC.TXT"]
    ortho(image, *words, "-o", tmp_path / "own_refined.tif")
    with (
        rasterio.open(tmp_path / "refined.tif") as ours,
        rasterio.open(tmp_path / "own_refined.tif") as own,
        rasterio.open(tmp_path / "served.tif") as before,
    ):
        np.testing.assert_array_equal(ours.read(), own.read())
        assert ours.transform != before.transform
    unknown = {"scene": scene, "dem": "dem.tif", "registration": str(UUID(int=1))}
    refused = me.execute("orthorectify", unknown)
    assert refused.status_code == 422
    assert "did not register scene" in refused.json()["detail"]


@pytest.mark.parametrize(
    ("ortho_map", "quota_bytes", "error", "named"),
    [
        ({"gsd_m": 0.05}, None, "InputError", "a finer map shows no more"),
        ({"gsd_m": 0.26}, None, "InputError", "3 times the pixels of what it is made from"),
        ({}, 300_000, "TooLarge", "left of the storage quota"),
    ],
)
def test_a_job_makes_no_map_that_its_scene_and_quota_do_not_warrant(
    ortho_map: dict,
    quota_bytes: int | None,
    error: str,
    named: str,
    client: TestClient,
    bearer: Bearer,
    settings: Settings,
    storage: Storage,
    database: Database,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Most maps with more than 16 times the pixels of their scene are finer than that; so 3 here."""
    monkeypatch.setattr("amers.app.usecases.orthorectification.MOST_MAP_PIXELS", 3)
    image, dem = write_inputs(tmp_path)
    me = make_token(client, bearer("admin"), storage_quota_bytes=quota_bytes)
    scene = me.scene(image.read_bytes())
    me.put(f"/scenes/{scene}/files/dem.tif", content=dem.read_bytes())
    run = job_runner(client, database, settings, me)
    job = run("orthorectify", scene=scene, dem="dem.tif", vertical="ellipsoid", map=ortho_map)
    assert (job["status"], job["error"]["error"]) == ("failed", error), job
    assert named in job["error"]["detail"]
    assert storage.keys("results") == []


def test_a_map_finer_than_its_scene_is_refused_at_the_request_once_the_scene_is_known(
    client: TestClient, bearer: Bearer, dsn: str, tmp_path: Path
) -> None:
    me = bearer("register")
    scene = me.scene(b"II*\0" + bytes(100), "name=a.tif")
    with engine.connect(dsn) as connection:
        scenes.describe(connection, UUID(scene), Acquisition("a"), (300, 400), 0.5)
    statuses = []
    for gsd_m in (0.2, 0.25):
        inputs = {"scene": scene, "dem": "dem.tif", "map": {"gsd_m": gsd_m}}
        reply = me.execute("orthorectify", inputs)
        statuses.append(reply.status_code)
    assert statuses == [422, 201]


@pytest.mark.real_data
@pytest.mark.thorough
def test_two_views_of_one_place_lie_on_each_other_once_rectified(
    real_data: Path, tmp_path: Path
) -> None:
    """The models disagree by up to 1 px; 190 m of relief seen 12.8 degrees apart are 85 px."""
    folder = real_data / "phr_calanques_triplet"
    dem = folder / "expected_output" / "dsm.tif"
    words = ["--dem", dem, "--vertical", "ellipsoid", "--fill-px", 10, "--crs", "EPSG:32631"]
    words += ["--gsd-m", 0.5, "--hide"]
    images = []
    for view in ("01", "03"):
        path = tmp_path / f"{view}.tif"
        ortho(folder / f"img_{view}.tif", *words, "-o", path)
        with (
            rasterio.open(path) as file,
            rasterio.vrt.WarpedVRT(
                file,
                crs=file.crs,
                transform=from_origin(698100.0, 4792940.0, 0.5, 0.5),
                width=640,
                height=640,
            ) as vrt,
        ):
            images.append(vrt.read(1).astype(np.float32))
    seen = (images[0] > 0) & (images[1] > 0)
    assert seen.mean() > 0.5
    offsets = []
    for row in range(40, 560, 40):
        for column in range(40, 560, 40):
            if seen[row : row + 40, column : column + 40].all():
                patch = images[0][row : row + 40, column : column + 40]
                chip = images[1][row + 8 : row + 32, column + 8 : column + 32]
                score = cv2.matchTemplate(patch, chip, cv2.TM_CCOEFF_NORMED)
                if score.max() > 0.8:
                    offsets.append(np.unravel_index(score.argmax(), score.shape))
    assert len(offsets) > 30
    off = np.array(offsets) - 8.0
    assert np.abs(np.median(off, axis=0)).max() <= 2 * a_pixel
    assert np.median(np.abs(off - np.median(off, axis=0))) <= a_pixel
