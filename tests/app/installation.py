"""An installation under test: its application, a caller, its database, storage and workers."""

import subprocess
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import UUID

from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.jobs import jobs
from amers.app.db.jobs.jobs import Job
from amers.app.storage import Storage
from tests.app.callers import Caller
from tests.app.flat_world import FlatWorld
from tests.app.worker_processes import attempts_of, ended, running_worker, scene_to_register, under_way
from tests.statements import run_in

Ask = Callable[[int], str]
Worker = AbstractContextManager["subprocess.Popen[bytes]"]


@dataclass(frozen=True)
class Installation:
    """An installation, a caller of it, and workers that do its jobs.

    Attributes:
        client, me: the application and its caller.
        settings, dsn, storage: of it.
        log: of the workers.
    """

    client: TestClient
    me: Caller
    settings: Settings
    dsn: str
    storage: Storage
    log: Path

    def worker(
        self, environment: Mapping[str, str] | None = None, *prefix: str, **changes: object
    ) -> Worker:
        """A running worker with changed settings, started by a command as `ip netns exec NAME`."""
        settings = self.settings.model_copy(update=changes)
        return running_worker(settings, self.log, *prefix, **(environment or {}))

    def process(self, job: str, worker: "subprocess.Popen[bytes]") -> int:
        """The process in which a worker does a job, once the work has started."""
        under_way(self.client, job, self.me)
        (process,) = attempts_of(worker)
        return process

    def registering(self, world: FlatWorld, image: Path | None = None) -> Ask:
        """Requests the registration of a scene in some passes, on points that are published here."""
        return scene_to_register(self.client, self.me, self.storage, self.dsn, world, image)

    def ended(self, job: str) -> dict[str, Any]:
        """The job, once it has ended."""
        return ended(self.client, job, self.me)

    def row(self, job: str) -> Job:
        """The row of a job."""
        with engine.connect(self.dsn) as connection:
            row = jobs.find(connection, UUID(job.rsplit("/", 1)[-1]))
        assert row is not None
        return row

    def results(self, job: str) -> int:
        """The number of registrations of a job."""
        count = "select count(*) as n from registration where job_id = %s"
        (row,) = run_in(engine.connect(self.dsn), count, [job.rsplit("/", 1)[-1]])
        return int(row["n"])

    def outcome(self, job: dict[str, Any]) -> tuple[str, int, int]:
        """State, number of attempts and number of results of a job that has ended."""
        return job["status"], self.row(job["jobID"]).attempt, self.results(job["jobID"])
