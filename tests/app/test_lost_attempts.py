"""An attempt that has lost its job does not begin, stores nothing, and goes no further."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from uuid import UUID, uuid4

import psycopg
import pytest
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict

from amers.app.auth import Scope
from amers.app.config import Settings
from amers.app.db.cluster.embedded import SUPERUSER, Cluster
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts, jobs
from amers.app.db.jobs.attempts import LostJob
from amers.app.db.jobs.jobs import Job
from amers.app.db.scenes import begin_upload
from amers.app.errors import InputError
from amers.app.usecases.jobs import PROCESSES, do_attempt
from amers.app.usecases.processes import Commit, Process, Work
from amers.app.worker.attempt import Attempts
from tests.app.job_queue import claimed, let_lease_lapse, new_job, state_of
from tests.statements import run_in, run_sql

Event = Callable[[Database, Job], None]


@dataclass(frozen=True)
class SceneOnly:
    """Inputs of a process that stores a row and does nothing else."""

    scene: UUID


def dismissed(database: Database, job: Job) -> None:
    with database.transaction() as connection:
        jobs.dismiss(connection, job.id)


def removed(database: Database, job: Job) -> None:
    dismissed(database, job)
    with database.transaction() as connection:
        jobs.delete_ended(connection, [job.id])


def given_back(database: Database, job: Job) -> None:
    with database.transaction() as connection:
        attempts.give_back(connection, job.id, job.attempt)


def taken_back(database: Database, job: Job) -> None:
    let_lease_lapse(database, job.id)
    with database.transaction() as connection:
        attempts.take_back(connection, attempts_allowed=10)


def taken_over(database: Database, job: Job) -> None:
    taken_back(database, job)
    claimed(database, job.id, "heir")


def ended(database: Database, job: Job) -> None:
    with database.transaction() as connection:
        attempts.succeed(connection, job.id, job.attempt, {})


EVENTS = (dismissed, removed, given_back, taken_back, taken_over, ended)


@pytest.fixture
def job(database: Database) -> Job:
    """A job at which the first attempt has been claimed."""
    return claimed(database, new_job(database).id)


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Work], None]], None]:
    """Makes the job's process one that works as told, then stores a scene."""

    def install(work_as_told: Callable[[Work], None]) -> None:
        def commit(connection: Connection) -> dict[str, object]:
            begin_upload(connection, None, "stored by the attempt", "a.tif", sigma_m=None)
            return {}

        def run(work: Work) -> Commit:
            work_as_told(work)
            return commit

        own = Process("register-scene", "", "", Scope.REGISTER, SceneOnly, {}, lambda *_: None, run)
        monkeypatch.setitem(PROCESSES, "register-scene", own)

    return install


def stored(database: Database) -> int:
    (row,) = run_in(database.transaction(), "select count(*) as n from scene")
    return int(row["n"])


def rows_of_jobs(database: Database) -> list[dict[str, object]]:
    return run_in(database.transaction(), "select * from job")


def test_an_attempt_that_keeps_its_job_stores_its_outcome(database, settings, job, process):
    process(lambda work: work.progress(0.5, "half done"))
    do_attempt(database, settings, job.id, job.attempt)
    assert (state_of(database, job.id).state, stored(database)) == ("successful", 1)


@pytest.mark.parametrize("event", EVENTS)
def test_an_attempt_at_a_job_that_went_on_without_it_does_not_begin(
    database, settings, job, process, event: Event
):
    begun = []
    process(begun.append)
    event(database, job)
    before = rows_of_jobs(database)
    with pytest.raises(LostJob):
        do_attempt(database, settings, job.id, job.attempt)
    assert (begun, stored(database), rows_of_jobs(database)) == ([], 0, before)


@pytest.mark.parametrize("event", EVENTS)
def test_what_an_attempt_made_is_stored_with_its_job_or_not_at_all(
    database, settings, job, process, event: Event
):
    process(lambda work: event(database, job))
    with pytest.raises(LostJob):
        do_attempt(database, settings, job.id, job.attempt)
    assert stored(database) == 0
    assert all(row["results"] is None or event is ended for row in rows_of_jobs(database))


