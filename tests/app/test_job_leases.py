"""Jobs and workers: claims under a lease, fencing of dead workers, and the sweep after them."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from uuid import UUID

import pytest
from psycopg.errors import LockNotAvailable, UniqueViolation

from amers.app.db import registrations, scenes
from amers.app.db.engine import Connection, Database, limit_lock_wait
from amers.app.db.jobs import attempts, jobs, queue
from amers.app.db.jobs.attempts import LostJob
from amers.app.db.jobs.jobs import Job
from amers.app.storage import Storage
from amers.app.worker.attempt import ATTEMPTS_ALLOWED
from amers.app.worker.sweep import sweep_files, sweep_jobs
from tests.app.job_queue import (
    LEASE_S,
    claimed,
    let_lease_lapse,
    new_job,
    state_of,
    store_registration,
    tickets,
)
from tests.statements import run_in, run_sql


def in_transaction(
    change: Callable[[Connection, Job], object],
) -> Callable[[Database, Job], None]:
    """A change of a job, in a transaction of its own."""

    def changed(database: Database, job: Job) -> None:
        with database.transaction() as connection:
            change(connection, job)

    return changed


def test_a_job_is_claimed_by_one_worker_only(database: Database):
    new_job(database)
    with ThreadPoolExecutor(6) as threads:

        def try_it(worker: int) -> Job | None:
            with database.transaction() as connection:
                return attempts.claim_next(connection, f"w{worker}", LEASE_S)

        got = [one for one in threads.map(try_it, range(6)) if one is not None]
    assert [one.attempt for one in got] == [1]


def test_a_worker_back_from_the_dead_writes_nothing(database: Database):
    job = new_job(database)
    zombie = claimed(database, job.id, "zombie")
    let_lease_lapse(database, job.id)
    sweep_jobs(database, LEASE_S)
    heir = claimed(database, job.id, "heir")
    assert (zombie.attempt, heir.attempt) == (1, 2)
    with database.transaction() as connection:
        scene_id = scenes.begin_upload(connection, None, "a", "a.tif", sigma_m=None)
    writes: list[Callable[[Connection], None]] = [
        lambda c: attempts.renew(c, job.id, zombie.attempt, LEASE_S),
        lambda c: attempts.report(c, job.id, zombie.attempt, 50, "late"),
        lambda c: attempts.fail(c, job.id, zombie.attempt, {"title": "late"}),
        lambda c: attempts.give_back(c, job.id, zombie.attempt),
        lambda c: attempts.try_again(c, job.id, zombie.attempt, 0.0),
        lambda c: finish(c, job.id, zombie.attempt, scene_id),
    ]
    for write in writes:
        with pytest.raises(LostJob), database.transaction() as connection:
            write(connection)
    assert state_of(database, job.id).state == "running"
    with database.transaction() as connection:
        assert registrations.find_of_job(connection, job.id) == [], "the late result was rolled back"
        finish(connection, job.id, heir.attempt, scene_id)
    assert state_of(database, job.id).state == "successful"
    with pytest.raises(UniqueViolation), database.transaction() as connection:
        finish(connection, job.id, heir.attempt, scene_id)


def finish(connection: Connection, job_id: UUID, attempt: int, scene_id: UUID) -> None:
    """Write a result and end the job, as a worker does."""
    store_registration(connection, job_id=job_id, scene_id=scene_id)
    attempts.succeed(connection, job_id, attempt, {})


def test_a_job_given_back_waits_again_without_counting_a_failure(database: Database):
    job = new_job(database)
    for expected in (1, 2, 3, 4, 5):
        attempt = claimed(database, job.id).attempt
        assert attempt == expected
        with database.transaction() as connection:
            attempts.give_back(connection, job.id, attempt)
    assert (state_of(database, job.id).state, state_of(database, job.id).failures) == ("accepted", 0)


def test_a_job_given_back_calls_another_worker(database: Database):
    """The ticket of the worker that stops ends with it."""
    job = new_job(database)
    run_in(database.transaction(), "update procrastinate_jobs set status = 'doing'")
    attempt = claimed(database, job.id).attempt
    with database.transaction() as connection:
        assert tickets(connection) == 0
        attempts.give_back(connection, job.id, attempt)
        assert tickets(connection) == 1


def test_each_attempt_that_breaks_off_counts_as_a_failure(database: Database):
    job = new_job(database)
    for failures in (1, 2, 3):
        attempt = claimed(database, job.id).attempt
        with database.transaction() as connection:
            attempts.try_again(connection, job.id, attempt, 0.0)
        assert state_of(database, job.id).failures == failures


def test_a_job_that_is_not_due_yet_needs_no_lost_ticket(database: Database):
    job = new_job(database)
    attempt = claimed(database, job.id).attempt
    with database.transaction() as connection:
        attempts.try_again(connection, job.id, attempt, 3600.0)
        run_sql(connection, "delete from procrastinate_jobs")
        run_sql(connection, "update job set updated_at = now() - interval '1 hour'")
        assert queue.replace_lost_tickets(connection, LEASE_S, None) == 0
        run_sql(connection, "update job set not_before = now() - interval '1 second'")
        assert queue.replace_lost_tickets(connection, LEASE_S, None) == 1


def test_a_claim_waits_for_another_so_that_it_counts_what_that_one_runs(database: Database):
    for _ in range(2):
        new_job(database)
    with database.transaction() as connection:
        assert attempts.claim_next(connection, "a", LEASE_S) is not None
        with database.transaction() as other:
            limit_lock_wait(other, 0.1)
            with pytest.raises(LockNotAvailable):
                attempts.claim_next(other, "b", LEASE_S)
            other.rollback()


def test_a_job_that_has_ended_is_not_dismissed(database: Database):
    for ending, state in ((attempts.succeed, "successful"), (attempts.fail, "failed")):
        job = new_job(database)
        attempt = claimed(database, job.id).attempt
        with database.transaction() as connection:
            ending(connection, job.id, attempt, {"title": "x"})
            assert not jobs.dismiss(connection, job.id)
        assert state_of(database, job.id).state == state
    waiting = new_job(database)
    with database.transaction() as connection:
        assert jobs.dismiss(connection, waiting.id)


def test_one_worker_at_a_time_takes_the_jobs_of_dead_ones_back(database: Database):
    job = claimed(database, new_job(database).id)
    let_lease_lapse(database, job.id)
    with database.transaction() as connection:
        assert queue.may_sweep(connection)
        sweep_jobs(database, LEASE_S)
        assert state_of(database, job.id).state == "running", "another worker does it"
    sweep_jobs(database, LEASE_S)
    assert state_of(database, job.id).state == "accepted"


def test_a_job_that_fails_keeps_what_it_made_all_the_same(database: Database):
    job = claimed(database, new_job(database).id)
    made = {"verdict": "failed", "files": {"report.json": f"results/{job.id}/1/report.json"}}
    with database.transaction() as connection:
        attempts.fail(connection, job.id, 1, {"title": "Not enough points"}, made)
    ended = state_of(database, job.id)
    assert (ended.state, ended.results, ended.error) == ("failed", made, {"title": "Not enough points"})


def test_a_job_that_outlives_too_many_workers_fails(database: Database):
    job = new_job(database)
    for _ in range(ATTEMPTS_ALLOWED):
        claimed(database, job.id)
        let_lease_lapse(database, job.id)
        sweep_jobs(database, LEASE_S)
    failed = state_of(database, job.id)
    assert failed.state == "failed"
    assert failed.error is not None
    assert f"the last of {ATTEMPTS_ALLOWED} attempts" in failed.error["detail"]


def lost_once(database: Database, job: Job) -> None:
    """The job loses its worker."""
    let_lease_lapse(database, job.id)
    sweep_jobs(database, LEASE_S)


def lost_for_good(database: Database, job: Job) -> None:
    """The job loses as many workers as it may."""
    for attempt in range(1, ATTEMPTS_ALLOWED + 1):
        if attempt > 1:
            claimed(database, job.id)
        lost_once(database, job)


ENDS: dict[str, Callable[[Database, Job], object]] = {
    "succeeds": in_transaction(lambda c, job: attempts.succeed(c, job.id, job.attempt, {})),
    "fails": in_transaction(lambda c, job: attempts.fail(c, job.id, job.attempt, {"title": "no"})),
    "is dismissed": in_transaction(lambda c, job: jobs.dismiss(c, job.id)),
    "loses its workers": lost_for_good,
}
RETURNS: dict[str, Callable[[Database, Job], object]] = {
    "given back": in_transaction(lambda c, job: attempts.give_back(c, job.id, job.attempt)),
    "tried again": in_transaction(lambda c, job: attempts.try_again(c, job.id, job.attempt, 0.0)),
    "loses a worker": lost_once,
}


def lease_and_worker(database: Database, job: Job) -> tuple[object, object]:
    (row,) = run_in(
        database.transaction(), "select lease_until, worker from job where id = %s", [job.id]
    )
    return row["lease_until"], row["worker"]


@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS)
def test_a_job_that_has_ended_has_its_end_and_no_lease(
    database: Database, end: Callable[[Database, Job], object]
):
    job, other = (claimed(database, new_job(database).id) for _ in range(2))
    end(database, job)
    ended = state_of(database, job.id)
    assert ended.finished_at is not None
    assert ended.started_at is not None
    assert ended.started_at <= ended.finished_at <= ended.updated_at
    assert lease_and_worker(database, job)[0] is None
    untouched = state_of(database, other.id)
    assert (untouched.state, untouched.finished_at, untouched.error) == ("running", None, None)


@pytest.mark.parametrize("back", RETURNS.values(), ids=RETURNS)
def test_a_job_that_waits_again_has_neither_end_nor_lease_nor_worker(
    database: Database, back: Callable[[Database, Job], object]
):
    job = claimed(database, new_job(database).id)
    back(database, job)
    waiting = state_of(database, job.id)
    assert (waiting.state, waiting.finished_at) == ("accepted", None)
    assert "waiting" in waiting.message
    assert lease_and_worker(database, job) == (None, None)
    assert claimed(database, job.id).attempt == job.attempt + 1


def test_a_job_that_has_lost_too_many_workers_says_so_in_problem_details(database: Database):
    job = claimed(database, new_job(database).id)
    lost_for_good(database, job)
    failed = state_of(database, job.id)
    assert failed.error is not None
    assert {"type", "title", "detail"} <= failed.error.keys()
    assert (failed.error["attempts"], failed.failures) == (ATTEMPTS_ALLOWED, 0)
    assert failed.message == failed.error["detail"]


def test_a_lease_that_is_renewed_is_not_taken_back(database: Database):
    job = new_job(database)
    attempt = claimed(database, job.id, lease_s=0.0).attempt
    with database.transaction() as connection:
        attempts.renew(connection, job.id, attempt, LEASE_S)
    sweep_jobs(database, LEASE_S)
    assert state_of(database, job.id).state == "running"


def test_a_ticket_that_the_queue_has_lost_is_issued_again_once(database: Database):
    for _ in range(2):
        new_job(database)
    run_in(
        database.transaction(),
        "delete from procrastinate_jobs where id in (select min(id) from procrastinate_jobs)",
    )
    sweep_jobs(database, LEASE_S)
    with database.transaction() as connection:
        assert tickets(connection) == 1, "the worker that has just taken it may be about to claim"
        run_sql(connection, "update job set updated_at = now() - interval '1 hour'")
    for _ in range(2):
        sweep_jobs(database, LEASE_S)
    with database.transaction() as connection:
        assert tickets(connection) == 2


def test_entries_of_the_queue_that_died_with_their_worker_are_forgotten(database: Database):
    new_job(database)
    with database.transaction() as connection:
        run_sql(
            connection,
            "insert into procrastinate_workers (last_heartbeat) values (now() - interval '1 h')",
        )
        run_sql(
            connection,
            "update procrastinate_jobs set status = 'doing',"
            " worker_id = (select id from procrastinate_workers)",
        )
    sweep_jobs(database, LEASE_S)
    with database.transaction() as connection:
        assert run_sql(connection, "select id from procrastinate_jobs").fetchall() == []


def test_the_sweep_removes_the_files_of_attempts_that_do_not_count(database: Database, storage: Storage):
    finished, running, dead = new_job(database), new_job(database), new_job(database)
    for job in (finished, running, dead):
        claimed(database, job.id)
        let_lease_lapse(database, job.id)
    sweep_jobs(database, LEASE_S)
    for job in (finished, running):
        claimed(database, job.id)
    with database.transaction() as connection:
        attempts.succeed(connection, finished.id, 2, {})
        jobs.dismiss(connection, dead.id)
    for job in (finished, running, dead):
        for attempt in (1, 2):
            storage.put(f"results/{job.id}/{attempt}/report.json", [b"{}"])
    sweep_files(database, storage, LEASE_S)
    assert storage.keys("results") == sorted(
        f"results/{job.id}/2/report.json" for job in (finished, running)
    )
