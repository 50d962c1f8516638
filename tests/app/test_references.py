"""Reference images of a service: added, used where there are no points, and their recorded places."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from uuid import UUID

import cv2
import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient
from rasterio.transform import Affine

from amers.app.config import Settings
from amers.app.db import engine, references
from amers.app.db.engine import Connection, Database
from amers.app.errors import Conflict, InputError, NotFound
from amers.app.main import create_app
from amers.app.usecases.jobs import do_attempt
from amers.app.usecases.references import (
    NewReference,
    add_reference,
    record_places,
    references_of_store,
    remove_reference,
)
from amers.app.usecases.registration.register import (
    ControlSources,
    RegisteredScene,
    SceneFiles,
    run_registration,
)
from amers.services.errors import CoverageError
from amers.services.imagery.source import ArrayImage, sample_image
from amers.services.map_grid import MapGrid, xy_of_lon_lat
from amers.services.registration.options import RegistrationOptions
from amers.services.types import FloatImage
from tests.app.callers import Bearer
from tests.app.job_queue import claim
from tests.app.s3_server import running_bucket
from tests.app.worker_processes import ended, running_worker
from tests.statements import run_sql
from tests.unproven import unproven_storage

pytestmark = pytest.mark.thorough

SHIFT_PX = np.array([5.3, -3.6])
A_TENTH_OF_A_PIXEL = 0.1
SIZE = 420
GSD_M = 10.0
SIGMA_M = 40.0
OPTIONS = RegistrationOptions()


def write(
    path: Path, pixels: FloatImage, crs: str = "EPSG:32632", corner: tuple[float, float] = (5e5, 5e6)
) -> Path:
    """Write an image on a map, by default in Germany."""
    grid = Affine(GSD_M, 0, corner[0], 0, -GSD_M, corner[1])
    lines, samples = pixels.shape
    profile = {"driver": "GTiff", "width": samples, "height": lines, "count": 1, "dtype": "uint16"}
    path.parent.mkdir(parents=True, exist_ok=True)
    with rasterio.open(path, "w", crs=crs, transform=grid, **profile) as file:
        file.write(np.clip(pixels, 1, 65535).astype(np.uint16), 1)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a reference and two scenes of its ground, whose maps are a few pixels wrong."""
    folder = tmp_path_factory.mktemp("images")
    rng = np.random.default_rng(4)
    ground = cv2.GaussianBlur(rng.normal(size=(512, 512)), (0, 0), 1.5)
    ground = (500.0 + 80.0 * ground / ground.std()).astype(np.float32)
    pixel = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij"), -1) + 40.0
    write(folder / "allowed" / "reference.tif", sample_image(ArrayImage(ground), pixel, 1.0))
    for name, moved in (("first", SHIFT_PX), ("second", -SHIFT_PX)):
        seen = sample_image(ArrayImage(ground), pixel - moved, 1.0)
        write(folder / f"{name}.tif", seen + rng.normal(0.0, 5.0, seen.shape).astype(np.float32))
    return folder


@pytest.fixture
def settings(settings: Settings, folder: Path) -> Settings:
    """Settings with a folder of references."""
    return settings.model_copy(update={"reference_folder": folder / "allowed"})


@pytest.fixture
def database(dsn: str, settings: Settings) -> Iterator[Database]:
    """The database of the test with its pools."""
    with engine.pooled(dsn, settings) as database:
        yield database


@pytest.fixture
def added(connection: Connection, settings: Settings) -> None:
    """The reference, in the store."""
    add_reference(connection, settings, NewReference("land", "reference.tif", sigma_m=3.0))
    connection.commit()


def registered(database: Database, settings: Settings, image: Path, output: Path) -> RegisteredScene:
    """A scene registered like by the service, with its places recorded."""
    find = references_of_store(database, settings)
    files = SceneFiles(image, sigma_m=SIGMA_M)
    made = run_registration(files, ControlSources(None, find), output, options=OPTIONS)
    assert made.reference is not None
    with database.transaction() as connection:
        record_places(connection, made.reference, made.registration, made.footprint)
    return made


def places(connection: Connection) -> list[tuple[int, int]]:
    """The number of attempts and of matches of each place."""
    rows = run_sql(connection, "select attempts, successes from reference_point order by id").fetchall()
    return [(row["attempts"], row["successes"]) for row in rows]


def test_only_files_of_the_folder_that_lie_on_a_map_become_references(
    connection: Connection, settings: Settings, folder: Path
) -> None:
    def refused(reason: str, **changed: object) -> None:
        new = replace(NewReference("land", "reference.tif"), **changed)  # type: ignore[arg-type]
        with pytest.raises(InputError, match=reason):
            add_reference(connection, settings, new)

    refused("image: '../first.tif' is not a file below", image="../first.tif")
    refused("image: .* is not a file below", image=str(folder / "first.tif"))
    refused("image: 'none.tif' is not a file below", image="none.tif")
    refused("dem: 'none.tif' is not a file below", dem="none.tif")
    refused("name: 1 to 120 characters", name=" ")
    refused("sigma_m: 0 found", sigma_m=0.0)
    refused("sigma_up_m: -1 found", sigma_up_m=-1.0)
    refused("given without dem, whose heights they describe", vertical="EGM96")
    closed = settings.model_copy(update={"reference_folder": None})
    with pytest.raises(InputError, match="AMERS_REFERENCE_FOLDER is not set"):
        add_reference(connection, closed, NewReference("land", "reference.tif"))
    assert references.list_references(connection) == []