@pytest.mark.parametrize("event", EVENTS)
def test_the_error_of_an_attempt_that_lost_its_job_ends_nothing(
    database, settings, job, process, event: Event
):
    def fail(work: Work) -> None:
        event(database, job)
        raise InputError("too late")

    process(fail)
    with pytest.raises(LostJob):
        do_attempt(database, settings, job.id, job.attempt)
    assert all(row["error"] is None for row in rows_of_jobs(database))


@pytest.mark.parametrize("event", EVENTS)
def test_an_attempt_learns_by_its_progress_that_it_lost_its_job(
    database, settings, job, process, event: Event
):
    reached = []

    def work_on(work: Work) -> None:
        event(database, job)
        work.progress(0.5, "half done")
        reached.append("the other half")

    process(work_on)
    with pytest.raises(LostJob):
        do_attempt(database, settings, job.id, job.attempt)
    assert reached == []


def test_a_job_has_all_of_its_progress_when_it_has_succeeded_and_not_before(
    database, settings, job, process
):
    seen = []

    def work_on(work: Work) -> None:
        work.progress(1.0, "nearly there")
        seen.append(state_of(database, job.id).progress)

    process(work_on)
    do_attempt(database, settings, job.id, job.attempt)
    assert [*seen, state_of(database, job.id).progress] == [99, 100]


class Watch:
    """A clock that stands still until it is set."""

    now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


def test_progress_is_written_at_once_and_then_no_more_than_twice_a_second(
    database, settings, job, process, monkeypatch: pytest.MonkeyPatch
):
    watch = Watch()
    monkeypatch.setattr("amers.app.usecases.jobs.time", watch)
    shown = []

    def work_on(work: Work) -> None:
        for later_s, percent in ((0.0, 10), (0.4, 20), (0.2, 30), (0.4, 40), (0.2, 50)):
            watch.now_s += later_s
            work.progress(percent / 100.0, f"{percent} %")
            shown.append((state_of(database, job.id).progress, state_of(database, job.id).message))

    process(work_on)
    do_attempt(database, settings, job.id, job.attempt)
    assert shown == [(n, f"{n} %") for n in (10, 10, 30, 30, 50)]


@pytest.mark.parametrize(("done", "percent"), [(-0.5, 0), (0.0, 0), (0.429, 42), (0.999, 99), (7.0, 99)])
def test_progress_is_in_whole_percent_that_are_done(
    database, settings, job, process, done: float, percent: int
):
    seen = []

    def work_on(work: Work) -> None:
        work.progress(done, "on the way")
        seen.append(state_of(database, job.id).progress)

    process(work_on)
    do_attempt(database, settings, job.id, job.attempt)
    assert seen == [percent]


def reserved_bytes(database: Database, job: Job) -> int:
    (row,) = run_in(database.transaction(), "select results_bytes from job where id = %s", [job.id])
    return int(row["results_bytes"])


def test_the_room_of_the_last_attempt_is_given_back_by_itself_alone_and_once_it_is_over(database, job):
    def release(attempt: int) -> None:
        with database.transaction() as connection:
            attempts.release_results(connection, job.id, attempt)

    taken_over(database, job)
    heir = job.attempt + 1
    with database.transaction() as connection:
        attempts.reserve_results(connection, job.id, heir, 1000)
    release(heir)
    assert reserved_bytes(database, job) == 1000
    with database.transaction() as connection:
        attempts.fail(connection, job.id, heir, {"title": "no"})
    release(job.attempt)
    assert reserved_bytes(database, job) == 1000
    release(heir)
    assert reserved_bytes(database, job) == 0


def test_the_room_of_an_attempt_is_not_that_of_the_next_one(database, job):
    with database.transaction() as connection:
        attempts.reserve_results(connection, job.id, job.attempt, 1000)
    taken_over(database, job)
    assert reserved_bytes(database, job) == 0


def test_room_that_an_attempt_has_while_it_runs_or_for_its_results_is_not_lost(database, job):
    def lost() -> dict[UUID, int]:
        with database.transaction() as connection:
            return attempts.lost_reservations(connection)

    with database.transaction() as connection:
        attempts.reserve_results(connection, job.id, job.attempt, 1000)
    assert lost() == {}
    given_back(database, job)
    assert lost() == {job.id: job.attempt}
    claimed(database, job.id)
    with database.transaction() as connection:
        attempts.reserve_results(connection, job.id, 2, 1000)
        attempts.succeed(connection, job.id, 2, {"files": {}})
    assert lost() == {}


