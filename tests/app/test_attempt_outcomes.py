"""What a worker makes of the end of an attempt's process, whatever the process has written."""

import errno
import signal
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pytest

from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.db.jobs import jobs
from amers.app.db.jobs.jobs import Job
from amers.app.errors import InputError
from amers.app.storage import Storage
from amers.app.worker import attempt
from amers.app.worker.attempt import ATTEMPTS_ALLOWED, Attempts
from amers.app.worker.limits import NO_ROOM, OUT_OF_MEMORY
from tests.app.job_queue import new_job, state_of
from tests.statements import run_in

FILE_TOO_LARGE = -signal.SIGXFSZ
CRASH = -signal.SIGSEGV
LEASE_S = 30.0


@dataclass
class Processes:
    """Processes of attempts that write nothing and end with a code, or never.

    Attributes:
        code: None: they go on until they are closed.
        storage: a file of the attempt is left there.
        closed: whether the last one was ended by the worker.
        cpu_s: CPU that they took.
        waited_s: how long the worker wanted to wait for them.
    """

    code: int | None
    storage: Storage
    closed: bool = False
    cpu_s: float = 0.0
    waited_s: float = 0.0

    def start(
        self, function: str, arguments: Sequence[str], environment: Mapping[str, str]
    ) -> "Processes":
        job_id, number, *_ = arguments
        self.storage.put(f"results/{job_id}/{number}/report.json", [b"{}"])
        return self

    def wait(self, timeout_s: float) -> int | None:
        if self.code is None:
            time.sleep(timeout_s)
            self.waited_s += timeout_s
        return self.code

    def close(self) -> None:
        self.closed = True


@dataclass
class Worker:
    """A worker that does attempts at one job."""

    database: Database
    settings: Settings
    storage: Storage
    job: Job

    def attempt_ends(self, code: int | None, *, stops: bool = False) -> Job:
        """The job after an attempt that is due at once."""
        run_in(self.database.transaction(), "update job set not_before = null")
        return self.attempt_of(Processes(code, self.storage), stops=stops)

    def attempt_of(self, processes: Processes, *, stops: bool = False) -> Job:
        """The job after an attempt of some processes."""
        Attempts(self.database, processes, self.settings, "w", lambda: stops).do_next_job()  # type: ignore[arg-type]
        assert processes.closed
        return state_of(self.database, self.job.id)


@pytest.fixture
def worker(database: Database, settings: Settings, storage: Storage) -> Worker:
    settings = settings.model_copy(update={"lease_seconds": LEASE_S})
    return Worker(database, settings, storage, new_job(database))


@pytest.mark.parametrize(
    ("code", "title"), [(OUT_OF_MEMORY, "Memory limit"), (FILE_TOO_LARGE, "File size limit")]
)
def test_a_job_that_needs_more_than_it_may_have_fails_at_once(worker: Worker, code: int, title: str):
    job = worker.attempt_ends(code)
    assert job.error is not None
    assert (job.state, job.error["title"]) == ("failed", title)
    assert worker.storage.keys("results") == []


@pytest.mark.parametrize(
    ("code", "setting", "variable", "named"),
    [
        (OUT_OF_MEMORY, {"job_memory_bytes": 3 << 30}, "AMERS_JOB_MEMORY_BYTES", "3072 MiB"),
        (FILE_TOO_LARGE, {"job_file_bytes": 5 << 30}, "AMERS_JOB_FILE_BYTES", "5120 MiB"),
        (None, {"job_seconds": 0.1}, "AMERS_JOB_SECONDS", "0.1 s"),
    ],
)
def test_a_job_that_may_not_have_more_says_how_much_and_by_which_setting(
    worker: Worker, code: int | None, setting: dict[str, float], variable: str, named: str
):
    worker.settings = worker.settings.model_copy(update=setting)
    error = worker.attempt_ends(code).error
    assert error is not None
    assert {"type", "title", "detail"} <= error.keys()
    assert f" {named}, the limit of this service ({variable})" in error["detail"]


@pytest.mark.parametrize(
    ("code", "title"), [(CRASH, "Internal error"), (1, "Internal error"), (NO_ROOM, "No room")]
)
def test_a_job_whose_process_broke_off_is_tried_three_times(worker: Worker, code: int, title: str):
    for failures in (1, 2):
        job = worker.attempt_ends(code)
        assert (job.state, job.failures, job.error) == ("accepted", failures, None)
        assert worker.storage.keys("results") == []
    job = worker.attempt_ends(code)
    assert job.error is not None
    assert (job.state, job.error["title"]) == ("failed", title)


