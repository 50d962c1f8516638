"""The scene of the demonstration in its service: uploaded, registered by a job, and drawn on the map."""

from pathlib import Path
from typing import Any
from uuid import UUID

from amers.app.auth import Scope
from amers.app.db.jobs import attempts, jobs
from amers.app.db.tokens import Token
from amers.app.usecases.installation import Installation
from amers.app.usecases.jobs import JobRequest, do_attempt, execute
from amers.app.usecases.scenes import SentFile, upload_scene
from amers.app.usecases.tokens import create_token

_PIECE_BYTES = 1 << 20
_LEASE_S = 600.0


def show_on_map(installation: Installation, image: Path, sigma_m: float) -> UUID:
    """Do for a scene what a user of the map page does, and return the job that registered it.

    Args:
        installation: of the demonstration alone: no other job waits in its queue.
        image: of the scene.
        sigma_m: accuracy of its model, metres.
    """
    with installation.database.transaction() as connection:
        owner = create_token(connection, "demonstration", [Scope.REGISTER]).token
    with image.open("rb") as file:
        sent = SentFile(image.name, iter(lambda: file.read(_PIECE_BYTES), b""))
        scene = str(upload_scene(installation, owner, sent, sigma_m).id)
    registration = _do(installation, owner, "register-scene", {"scene": scene})
    _do(installation, owner, "map-scene", {"scene": scene, "registration": str(registration)})
    return registration


def _do(installation: Installation, owner: Token, process: str, inputs: dict[str, Any]) -> UUID:
    """Do a job of a process here, as a worker would."""
    database, settings = installation.database, installation.settings
    with database.transaction() as connection:
        execute(connection, settings, owner, JobRequest(process, inputs))
    with database.transaction() as connection:
        job = attempts.claim_next(connection, "demonstration", _LEASE_S)
    assert job is not None
    do_attempt(database, settings, job.id, job.attempt)
    with database.reading() as connection:
        done = jobs.find(connection, job.id)
    assert done is not None
    assert done.state == "successful", done.error
    return job.id
