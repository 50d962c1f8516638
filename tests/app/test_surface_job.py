"""Surfaces of uploaded scenes by the process `make-surface`."""

from pathlib import Path
from uuid import UUID, uuid4

import numpy as np
import pytest
import rasterio
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine, scenes
from amers.app.db.engine import Database
from amers.app.db.jobs import attempts, jobs
from amers.app.db.jobs.attempts import LostJob
from amers.app.storage import Storage
from amers.app.usecases.image_production import WorkPlace
from amers.app.usecases.jobs import do_attempt
from amers.app.usecases.processes import work_folder
from amers.app.usecases.results import discard_work
from amers.app.usecases.surface import SurfaceFiles, run_surface
from amers.services.formats.images.surfaces import BANDS
from amers.services.surface import stages, surface
from amers.services.types import Acquisition
from tests.app.callers import Bearer, Caller
from tests.app.job_queue import claimed, let_lease_lapse, state_of, store_registration
from tests.app.ledger import job_runner, make_token
from tests.app.surface_world import OFF_PX, OPTIONS, write_pair, write_registrations

MADE = {"gsd_m": OPTIONS.gsd_m, "heights_m": OPTIONS.heights_m}
ROOM_FOR_THE_MAP_BYTES = 1_000_000
TIFF = b"II*\0" + bytes(100)
FILES = ("correction.json", "refined_RPC.TXT")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A pair of which one model is off, and its registrations."""
    folder = tmp_path_factory.mktemp("pair")
    write_registrations(write_pair(folder, OFF_PX), folder / "registered")
    return folder


@pytest.fixture
def me(bearer: Bearer) -> Caller:
    return bearer("register")


def uploaded(me: Caller, folder: Path) -> list[str]:
    """The ids of both scenes."""
    images = [folder / f"{look}.tif" for look in ("left", "right")]
    return [me.scene(image.read_bytes(), f"name={image.name}") for image in images]


def registered(dsn: str, storage: Storage, folder: Path, ids: list[str]) -> str:
    """The id of a job that has registered the scenes."""
    with engine.connect(dsn) as connection:
        job = jobs.create(connection, "register-scenes", {})
        assert job is not None
        for look, scene in zip(("left", "right"), ids, strict=True):
            paths = {name: folder / "registered" / look / name for name in FILES}
            keys = {
                name: storage.put_file(f"results/{job.id}/1/{look}/{name}", path).key
                for name, path in paths.items()
            }
            store_registration(connection, job_id=job.id, scene_id=UUID(scene), files=keys)
    return str(job.id)


def test_a_job_makes_the_surface_of_registered_scenes(
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
    off = run("make-surface", scenes=ids, **MADE)
    inputs = {"scenes": ids, "registrations": [registered(dsn, storage, folder, ids)], **MADE}
    job = run("make-surface", **inputs)
    assert job["status"] == "successful", job
    assert {link["href"] for link in job["links"] if link.get("title") == "scene"} == {
        f"http://testserver/scenes/{scene}" for scene in ids
    }
    results = me.get(f"/jobs/{job['jobID']}/results").json()
    served = me.get(results["surface.tif"]["href"])
    assert served.headers["content-type"].startswith("image/tiff")
    (tmp_path / "served.tif").write_bytes(served.content)
    page = me.get(results["report.html"]["href"])
    assert page.headers["content-type"].startswith("text/html")
    assert f"{ids[0]} + {ids[1]}" in page.text
    files = SurfaceFiles((folder / "left.tif", folder / "right.tif"), folder / "registered")
    own = run_surface(files, tmp_path / "own.tif", OPTIONS, place=WorkPlace())
    assert (tmp_path / "served.tif").read_bytes() == (tmp_path / "own.tif").read_bytes()
    with rasterio.open(tmp_path / "served.tif") as file:
        assert file.descriptions == BANDS
        assert (file.height, file.width) == (results["lines"], results["samples"])
        found = int(np.isfinite(file.read(1)).sum())
    assert results["cells"] == own.cells
    assert results["cells"]["has a height"] == found
    assert results["pairs"][0]["images"] == ids
    assert results["pairs"][0]["base_to_height"] == pytest.approx(0.5, abs=0.01)
    assert 0.0 < results["sigma_m"] < 1.0
    assert results["crs"] == own.crs
    # Models that do not agree give no such surface.
    assert off["status"] == "failed" or (
        me.get(f"/jobs/{off['jobID']}/results").json()["cells"]["has a height"] < found / 2
    )
    stranger = make_token(client, bearer("admin"))
    assert stranger.execute("make-surface", inputs).status_code == 404
    assert bearer("read").execute("make-surface", inputs).status_code == 403


def test_inputs_without_a_surface_are_refused(me: Caller, dsn: str) -> None:
    ids = [me.scene(TIFF, f"name={name}.tif") for name in "ab"]
    with engine.connect(dsn) as connection:
        for scene in ids:
            scenes.describe(connection, UUID(scene), Acquisition("a"), (300, 300), 0.5)
    for change, said in [
        ({"scenes": []}, "scenes: 0 given"),
        ({"pairs": 0}, "pairs: 0 found, 1 to 100 expected"),
        ({"fill_cells": 21}, "fill_cells: 21 found, 0 to 20 expected"),
        ({"heights_m": [180, 140]}, "the lower height first expected"),
        ({"gsd_m": 0}, "a length above 0 m expected"),
        ({"gsd_m": 0.2}, "a finer map shows no more"),
        ({"registrations": [str(UUID(int=1))]}, "none of the jobs registered scene"),
        ({"block": "flat"}, "block: no such input"),
    ]:
        refused = me.execute("make-surface", {"scenes": ids, **change})
        assert refused.status_code == 422, change
        assert said in refused.json()["detail"], change
    assert me.execute("make-surface", {"scenes": [ids[0], ids[0]]}).status_code == 422
    assert me.execute("make-surface", {"scenes": [ids[0], str(uuid4())]}).status_code == 404
    assert me.execute("make-surface", {"scenes": ids}).status_code == 201


def test_a_surface_that_the_quota_does_not_hold_is_not_begun(
    client: TestClient, bearer: Bearer, settings: Settings, database: Database, folder: Path
) -> None:
    used = sum((folder / f"{look}.tif").stat().st_size for look in ("left", "right"))
    me = make_token(client, bearer("admin"), storage_quota_bytes=used + 100_000)
    run = job_runner(client, database, settings, me)
    job = run("make-surface", scenes=uploaded(me, folder), **MADE)
    assert (job["status"], job["error"]["error"]) == ("failed", "TooLarge")
    assert "left of the storage quota" in job["error"]["detail"]


def test_what_is_kept_meanwhile_counts_like_what_is_stored(
    client: TestClient, bearer: Bearer, settings: Settings, database: Database, folder: Path
) -> None:
    """Cells of 1 m make a small map, and are matched with all pixels."""
    used = sum((folder / f"{look}.tif").stat().st_size for look in ("left", "right"))
    me = make_token(client, bearer("admin"), storage_quota_bytes=used + ROOM_FOR_THE_MAP_BYTES)
    run = job_runner(client, database, settings, me)
    job = run("make-surface", scenes=uploaded(me, folder), **{**MADE, "gsd_m": 1.0})
    assert (job["status"], job["error"]["error"]) == ("failed", "InputError")
    assert "intermediate results would take more than" in job["error"]["detail"]


def test_an_attempt_goes_on_from_what_a_lost_one_has_matched(
    me: Caller,
    settings: Settings,
    storage: Storage,
    database: Database,
    dsn: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ids = uploaded(me, folder)
    inputs = {"scenes": ids, "registrations": [registered(dsn, storage, folder, ids)], **MADE}
    job_id = UUID(me.execute("make-surface", inputs).json()["jobID"])

    def lost(*_: object) -> None:
        raise LostJob("the worker died")

    def never(*_: object) -> None:
        raise AssertionError("matched again")

    claimed(database, job_id)
    with monkeypatch.context() as patched:
        patched.setattr(surface, "fuse_task", lost)
        with pytest.raises(LostJob):
            do_attempt(database, settings, job_id, 1)
    discard_work(database, storage, job_id)
    assert len(storage.unfinished(work_folder(job_id))) == 1
    let_lease_lapse(database, job_id)
    with database.transaction() as connection:
        attempts.take_back(connection, attempts_allowed=10)
    claimed(database, job_id)
    monkeypatch.setattr(stages, "match_task", never)
    do_attempt(database, settings, job_id, 2)
    job = state_of(database, job_id)
    assert (job.state, job.attempt) == ("successful", 2), job.error
    discard_work(database, storage, job_id)
    assert storage.unfinished(work_folder(job_id)) == []