def test_a_reference_is_known_by_one_name_until_it_is_removed(
    connection: Connection, settings: Settings, added: None
) -> None:
    with pytest.raises(Conflict):
        add_reference(connection, settings, NewReference("land", "reference.tif"))
    connection.rollback()
    (row,) = references.list_references(connection)
    the_scale_of_the_map = 1e-3
    assert (row.name, row.sigma_m) == ("land", 3.0)
    assert row.gsd_m == pytest.approx(GSD_M, rel=the_scale_of_the_map)
    remove_reference(connection, "land")
    with pytest.raises(NotFound):
        remove_reference(connection, "land")


def test_matched_places_are_recorded_and_searched_first_in_the_next_scene(
    database: Database,
    settings: Settings,
    connection: Connection,
    added: None,
    folder: Path,
    tmp_path: Path,
) -> None:
    first = registered(database, settings, folder / "first.tif", tmp_path / "first")
    assert first.report.verdict == "good"
    assert first.report.run.method == "reference image"
    assert [block.id for block in first.report.run.blocks] == ["land"]
    shift_px = first.registration.adjustment.correction.parameters[:, 0]
    assert np.abs(shift_px - SHIFT_PX).max() < A_TENTH_OF_A_PIXEL
    once = places(connection)
    connection.rollback()
    assert 20 < len(once) <= int(first.registration.measures.active.sum())
    assert set(once) == {(1, 1)}

    find = references_of_store(database, settings)
    found_reference = find(first.footprint)
    assert found_reference is not None
    assert found_reference.earlier_places is not None
    assert len(found_reference.earlier_places) == len(once)

    second = registered(database, settings, folder / "second.tif", tmp_path / "second")
    shift_px = second.registration.adjustment.correction.parameters[:, 0]
    assert np.abs(shift_px + SHIFT_PX).max() < A_TENTH_OF_A_PIXEL
    twice = places(connection)
    again = [counts for counts in twice if counts[0] == 2]
    assert len(again) > 0.8 * len(once)
    assert sum(successes for _, successes in again) > 1.9 * len(again)
    assert len(twice) < 1.5 * len(once)


def test_a_failed_registration_leaves_no_places(
    database: Database,
    settings: Settings,
    connection: Connection,
    added: None,
    folder: Path,
    tmp_path: Path,
) -> None:
    find = references_of_store(database, settings)
    files = SceneFiles(folder / "first.tif", sigma_m=SIGMA_M)
    made = run_registration(files, ControlSources(None, find), tmp_path, options=OPTIONS)
    assert made.reference is not None
    failed = replace(
        made.registration, qualification=replace(made.registration.qualification, verdict="failed")
    )
    record_places(connection, made.reference, failed, made.footprint)
    assert places(connection) == []


def test_a_scene_outside_every_reference_is_refused_with_the_reason(
    database: Database, settings: Settings, folder: Path, tmp_path: Path
) -> None:
    files = SceneFiles(folder / "first.tif", sigma_m=SIGMA_M)
    find = references_of_store(database, settings)
    with pytest.raises(CoverageError, match="no reference image shows the ground"):
        run_registration(files, ControlSources(None, find), tmp_path, options=OPTIONS)


def test_a_service_registers_on_a_reference_where_it_has_no_points_or_when_asked(
    settings: Settings,
    database: Database,
    bearer: Bearer,
    folder: Path,
) -> None:
    admin, me = bearer("admin"), bearer("register")
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        body = {"name": "land", "image": "reference.tif"}
        assert client.post("/references", json=body, headers=me).status_code == 403
        assert (
            client.post("/references", json={**body, "image": "../first.tif"}, headers=admin).status_code
            == 422
        )
        assert client.post("/references", json=body, headers=admin).status_code == 201
        listed = client.get("/references", headers=me).json()["references"]
        assert [one["name"] for one in listed] == ["land"]
        upload = client.post(
            f"/scenes?name=first.tif&sigma_m={SIGMA_M}",
            content=(folder / "first.tif").read_bytes(),
            headers=me,
        )
        scene = upload.json()["id"]

        def outcome(method: str) -> dict:
            body = {"inputs": {"scene": scene, "method": method}}
            reply = client.post("/processes/register-scene/execution", json=body, headers=me)
            assert reply.status_code == 201, reply.text
            job_id = reply.json()["jobID"]
            with database.transaction() as connection:
                assert claim(connection, UUID(job_id), "a worker", 30.0)
            do_attempt(database, settings, UUID(job_id), 1)
            job: dict = client.get(f"/jobs/{job_id}", headers=me).json()
            if job["status"] == "successful":
                return client.get(f"/jobs/{job_id}/results", headers=me).json()
            return job

        points_only = outcome("points")
        assert (points_only["status"], points_only["error"]["error"]) == ("failed", "CoverageError")
        for method in ("auto", "reference"):
            assert outcome(method)["method"] == "reference image"
        assert client.delete("/references/land", headers=admin).status_code == 204
        gone = outcome("auto")
        assert "no control point" in gone["error"]["detail"]
        changes = client.get("/audit?kind=reference_image", headers=admin).json()["changes"]
        assert [change["action"] for change in changes] == ["deleted", "created"]