@pytest.mark.parametrize(
    ("state", "results", "removed", "counts"),
    [
        ("accepted", "null", "null", False),
        ("running", "null", "null", True),
        ("running", "null", "now()", False),
        ("successful", "null", "null", True),
        ("successful", "'{}'", "null", True),
        ("successful", "'{}'", "now()", False),
        ("failed", "null", "null", False),
        ("failed", "'{}'", "null", True),
        ("failed", "'{}'", "now()", False),
        ("dismissed", "null", "null", False),
    ],
)
def test_files_of_an_attempt_are_those_of_one_that_runs_or_has_results_that_are_kept(
    database, state: str, results: str, removed: str, counts: bool
):
    other, job, missing = new_job(database), new_job(database), uuid4()
    with database.transaction() as connection:
        run_sql(connection, "update job set attempt = 7 where id = %s", [other.id])
        run_sql(
            connection,
            f"update job set attempt = 3, state = '{state}', results = {results}, "
            f"results_removed_at = {removed} where id = %s",
            [job.id],
        )
        found = attempts.counting_attempts(connection, [job.id, missing])
    assert found == {job.id: 3 if counts else None}


LEASE_S = 0.6


class Endless:
    """Processes of attempts of which none ends by itself before many leases have passed.

    Attributes:
        killed_after: number of times that a worker waited before it ended the process; None: it did not.
    """

    def __init__(self, begin: Callable[[], None]) -> None:
        self.killed_after: int | None = None
        self._begin, self._waits, self._most = begin, 0, 60

    def start(
        self, function: str, arguments: Sequence[str], environment: Mapping[str, str]
    ) -> "Endless":
        self._begin()
        return self

    cpu_s = 0.0

    def wait(self, timeout_s: float) -> int | None:
        self._waits += 1
        time.sleep(timeout_s)
        return 0 if self._waits >= self._most else None

    def close(self) -> None:
        self.killed_after = self._waits if self._waits < self._most else None


def test_a_worker_that_cannot_renew_its_lease_ends_the_process_of_its_attempt(
    cluster: Cluster, database: Database, settings: Settings, dsn: str
):
    """By then another worker may have begun; the one that is cut off cannot ask."""
    name = conninfo_to_dict(dsn)["dbname"]

    def cut_off() -> None:
        with psycopg.connect(cluster.dsn("postgres", SUPERUSER), autocommit=True) as connection:
            refuse = sql.SQL("alter database {} allow_connections false").format(sql.Identifier(name))
            connection.execute(refuse)
            connection.execute(
                "select pg_terminate_backend(pid) from pg_stat_activity where datname = %s", [name]
            )

    new_job(database)
    endless = Endless(cut_off)
    short = settings.model_copy(update={"lease_seconds": LEASE_S})
    Attempts(database, endless, short, "w", lambda: False).do_next_job()
    assert endless.killed_after is not None


@pytest.mark.thorough
def test_a_worker_that_renews_its_lease_keeps_its_job_for_many_leases(
    database: Database, settings: Settings
):
    job = new_job(database)
    endless = Endless(lambda: None)
    short = settings.model_copy(update={"lease_seconds": LEASE_S})
    Attempts(database, endless, short, "w", lambda: False).do_next_job()
    with database.transaction() as connection:
        assert attempts.take_back(connection, attempts_allowed=10) == []
    assert (endless.killed_after, state_of(database, job.id).state) == (None, "running")


@pytest.mark.parametrize("event", [dismissed, taken_over, removed])
def test_a_worker_whose_job_went_on_without_it_ends_the_process_of_its_attempt(
    database: Database, settings: Settings, event: Event
):
    job = new_job(database)
    endless = Endless(lambda: event(database, state_of(database, job.id)))
    short = settings.model_copy(update={"lease_seconds": LEASE_S})
    Attempts(database, endless, short, "w", lambda: False).do_next_job()
    assert endless.killed_after is not None