@pytest.mark.parametrize(
    ("error", "failures"),
    [
        (OSError(errno.ENOSPC, "full"), [1, 2, None]),
        (OSError(errno.EDQUOT, "quota"), [1, 2, None]),
        (OSError(errno.EIO, "broken"), [0, 0, 0]),
        (OSError(errno.EROFS, "read-only"), [0, 0, 0]),
    ],
)
def test_a_disk_that_is_full_ends_a_job_at_last_and_a_disk_that_is_away_does_not(
    worker: Worker, error: OSError, failures: list[int | None]
):
    """The files of a job that fills a disk may be the reason; a disk that is away is never its fault."""

    class Failing(Processes):
        def start(self, *_arguments: object) -> "Processes":
            self.closed = True
            raise error

    for expected in failures:
        run_in(worker.database.transaction(), "update job set not_before = null")
        job = worker.attempt_of(Failing(None, worker.storage))
        if expected is None:
            assert job.error is not None
            assert (job.state, job.error["title"]) == ("failed", "No room")
            assert job.error["detail"].endswith("was full in 3 attempts")
        else:
            assert (job.state, job.failures, job.error) == ("accepted", expected, None)


@pytest.mark.parametrize("code", [-signal.SIGKILL, -signal.SIGTERM])
def test_a_process_that_others_kill_costs_the_job_no_attempt_of_its_own(worker: Worker, code: int):
    for _ in range(3):
        job = worker.attempt_ends(code)
        assert (job.state, job.failures, job.error) == ("accepted", 0, None)
    assert worker.attempt_ends(CRASH).failures == 1


def test_a_job_whose_process_is_killed_every_time_ends(worker: Worker):
    for _ in range(ATTEMPTS_ALLOWED - 1):
        assert worker.attempt_ends(-signal.SIGKILL).state == "accepted"
    job = worker.attempt_ends(-signal.SIGKILL)
    assert job.error is not None
    assert (job.state, job.error["title"]) == ("failed", "Process killed")
    assert f"in {ATTEMPTS_ALLOWED} attempts" in job.error["detail"]


def test_the_pause_before_the_next_attempt_grows_with_the_failures(worker: Worker):
    for failures in (1, 2):
        worker.attempt_ends(CRASH)
        (row,) = run_in(
            worker.database.transaction(),
            "select extract(epoch from not_before - updated_at) as pause_s from job",
        )
        assert float(row["pause_s"]) == pytest.approx(LEASE_S * failures, abs=1.0)


def test_a_job_of_a_worker_that_stops_waits_again_as_if_it_had_not_begun(worker: Worker):
    job = worker.attempt_ends(None, stops=True)
    assert (job.state, job.failures, job.error) == ("accepted", 0, None)
    assert worker.storage.keys("results") == []


def test_a_job_is_stopped_after_the_time_that_it_may_take(worker: Worker):
    worker.settings = worker.settings.model_copy(update={"job_seconds": 2.0})
    processes, started = Processes(None, worker.storage), time.monotonic()
    job = worker.attempt_of(processes)
    assert time.monotonic() - started > 2.0
    assert processes.waited_s < 3.0
    assert job.error is not None
    assert (job.state, job.error["title"]) == ("failed", "Time limit")


def test_a_dismissed_job_is_noticed_long_before_its_lease_is_due(
    worker: Worker, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(attempt, "LONGEST_BEAT_S", 0.2)
    worker.settings = worker.settings.model_copy(update={"job_seconds": LEASE_S / 6})

    class Dismissed(Processes):
        def wait(self, timeout_s: float) -> int | None:
            with worker.database.transaction() as connection:
                jobs.dismiss(connection, worker.job.id)
            return super().wait(timeout_s)

    processes = Dismissed(None, worker.storage)
    assert worker.attempt_of(processes).state == "dismissed"
    assert processes.waited_s < 3.0


def test_a_worker_whose_database_was_upgraded_claims_nothing(worker: Worker):
    run_in(worker.database.transaction(), "update alembic_version set version_num = '9999'")
    with pytest.raises(InputError, match="restart it"):
        Attempts(
            worker.database,
            Processes(0, worker.storage),  # type: ignore[arg-type]
            worker.settings,
            "w",
            lambda: False,
        ).do_next_job()
    job = state_of(worker.database, worker.job.id)
    assert (job.state, job.attempt) == ("accepted", 0)


@pytest.mark.parametrize("code", [0, CRASH, OUT_OF_MEMORY, None])
def test_the_cpu_of_an_attempt_counts_for_its_owner_however_it_ends(worker: Worker, code: int | None):
    worker.settings = worker.settings.model_copy(update={"job_seconds": 0.1})
    processes = Processes(code, worker.storage, cpu_s=50.0)
    worker.attempt_of(processes)
    rows = run_in(worker.database.transaction(), "select cpu_s from job_turn")
    assert [row["cpu_s"] for row in rows] == [50.0]