def test_a_service_whose_files_are_in_a_bucket_registers_on_a_reference(
    settings: Settings,
    bearer: Bearer,
    folder: Path,
    dsn: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    admin, me = bearer("admin"), bearer("register")
    with running_bucket(monkeypatch) as url:
        monkeypatch.setenv("AMERS_STORAGE_URL", url)
        monkeypatch.setenv("AMERS_REFERENCE_FOLDER", str(folder / "allowed"))
        elsewhere = settings.model_copy(update={"storage_url": url})
        with (
            TestClient(create_app(elsewhere), raise_server_exceptions=False) as client,
            running_worker(elsewhere, tmp_path / "log"),
        ):
            body = {"name": "land", "image": "reference.tif", "sigma_m": 3.0}
            assert client.post("/references", json=body, headers=admin).status_code == 201
            image = (folder / "first.tif").read_bytes()
            upload = client.post(f"/scenes?name=first.tif&sigma_m={SIGMA_M}", content=image, headers=me)
            request_inputs = {"inputs": {"scene": upload.json()["id"]}}
            job = client.post("/processes/register-scene/execution", json=request_inputs, headers=me)
            ended_job = ended(client, job.headers["location"], me)
            assert ended_job["status"] == "successful", ended_job
            results = client.get(f"{job.headers['location']}/results", headers=me).json()
            assert (results["verdict"], results["method"]) == ("good", "reference image")
            report = client.get(results["report.json"]["href"], headers=me).json()
        shift_px = np.array(report["correction"]["shift_px"])
        assert np.abs(shift_px - SHIFT_PX).max() < A_TENTH_OF_A_PIXEL
        result_keys = unproven_storage(elsewhere).keys(f"results/{ended_job['jobID']}")
        assert any(key.endswith("report.json") for key in result_keys)
    assert not [path for path in settings.data_folder.rglob("*") if path.is_file()], "all in the bucket"
    with engine.connect(dsn) as connection:
        assert len(places(connection)) > 20, "where the scene was found is kept for the next"


EAST_OF_180, WEST_OF_180 = "EPSG:32701", "EPSG:32760"


def centred_on_180(crs: str) -> MapGrid:
    """A map of a UTM zone next to 180 degrees, centred on that meridian."""
    step = np.array([[0.0, GSD_M], [-GSD_M, 0.0]])
    middle = xy_of_lon_lat(crs, np.array([[180.0, -17.0]]))[0]
    return MapGrid(crs, middle - step @ np.full(2, (SIZE - 1) / 2.0), step, (SIZE, SIZE))


def test_scenes_on_either_side_of_180_degrees_are_registered_on_a_reference_across_it(
    database: Database, connection: Connection, settings: Settings, tmp_path: Path
) -> None:
    ground = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(512, 512)), (0, 0), 1.5)
    ground = (500.0 + 80.0 * ground / ground.std()).astype(np.float32)
    of_reference, of_scene = centred_on_180(EAST_OF_180), centred_on_180(WEST_OF_180)
    pixel = np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij"), -1).astype(float)
    shown = of_reference.line_sample(of_scene.lon_lat((pixel - SHIFT_PX).reshape(-1, 2)))
    half = SIZE // 2 + 10

    def corner(of: MapGrid, sample: int = 0) -> tuple[float, float]:
        x, y = of.origin_xy + of.step_xy @ [-0.5, sample - 0.5]
        return float(x), float(y)

    def seen(places: np.ndarray) -> FloatImage:
        return sample_image(ArrayImage(ground), places + 40.0, 1.0)

    allowed = settings.model_copy(update={"reference_folder": tmp_path})
    write(tmp_path / "reference.tif", seen(pixel), EAST_OF_180, corner(of_reference))
    add_reference(connection, allowed, NewReference("land", "reference.tif"))
    connection.commit()
    east = seen((pixel - SHIFT_PX)[:, half:])
    write(tmp_path / "east.tif", east, EAST_OF_180, corner(of_reference, half))
    write(tmp_path / "across.tif", seen(shown.reshape(SIZE, SIZE, 2)), WEST_OF_180, corner(of_scene))
    for name in ("east", "across"):
        made = registered(database, allowed, tmp_path / f"{name}.tif", tmp_path / name)
        shift_px = made.registration.adjustment.correction.parameters[:, 0]
        assert np.abs(shift_px - SHIFT_PX).max() < A_TENTH_OF_A_PIXEL
    # Places of the scene east of 180 degrees are searched in the scene across it.
    assert sum(tried == 2 for tried, _ in places(connection)) > 10
