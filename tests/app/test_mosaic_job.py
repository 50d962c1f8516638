"""Mosaics of uploaded scenes by the process `make-mosaic`."""

from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.storage import Storage
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.mosaic import MosaicGround, run_mosaic
from amers.app.usecases.mosaic_scenes import MosaicFiles
from amers.services.mosaic.layout import MosaicMap
from amers.services.mosaic.options import MosaicOptions
from tests.app.callers import Bearer, Caller
from tests.app.ledger import job_runner, make_token
from tests.app.surface_world import OFF_PX, write_pair, write_registrations
from tests.app.test_surface_job import registered
from tests.geotiffs import write_geotiff

LOOKS = ("left", "right")
MADE = {"gsd_m": 1.0, "height_m": 150.0}
TIFF = b"II*\0" + bytes(100)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pair of which one model is off, and its registrations."""
    folder = tmp_path_factory.mktemp("pair")
    write_registrations(write_pair(folder, OFF_PX), folder / "registered")
    return folder


@pytest.fixture
def me(bearer: Bearer) -> Caller:
    return bearer("admin")


def uploaded(me: Caller, folder: Path) -> list[str]:
    return [me.scene((folder / f"{look}.tif").read_bytes(), f"name={look}.tif") for look in LOOKS]


def test_a_job_makes_the_mosaic_of_registered_scenes(
    client: TestClient,
    me: Caller,
    bearer: Bearer,
    settings: Settings,
    storage: Storage,
    database: Database,
    dsn: str,
    folder: Path,
    tmp_path: Path,
) -> None:
    ids = uploaded(me, folder)
    run = job_runner(client, database, settings, me)
    inputs = {"scenes": ids, "registrations": [registered(dsn, storage, folder, ids)], **MADE}
    job = run("make-mosaic", **inputs)
    assert job["status"] == "successful", job
    results = me.get(f"/jobs/{job['jobID']}/results").json()
    for name in ("mosaic.tif", "mosaic.sources.tif", "mosaic.seams.gpkg"):
        served = me.get(results[name]["href"])
        assert served.status_code == 200
        (tmp_path / name).write_bytes(served.content)
    own = run_mosaic(
        MosaicFiles(tuple(folder / f"{look}.tif" for look in LOOKS), folder / "registered"),
        MosaicGround(None, MADE["height_m"]),
        tmp_path / "own.tif",
        MosaicOptions(),
        wanted=MosaicMap(None, MADE["gsd_m"]),
        place=WorkPlace(),
    )
    assert (tmp_path / "mosaic.tif").read_bytes() == own.path.read_bytes()
    assert (tmp_path / "mosaic.sources.tif").read_bytes() == own.sources.read_bytes()
    assert [one["scene"] for one in results["scenes"]] == ids
    assert results["seam_step"] == own.seam_step
    assert results["scenes"][0]["sigma_m"] == own.scenes[0]["sigma_m"]
    with rasterio.open(tmp_path / "mosaic.tif") as file:
        assert file.shape == (results["lines"], results["samples"])
    assert bearer("register").execute("make-mosaic", inputs).status_code == 403


def test_heights_come_from_a_file_below_the_folder_of_references(
    client: TestClient,
    me: Caller,
    settings: Settings,
    database: Database,
    folder: Path,
) -> None:
    ids = uploaded(me, folder)
    references = settings.data_folder / "references"
    references.mkdir(exist_ok=True)
    with rasterio.open(folder / "left.tif") as image:
        centre = image.rpcs
    step = 0.001
    west, north = centre.long_off - 30 * step, centre.lat_off + 30 * step
    ground = np.full((60, 60), MADE["height_m"], dtype=np.float32)
    place = rasterio.transform.from_origin(west, north, step, step)
    write_geotiff(references / "ground.tif", ground, crs="EPSG:4326", transform=place)
    with_folder = settings.model_copy(update={"reference_folder": references})
    run = job_runner(client, database, with_folder, me)
    common = {"scenes": ids, "gsd_m": 1.0, "vertical": "ellipsoid"}
    job = run("make-mosaic", **common, dem="ground.tif")
    assert job["status"] == "successful", job
    shares = [one["share"] for one in me.get(f"/jobs/{job['jobID']}/results").json()["scenes"]]
    assert sum(shares) == pytest.approx(1.0, abs=1e-3)
    away = run("make-mosaic", **common, dem="../data.tif")
    assert (away["status"], away["error"]["error"]) == ("failed", "InputError")
    assert "not a file below the folder of AMERS_REFERENCE_FOLDER" in away["error"]["detail"]
    without = job_runner(client, database, settings, me)("make-mosaic", **common, dem="ground.tif")
    assert "AMERS_REFERENCE_FOLDER is not set" in without["error"]["detail"]


def test_inputs_without_a_mosaic_are_refused(me: Caller) -> None:
    ids = [me.scene(TIFF, f"name={name}.tif") for name in "ab"]
    for change, said in [
        ({"scenes": []}, "scenes: 0 given"),
        ({"gsd_m": 0}, "a length above 0 m expected"),
        ({"feather_px": 513}, "feather_px: 513 found, 0 to 512 expected"),
        ({"dem": "a.tif", "height_m": 1.0}, "dem, height_m: only one of both"),
        ({"vertical": "EGM96"}, "given without dem, whose heights they describe; add dem"),
        ({"crs": "EPSG:0"}, "crs:"),
        ({"bbox": [5.0, 44.0, 6.0, 43.0]}, "bbox: "),
        ({"registrations": [str(UUID(int=1))]}, "none of the jobs registered scene"),
    ]:
        refused = me.execute("make-mosaic", {"scenes": ids, **change})
        assert refused.status_code == 422, refused.json()
        assert said in refused.json()["detail"], change


def test_a_mosaic_that_the_quota_does_not_hold_is_not_made(
    client: TestClient, bearer: Bearer, settings: Settings, database: Database, folder: Path
) -> None:
    used = sum((folder / f"{look}.tif").stat().st_size for look in LOOKS)
    me = make_token(
        client, bearer("admin"), scopes=["admin", "register"], storage_quota_bytes=used + 9_000
    )
    run = job_runner(client, database, settings, me)
    job = run("make-mosaic", scenes=uploaded(me, folder), **MADE)
    assert (job["status"], job["error"]["error"]) == ("failed", "TooLarge")
    assert "left of the storage quota" in job["error"]["detail"]
