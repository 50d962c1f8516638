"""The scenes of a job of `register-scenes`, which scenes of a later job join."""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import UUID

from amers.app.auth import may_access
from amers.app.db.engine import Connection
from amers.app.db.jobs import jobs
from amers.app.db.jobs.jobs import Job
from amers.app.db.tokens import Token
from amers.app.errors import Conflict, InputError, NoSuchJob
from amers.app.usecases.control_files import IMAGES_NPZ
from amers.app.usecases.damage import named_by_row, suspecting_damage
from amers.app.usecases.processes import Work
from amers.app.usecases.registration.joined_scenes import SCENES_JSON, JoinedScenes, Member, read_joined
from amers.app.usecases.results import kept_files
from amers.app.usecases.scene_inputs import present_scene
from amers.app.usecases.scenes import local_image, stored_keys
from amers.services.reports.failure import NOT_REGISTERED


def joinable_scenes(connection: Connection, caller: Token, job_id: UUID) -> list[UUID]:
    """The scenes of a job that others can join, with those that it has joined.

    Raises:
        NoSuchJob: there is none, or the caller may not see it; the message does not say which.
        InputError: the job did not register scenes together.
        Conflict: it is not successful, or its results were removed.
    """
    job = jobs.find(connection, job_id)
    if job is None or not may_access(caller, job.owner):
        raise NoSuchJob(f"no job {job_id}")
    if job.kind != "register-scenes":
        raise InputError(
            f"join: job {job_id} is of the process {job.kind}, one of register-scenes is expected"
        )
    if job.state != "successful":
        raise Conflict(f"join: job {job_id} is {job.state}, successful is expected")
    _file_keys(job)
    results = job.results or {}
    registered = [one["scene"] for one in results.get("scenes", []) if one["verdict"] != NOT_REGISTERED]
    return [UUID(scene) for scene in (*results.get("joined", []), *registered)]


def fetch_joined(work: Work, job_id: UUID, stack: ExitStack) -> JoinedScenes:
    """The scenes of a job with their files on this machine, until the stack closes.

    Raises:
        Conflict: results or scenes were removed since the new job was created.
    """
    with work.database.reading() as connection:
        job = jobs.find(connection, job_id)
        if job is None:
            raise Conflict(f"join: job {job_id} was removed; register its scenes again")
        keys = _file_keys(job)
    folder = Path(stack.enter_context(TemporaryDirectory(prefix="amers-")))
    for key in keys:
        with named_by_row(key):
            of_block = work.storage.fetch(key, folder).parent
    with suspecting_damage(work.database, work.storage, keys):
        joined = read_joined(of_block)
    return replace(joined, members=tuple(_on_this_machine(work, one, stack) for one in joined.members))


def _file_keys(job: Job) -> list[str]:
    """The storage keys of what a job keeps for scenes that join later."""
    files = kept_files(job)
    if not files:
        raise Conflict(f"join: the results of job {job.id} were removed; register its scenes again")
    if not {IMAGES_NPZ, SCENES_JSON} <= files.keys():
        raise InputError(
            f"join: job {job.id} of an earlier release keeps no {IMAGES_NPZ} and {SCENES_JSON}; "
            "register its scenes again"
        )
    return [files[IMAGES_NPZ], files[SCENES_JSON]]


def _on_this_machine(work: Work, member: Member, stack: ExitStack) -> Member:
    """A scene with the path of its image."""
    with work.database.reading() as connection:
        row = present_scene(connection, UUID(member.address))
    scratch = stack.enter_context(TemporaryDirectory(prefix="amers-"))
    with suspecting_damage(work.database, work.storage, stored_keys(row)):
        image = local_image(work.storage, work.settings, row, Path(scratch))
    return replace(member, files=replace(member.files, image=image))
