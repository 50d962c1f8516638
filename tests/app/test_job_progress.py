"""Progress of jobs: messages, the expected end, and the removal of old results."""

from datetime import UTC, datetime, timedelta
from typing import Any
from uuid import UUID, uuid4

from amers.app.config import Settings
from amers.app.db.audit import list_changes
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts, jobs, progress
from amers.app.db.jobs.jobs import Job, JobFilter
from amers.app.db.jobs.progress import Outlook
from amers.app.storage import Storage
from amers.app.worker.sweep import sweep_records
from tests.app.job_queue import claim, requested
from tests.statements import run_in, run_sql

LEASE_S = 30.0
a_slow_machine = timedelta(seconds=15)
"""Time that a test may take between its steps, during which running jobs grow older."""


def asked(connection: Connection, kind: str = "register-scene") -> Job:
    """A new job."""
    return requested(connection, kind, {"scene": str(uuid4())})


def begun(connection: Connection, kind: str = "register-scene") -> Job:
    job = claim(connection, asked(connection, kind).id, "w", LEASE_S)
    assert job is not None
    return job


def done_in(connection: Connection, seconds: float, kind: str = "register-scene") -> UUID:
    """A job that succeeded this long after its claim."""
    job = begun(connection, kind)
    attempts.succeed(connection, job.id, job.attempt, {})
    run_sql(
        connection,
        "update job set claimed_at = finished_at - make_interval(secs => %s) where id = %s",
        [seconds, job.id],
    )
    return job.id


def wait_of(connection: Connection, job: Job) -> timedelta:
    """Time from now to the expected end of a job."""
    end = progress.outlook(connection, job.id).expected_end
    now = run_sql(connection, "select clock_timestamp() as now").fetchone()
    assert end is not None
    assert now is not None
    moment: datetime = now["now"]
    return end - moment


def test_a_job_keeps_its_messages(connection: Connection):
    job = asked(connection)
    first = claim(connection, job.id, "w", LEASE_S)
    assert first is not None
    attempts.report(connection, job.id, 1, 10, "looking for points")
    attempts.report(connection, job.id, 1, 20, "looking for points")
    attempts.try_again(connection, job.id, 1, 0.0)
    claim(connection, job.id, "w", LEASE_S)
    attempts.fail(connection, job.id, 2, {"title": "Not enough points", "detail": "3 found"})
    messages = progress.read_messages(connection, job.id, 100)
    assert [(entry.attempt, entry.progress, entry.message) for entry in messages] == [
        (0, 0, "waiting for a worker"),
        (1, 0, "started"),
        (1, 10, "looking for points"),
        (1, 20, "broke off, waiting for the next attempt"),
        (2, 0, "started"),
        (2, 0, "3 found"),
    ]
    assert [entry.at for entry in messages] == sorted(entry.at for entry in messages)
    assert progress.read_messages(connection, job.id, 2) == messages[-2:]


def test_the_expected_end_is_the_median_of_past_jobs_of_its_process(connection: Connection):
    running = begun(connection)
    assert progress.outlook(connection, running.id).expected_end is None, "nothing like it was ever done"
    for seconds in (10, 100, 1000):
        done_in(connection, seconds)
    done_in(connection, 5, kind="ingest-block")
    assert abs(wait_of(connection, running) - timedelta(seconds=100)) < a_slow_machine
    run_sql(
        connection,
        "update job set claimed_at = claimed_at - interval '70 s' where id = %s",
        [running.id],
    )
    later = jobs.find(connection, running.id)
    assert later is not None
    assert abs(wait_of(connection, later) - timedelta(seconds=30)) < a_slow_machine


def test_a_waiting_job_is_expected_after_those_before_it_shared_by_the_workers(connection: Connection):
    done_in(connection, 100)
    done_in(connection, 20, kind="ingest-block")
    begun(connection)
    asked(connection, kind="ingest-block")
    waiting = asked(connection)
    asked(connection)
    assert abs(wait_of(connection, waiting) - timedelta(seconds=100 + 20 + 100)) < a_slow_machine
    run_sql(
        connection,
        "insert into procrastinate_workers (last_heartbeat) values (now()), (now() - interval '20 s'),"
        " (now() - interval '1 minute')",
    )
    assert abs(wait_of(connection, waiting) - timedelta(seconds=(100 + 20) / 2 + 100)) < a_slow_machine
    ended = jobs.find(connection, done_in(connection, 1))
    assert ended is not None
    assert progress.outlook(connection, ended.id) == Outlook(None, None)


def test_neither_failures_nor_jobs_long_past_tell_how_long_a_job_takes(connection, monkeypatch):
    monkeypatch.setattr(progress, "PAST_JOBS", 3)
    for seconds in (1000, 1000, 1000, 100, 100, 100):
        done_in(connection, seconds)
    for _ in range(4):
        failed = begun(connection)
        attempts.fail(connection, failed.id, failed.attempt, {"title": "Not enough points"})
    assert abs(wait_of(connection, begun(connection)) - timedelta(seconds=100)) < a_slow_machine


def test_a_job_that_takes_longer_than_usual_brings_no_other_one_forward(connection: Connection):
    done_in(connection, 100)
    late, waiting = begun(connection), asked(connection)
    run_sql(
        connection,
        "update job set claimed_at = claimed_at - interval '1000 s' where id = %s",
        [late.id],
    )
    assert abs(wait_of(connection, late)) < a_slow_machine
    assert abs(wait_of(connection, waiting) - timedelta(seconds=100)) < a_slow_machine


