"""Progress of jobs: messages, the expected end, and the removal of old results."""

from datetime import datetime, timedelta
from uuid import UUID, uuid4

from fastapi.testclient import TestClient

from app.config import Settings
from app.db.audit import list_changes
from app.db.engine import Connection, Database
from app.db.jobs import attempts, jobs, progress
from app.db.jobs.jobs import Job, JobFilter
from app.db.jobs.progress import Outlook
from app.storage import Storage
from app.worker.sweep import sweep_records
from tests.app.job_queue import claim
from tests.statements import run_sql

LEASE_S = 30.0
a_slow_machine = timedelta(seconds=15)
"""Time that a test may take between its steps, during which running jobs grow older."""


def asked(connection: Connection, kind: str = "register-scene") -> Job:
    """A new job."""
    job = jobs.create(connection, kind, {"scene": str(uuid4())})
    assert job is not None
    return job


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
        "insert into procrastinate_workers (last_heartbeat) values (now()), (now()),"
        " (now() - interval '1 hour')",
    )
    assert abs(wait_of(connection, waiting) - timedelta(seconds=(100 + 20) / 2 + 100)) < a_slow_machine
    ended = jobs.find(connection, done_in(connection, 1))
    assert ended is not None
    assert progress.outlook(connection, ended.id) == Outlook(None, None)


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
    client: TestClient, bearer, database: Database, storage: Storage, settings: Settings
):
    me, admin = bearer("register"), bearer("admin")
    scene = client.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100), headers=me).json()["id"]
    body = {"inputs": {"scene": scene}}
    urls = []
    with database.transaction() as connection:
        for age_days in (3.0, 1.0):
            reply = client.post("/processes/register-scene/execution", json=body, headers=me)
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
    with database.transaction() as connection:
        run_sql(connection, "update uptime set elapsed_s = elapsed_s + 2.5 * 86400")
    sweep_records(database, storage, settings.model_copy(update={"result_days": None}))
    assert len(storage.keys("results")) == 2, "all are kept for ever"
    for _ in range(2):
        sweep_records(database, storage, kept_for_two_days)
    old, young = urls
    assert storage.keys("results") == [f"results/{young.rsplit('/', 1)[1]}/1/report.json"]
    document = client.get(old, headers=me).json()
    assert document["status"] == "successful"
    assert not any(link["rel"].endswith("/results") for link in document["links"])
    gone = client.get(f"{old}/results", headers=me)
    assert gone.status_code == 410
    assert "removed on" in gone.json()["detail"]
    assert client.get(f"{old}/results/report.json", headers=me).status_code == 404
    assert client.get(f"{young}/results/report.json", headers=me).content == b"{}"
    with database.transaction() as connection:
        changes = list_changes(connection, 1000, None, "job", old.rsplit("/", 1)[1])
    assert (changes[0].actor_name, changes[0].action) == ("retention", "changed")
    assert client.get("/audit?kind=job", headers=admin).json()["changes"][0]["after"][
        "results_removed_at"
    ]
