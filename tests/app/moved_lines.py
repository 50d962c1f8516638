"""A scene whose lines oscillate, and the registration that found it."""

from pathlib import Path
from uuid import UUID

import numpy as np

from amers.app.db import engine
from amers.app.db.jobs import jobs
from amers.app.storage import Storage
from amers.services.formats.sensor_models.correction_json import format_correction
from amers.services.quality.correction_accuracy import CorrectionAccuracy
from amers.services.sensors.correction import ImageCorrection
from amers.services.sensors.displacement import DisplacementGrid
from tests.app.job_queue import store_registration

MIDDLE, HALF_SIZE = np.array([149.5, 199.5]), np.array([150.0, 200.0])
"""Of the image of `test_orthorectification.write_inputs`."""


def jittered() -> ImageCorrection:
    """Lines that oscillate by 4 px, beside a shift."""
    line = np.linspace(-20.0, 320.0, 171)
    displacement = np.zeros((171, 2, 2))
    displacement[:, :, 0] = 4.0 * np.sin(2.0 * np.pi * line / 120.0)[:, None]
    grid = DisplacementGrid(line, np.array([0.0, 399.0]), displacement, 0.0 * displacement)
    return ImageCorrection(shifted(5.0, -3.0).parameters, MIDDLE, HALF_SIZE, grid)


def shifted(lines: float, samples: float = 0.0) -> ImageCorrection:
    """A shift."""
    return ImageCorrection(np.array([[lines, 0.0, 0.0], [samples, 0.0, 0.0]]), MIDDLE, HALF_SIZE)


def registration(
    folder: Path, correction: ImageCorrection, applies_to: str = "RPC of scene.tif"
) -> Path:
    """The folder of a registration that found a correction."""
    folder.mkdir(exist_ok=True)
    stated = CorrectionAccuracy(correction, np.eye(6) * 1e-4, np.zeros(2))
    text = format_correction(stated, "shift", applies_to=applies_to, carried="none")
    (folder / "correction.json").write_text(text)
    return folder


def stored_registration(dsn: str, storage: Storage, scene: str, folder: Path) -> str:
    """The id of a job that registered a scene, with the files of a folder."""
    keys = {
        path.name: storage.put_file(f"results/a/1/{path.name}", path).key for path in folder.iterdir()
    }
    with engine.connect(dsn) as connection:
        job = jobs.create(connection, "register-scene", {})
        assert job is not None
        store_registration(connection, job_id=job.id, scene_id=UUID(scene), files=keys)
    return str(job.id)