def test_another_attempt_begins_later_and_the_job_when_the_first_one_did(connection: Connection):
    first = begun(connection)
    attempts.report(connection, first.id, 1, 40, "looking for points")
    attempts.try_again(connection, first.id, 1, 0.0)
    second = claim(connection, first.id, "w", LEASE_S)
    assert second is not None
    assert (second.attempt, second.progress, second.started_at) == (2, 0, first.started_at)
    assert first.claimed_at is not None
    assert second.claimed_at is not None
    assert second.claimed_at > first.claimed_at


def test_jobs_are_listed_by_how_long_they_took_and_when_they_were_asked_for(connection: Connection):
    day = datetime(2026, 3, 1, tzinfo=UTC)
    for number, seconds in enumerate((10, 100, 1000)):
        job = done_in(connection, seconds)
        run_sql(
            connection,
            "update job set started_at = claimed_at, created_at = %s where id = %s",
            [day + timedelta(days=number), job],
        )
    made = jobs.newest(connection, None, JobFilter(), 10)
    long, middle, short = made
    still_running = begun(connection)
    run_sql(
        connection,
        "update job set started_at = now() - interval '400 s', created_at = %s where id = %s",
        [day + timedelta(days=9), still_running.id],
    )

    def listed(**wanted: Any) -> list[UUID]:
        return [job.id for job in jobs.newest(connection, None, JobFilter(**wanted), 10)]

    assert listed(min_duration_s=100) == [still_running.id, long.id, middle.id]
    assert listed(max_duration_s=100) == [middle.id, short.id]
    assert listed(min_duration_s=390, max_duration_s=900) == [still_running.id]
    assert listed(since=middle.created_at) == [still_running.id, long.id, middle.id]
    assert listed(until=middle.created_at) == [middle.id, short.id]
    assert listed(since=middle.created_at, until=middle.created_at) == [middle.id]


def test_jobs_of_one_transaction_wait_in_the_order_of_the_queue(connection: Connection):
    made = [asked(connection) for _ in range(6)]
    positions = [progress.outlook(connection, job.id).position for job in made]
    assert positions == [1, 2, 3, 4, 5, 6]
    run_sql(connection, "update job set created_at = %s", [made[0].created_at])
    alike = [progress.outlook(connection, job.id).position for job in made]
    assert sorted(alike) == [1, 2, 3, 4, 5, 6]
    pages = [jobs.newest(connection, None, JobFilter(), 2)]
    while len(pages[-1]) == 2:
        pages.append(jobs.newest(connection, None, JobFilter(), 2, after=pages[-1][-1].id))
    assert sorted(job.id for page in pages for job in page) == sorted(job.id for job in made)


def test_old_results_are_removed_and_the_job_reports_it(
    bearer, database: Database, storage: Storage, settings: Settings
):
    me, admin = bearer("register"), bearer("admin")
    scene = me.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100)).json()["id"]
    body = {"inputs": {"scene": scene}}
    urls = []
    with database.transaction() as connection:
        for age_days in (3.0, 1.0):
            reply = me.post("/processes/register-scene/execution", json=body)
            url = reply.headers["location"]
            job = claim(connection, UUID(url.rsplit("/", 1)[1]), "w", LEASE_S)
            assert job is not None
            key = storage.put(f"results/{job.id}/1/report.json", [b"{}"]).key
            attempts.succeed(connection, job.id, 1, {"verdict": "good", "files": {"report.json": key}})
            run_sql(
                connection,
                "update job set finished_at = finished_at - make_interval(secs => %s) where id = %s",
                [86_400.0 * age_days, job.id],
            )
            urls.append(url)
    kept_for_two_days = settings.model_copy(update={"result_days": 2.0})
    sweep_records(database, storage, settings.model_copy(update={"result_days": None}))
    sweep_records(database, storage, kept_for_two_days)
    assert len(storage.keys("results")) == 2, "the service has not run for two days: the clock jumped"
    run_in(database.transaction(), "update uptime set elapsed_s = elapsed_s + 2.5 * 86400")
    sweep_records(database, storage, settings.model_copy(update={"result_days": None}))
    assert len(storage.keys("results")) == 2, "all are kept for ever"
    for _ in range(2):
        sweep_records(database, storage, kept_for_two_days)
    old, young = urls
    assert storage.keys("results") == [f"results/{young.rsplit('/', 1)[1]}/1/report.json"]
    document = me.get(old).json()
    assert document["status"] == "successful"
    assert not any(link["rel"].endswith("/results") for link in document["links"])
    gone = me.get(f"{old}/results")
    assert gone.status_code == 410
    assert "removed on" in gone.json()["detail"]
    assert me.get(f"{old}/results/report.json").status_code == 404
    assert me.get(f"{young}/results/report.json").content == b"{}"
    with database.transaction() as connection:
        changes = list_changes(connection, 1000, None, "job", old.rsplit("/", 1)[1])
    assert (changes[0].actor_name, changes[0].action) == ("retention", "changed")
    assert admin.get("/audit?kind=job").json()["changes"][0]["after"]["results_removed_at"]
