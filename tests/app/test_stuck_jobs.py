"""Readiness reports a job whose process is silent, and a queue that does not move."""

from collections.abc import Callable
from uuid import UUID

import pytest

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Database
from amers.app.db.jobs import attempts
from amers.app.storage import Storage
from amers.app.usecases import readiness
from amers.app.usecases.installation import Installation
from amers.app.usecases.readiness import Part, Readiness
from tests.app.job_queue import LEASE_S, claimed, new_job, state_of
from tests.statements import run_sql

SILENT_S, STILL_S = 360.0, 90.0
"""After so long, by the default settings, a job counts as silent and a queue as still."""
A_MOMENT_S = 5.0
OK = Part("ok")


@pytest.fixture(autouse=True)
def checked_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """No result is repeated."""
    monkeypatch.setattr(readiness, "VALID_S", 0.0)


@pytest.fixture
def worker(settings: Settings, database: Database, storage: Storage):
    """Gets the state of the workers; with settings other than the default."""
    checkers = []

    def check(**changed: object) -> Part:
        here = Installation(database, storage, settings.model_copy(update=changed))
        checkers.append(Readiness(here))
        return checkers[-1].check()["worker"]

    yield check
    for checker in checkers:
        checker.close()


@pytest.fixture
def alive(dsn: str) -> Callable[[int], None]:
    """Lets workers give a sign of life."""

    def beat(count: int) -> None:
        with engine.connect(dsn) as connection:
            for _ in range(count):
                run_sql(connection, "insert into procrastinate_workers default values")

    return beat


def pass_time(database: Database, seconds: float) -> None:
    """Let all that happened to jobs have happened earlier; workers beat on."""
    with database.transaction() as connection:
        for statement in (
            "update job set created_at = created_at - make_interval(secs => %(s)s),"
            " updated_at = updated_at - make_interval(secs => %(s)s),"
            " not_before = not_before - make_interval(secs => %(s)s),"
            " claimed_at = claimed_at - make_interval(secs => %(s)s)",
            "update job_turn set claimed_at = claimed_at - make_interval(secs => %(s)s)",
            "update job_message set written_at = written_at - make_interval(secs => %(s)s)",
        ):
            run_sql(connection, statement, {"s": seconds})


def renew(database: Database, job_id: UUID) -> None:
    """Do what the supervisor of an attempt does every two seconds."""
    with database.transaction() as connection:
        attempts.renew(connection, job_id, 1, LEASE_S)


def test_a_running_job_that_reports_nothing_is_named_though_its_lease_is_renewed(
    database: Database, worker, alive
):
    alive(1)
    job = claimed(database, new_job(database).id)
    pass_time(database, SILENT_S - A_MOMENT_S)
    renew(database, job.id)
    assert worker() == OK
    pass_time(database, 2 * A_MOMENT_S)
    renew(database, job.id)
    state = worker()
    assert state.status == "degraded"
    assert f"job {job.id} runs and has reported no progress for 36" in state.reason
    assert f"DELETE /jobs/{job.id}" in state.reason
    with database.transaction() as connection:
        attempts.report(connection, job.id, 1, 0, "started")
    assert worker() == OK, "the same message again is a sign of life"


def test_a_job_may_be_silent_for_a_tenth_of_its_time_limit(database: Database, worker, alive):
    alive(1)
    claimed(database, new_job(database).id)
    pass_time(database, SILENT_S + A_MOMENT_S)
    assert worker().status == "degraded"
    assert worker(job_seconds=2 * 3600.0) == OK


def test_a_queue_that_does_not_move_names_the_job_that_waits(database: Database, worker, alive):
    alive(2)
    waiting, _ = new_job(database), new_job(database)
    pass_time(database, STILL_S - A_MOMENT_S)
    assert worker() == OK
    pass_time(database, 2 * A_MOMENT_S)
    state = worker()
    assert state.status == "degraded"
    assert "2 jobs wait" in state.reason
    assert f"job {waiting.id} for 9" in state.reason
    assert "2 of 2 workers have nothing to do" in state.reason
    assert worker(lease_seconds=60.0) == OK
    claimed(database, waiting.id)
    assert worker() == OK, "a claim moves the queue"


def test_a_queue_whose_workers_are_all_busy_waits_for_them(database: Database, worker, alive):
    alive(1)
    running = claimed(database, new_job(database).id)
    new_job(database)
    pass_time(database, STILL_S + A_MOMENT_S)
    assert worker() == OK
    with database.transaction() as connection:
        attempts.fail(connection, running.id, 1, {"title": "no points"})
    assert worker() == OK, "the worker has just become free"
    pass_time(database, STILL_S + A_MOMENT_S)
    assert worker().status == "degraded"


def test_a_job_that_may_not_be_claimed_yet_does_not_hold_up_the_queue(database: Database, worker, alive):
    alive(2)
    delayed = claimed(database, new_job(database).id)
    with database.transaction() as connection:
        attempts.try_again(connection, delayed.id, 1, 600.0)
    pass_time(database, STILL_S + A_MOMENT_S)
    assert worker() == OK
    assert state_of(database, delayed.id).state == "accepted"
    claimed(database, new_job(database).id)
    new_job(database)
    pass_time(database, STILL_S + A_MOMENT_S)
    assert worker(jobs_running_per_owner=1) == OK, "their owner has as many running jobs as he may"
    assert worker().status == "degraded"


def test_what_ended_long_ago_holds_up_nothing(database: Database, worker, alive):
    alive(1)
    job = claimed(database, new_job(database).id)
    with database.transaction() as connection:
        attempts.succeed(connection, job.id, 1, {})
    pass_time(database, 10 * SILENT_S)
    assert worker() == OK
