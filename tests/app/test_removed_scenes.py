"""A scene that its owner removes while a job reads it: the job says so, whatever broke by that."""

from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
import rasterio

from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.usecases import scene_view
from amers.app.usecases.jobs import do_attempt
from amers.app.usecases.registration import job as registration_job
from tests.app.callers import Bearer
from tests.app.job_queue import claimed, state_of


@pytest.mark.parametrize(
    ("process", "module", "step"),
    [
        ("view-scene", scene_view, "open_image"),
        ("view-scene", scene_view, "local_image"),
        ("register-scene", registration_job, "local_image"),
        ("register-scene", registration_job, "run_registration"),
    ],
)
def test_a_job_whose_scene_is_removed_names_the_scene(
    bearer: Bearer,
    settings: Settings,
    database: Database,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    process: str,
    module: object,
    step: str,
) -> None:
    me, path = bearer("register"), tmp_path / "scene.tif"
    shape = {"count": 1, "height": 64, "width": 64, "dtype": "uint8"}
    with rasterio.open(path, "w", driver="GTiff", **shape) as file:
        file.write(np.ones((1, 64, 64), "uint8"))
    scene = me.post("/scenes?name=scene.tif", content=path.read_bytes()).json()["id"]
    sent = me.post(f"/processes/{process}/execution", json={"inputs": {"scene": scene}})
    job = claimed(database, UUID(sent.json()["jobID"]))
    real = getattr(module, step)

    def removing(*arguments: object, **named: object) -> object:
        assert me.delete(f"/scenes/{scene}").status_code == 204
        return real(*arguments, **named)

    monkeypatch.setattr(module, step, removing)
    do_attempt(database, settings, job.id, job.attempt)
    failed = state_of(database, job.id)
    assert failed.error is not None
    assert (failed.state, failed.error["title"]) == ("failed", "Conflict")
    assert failed.error["detail"] == f"scene {scene} was removed while this job used it; upload it again"
