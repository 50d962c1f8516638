"""Jobs: asked for once, seen by their owner, claimed under a lease, fenced against the dead."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient
from psycopg.errors import UniqueViolation

from app.config import Settings
from app.db import attempts, engine, jobs, registrations, scenes
from app.db.attempts import LostJob
from app.db.engine import Connection, Database
from app.db.jobs import Job
from app.main import create_app
from app.storage import Storage
from app.worker.attempt import FAILURES_ALLOWED
from app.worker.sweep import sweep_files, sweep_jobs

LEASE_S = 30.0

Bearer = Callable[[str], dict[str, str]]
EXECUTE = "/processes/register-scene/execution"


@pytest.fixture
def database(settings: Settings) -> Iterator[Database]:
    """The test's database with its pools."""
    assert settings.database_url is not None
    with engine.pooled(settings.database_url.get_secret_value(), settings) as database:
        yield database


@pytest.fixture
def me(bearer: Bearer) -> dict[str, str]:
    """Headers of a caller who may register."""
    return bearer("register")


@pytest.fixture
def scene(client: TestClient, me: dict[str, str]) -> str:
    """The id of an uploaded scene."""
    reply = client.post("/scenes?name=a.tif", content=b"II*\0" + bytes(100), headers=me)
    return str(reply.json()["id"])


def new_job(database: Database) -> Job:
    """An accepted job."""
    with database.transaction() as connection:
        job = jobs.create(connection, "register-scene", {"scene": str(uuid4())})
    assert job is not None
    return job


def claimed(database: Database, job_id: UUID, worker: str = "w", lease_s: float = LEASE_S) -> Job:
    """The job, taken by a worker."""
    with database.transaction() as connection:
        job = attempts.claim(connection, job_id, worker, lease_s)
    assert job is not None
    return job


def state_of(database: Database, job_id: UUID) -> Job:
    """The job as it is now."""
    with database.transaction() as connection:
        job = jobs.find(connection, job_id)
    assert job is not None
    return job


def let_lease_lapse(database: Database, job_id: UUID) -> None:
    """As if the worker had been silent for too long."""
    with database.transaction() as connection:
        connection.execute(
            "update job set lease_until = now() - interval '1 second' where id = %s", [job_id]
        )


def queue_entries(connection: Connection, job_id: UUID) -> int:
    """How many entries of the queue wait to be fetched for a job."""
    row = connection.execute(
        "select count(*) as n from procrastinate_jobs where status = 'todo' and args ->> 'job_id' = %s",
        [str(job_id)],
    ).fetchone()
    assert row is not None
    return int(row["n"])


# What a caller can do


def test_processes_are_described_with_the_schema_of_their_inputs(client: TestClient):
    names = [process["id"] for process in client.get("/processes").json()["processes"]]
    assert "register-scene" in names
    described = client.get("/processes/register-scene").json()
    assert described["inputs"]["scene"]["minOccurs"] == 1
    assert described["inputs"]["scene"]["schema"]["format"] == "uuid"
    options = described["inputs"]["options"]["schema"]["properties"]
    assert options["max_points"]["type"] == "integer"
    assert options["adjustment"]["type"] == "object", "no definition lies elsewhere"
    assert "report.json" in described["outputs"]
    assert "dismiss" in described["jobControlOptions"]
    assert client.get("/processes/no-such").status_code == 404


def test_a_request_for_work_becomes_a_job_in_the_queue(
    client: TestClient, me: dict[str, str], scene: str, dsn: str
):
    inputs = {"scene": scene, "options": {"max_points": 100, "matching": {"max_views": 2}}}
    reply = client.post(EXECUTE, json={"inputs": inputs}, headers=me)
    assert reply.status_code == 201, reply.text
    job = reply.json()
    assert (job["status"], job["progress"], job["processID"]) == ("accepted", 0, "register-scene")
    assert reply.headers["location"] == job["links"][0]["href"]
    told = client.get(reply.headers["location"], headers=me).json()
    assert told == {**job, "amers:queuePosition": 1}
    with engine.connect(dsn) as connection:
        assert queue_entries(connection, UUID(job["jobID"])) == 1
        stored = jobs.find(connection, UUID(job["jobID"]))
    assert stored is not None
    assert stored.inputs["options"]["max_points"] == 100
    assert stored.inputs["options"]["coarse"]["points"] == 60, "defaults are part of the record"


@pytest.mark.parametrize(
    ("inputs", "named"),
    [
        ({}, "scene"),
        ({"scene": str(uuid4()), "options": {"fine_passes": 0}}, "fine_passes"),
        ({"scene": "abc"}, "scene"),
        ({"scene": None}, "scene"),
        ({"options": {"max_points": "many"}}, "options.max_points"),
        ({"options": {"max_pionts": 10}}, "options.max_pionts"),
        ({"options": {"adjustment": {"order": "cubic"}}}, "options.adjustment.order"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_inputs_that_are_not_those_of_the_process_are_refused_by_name(
    client: TestClient, me: dict[str, str], scene: str, inputs: dict[str, Any], named: str
):
    given = inputs if not inputs or "scene" in inputs else {"scene": scene, **inputs}
    reply = client.post(EXECUTE, json={"inputs": given}, headers=me)
    assert reply.status_code == 422
    assert named in reply.json()["detail"]
    assert client.get("/jobs", headers=me).json()["jobs"] == []


def test_work_needs_a_token_that_allows_it(client: TestClient, bearer: Bearer, scene: str):
    body = {"inputs": {"scene": scene}}
    assert client.post(EXECUTE, json=body).status_code == 401
    assert client.post(EXECUTE, json=body, headers={"Authorization": "Bearer no"}).status_code == 401
    assert client.post(EXECUTE, json=body, headers=bearer("read")).status_code == 403


def test_somebody_elses_scene_cannot_be_registered(client: TestClient, bearer: Bearer, scene: str):
    reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=bearer("register"))
    assert reply.status_code == 404
    assert scene in reply.json()["detail"]


def test_a_removed_scene_cannot_be_registered(client: TestClient, me: dict[str, str], scene: str):
    client.delete(f"/scenes/{scene}", headers=me)
    reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me)
    assert reply.status_code == 409
    assert "removed" in reply.json()["detail"]


def test_the_same_request_with_the_same_key_asks_once(
    client: TestClient, me: dict[str, str], bearer: Bearer, scene: str
):
    body = {"inputs": {"scene": scene}}
    keyed = {"Idempotency-Key": "k1"}
    first = client.post(EXECUTE, json=body, headers=me | keyed).json()
    again = client.post(EXECUTE, json=body, headers=me | keyed).json()
    assert again["jobID"] == first["jobID"]
    other = {"inputs": {"scene": scene, "options": {"max_points": 7}}}
    assert client.post(EXECUTE, json=other, headers=me | keyed).status_code == 422
    stranger = client.post(EXECUTE, json=body, headers=bearer("admin") | keyed).json()
    assert stranger["jobID"] != first["jobID"], "keys are each owner's own"


def test_requests_with_one_key_at_the_same_time_ask_once(
    client: TestClient, me: dict[str, str], scene: str
):
    def ask(_: int) -> str:
        keyed = me | {"Idempotency-Key": "k1"}
        reply = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=keyed)
        return str(reply.json()["jobID"])

    with ThreadPoolExecutor(6) as threads:
        assert len(set(threads.map(ask, range(12)))) == 1


def test_an_owner_sees_his_jobs_and_an_administrator_all(
    client: TestClient, me: dict[str, str], bearer: Bearer, scene: str
):
    job = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()
    here, stranger, admin = f"/jobs/{job['jobID']}", bearer("register"), bearer("admin")
    assert [one["jobID"] for one in client.get("/jobs", headers=me).json()["jobs"]] == [job["jobID"]]
    assert client.get("/jobs", headers=stranger).json()["jobs"] == []
    assert len(client.get("/jobs", headers=admin).json()["jobs"]) == 1
    for path in (here, f"{here}/results", f"{here}/results/report.json"):
        assert client.get(path, headers=stranger).status_code == 404
        assert client.get(path).status_code == 401
    assert client.delete(here, headers=stranger).status_code == 404
    assert client.get(here, headers=admin).json()["status"] == "accepted"


def test_a_dismissed_job_stays_dismissed_and_is_never_claimed(
    client: TestClient, me: dict[str, str], scene: str, database: Database
):
    job = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()
    here = f"/jobs/{job['jobID']}"
    assert client.delete(here, headers=me).json()["status"] == "dismissed"
    assert client.delete(here, headers=me).json()["status"] == "dismissed"
    with database.transaction() as connection:
        assert attempts.claim(connection, UUID(job["jobID"]), "w", LEASE_S) is None
    assert client.get(f"{here}/results", headers=me).status_code == 404


def test_a_job_that_has_ended_cannot_be_dismissed(
    client: TestClient, me: dict[str, str], scene: str, database: Database
):
    job = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()
    attempt = claimed(database, UUID(job["jobID"])).attempt
    with database.transaction() as connection:
        attempts.succeed(connection, UUID(job["jobID"]), attempt, {"verdict": "good"})
    assert client.delete(f"/jobs/{job['jobID']}", headers=me).status_code == 409
    assert client.get(f"/jobs/{job['jobID']}", headers=me).json()["status"] == "successful"


def test_a_failed_job_tells_why_with_its_numbers(
    client: TestClient, me: dict[str, str], scene: str, database: Database
):
    job = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()
    attempt = claimed(database, UUID(job["jobID"])).attempt
    error = {
        "type": "about:blank",
        "title": "Not enough points",
        "error": "NotEnoughPoints",
        "detail": "3 found, 6 needed",
        "found": 3,
    }
    with database.transaction() as connection:
        attempts.fail(connection, UUID(job["jobID"]), attempt, error)
    told = client.get(f"/jobs/{job['jobID']}", headers=me).json()
    assert (told["status"], told["message"], told["error"]) == ("failed", error["detail"], error)
    results = client.get(f"/jobs/{job['jobID']}/results", headers=me)
    assert (results.status_code, results.json()["found"]) == (409, 3)
    assert results.headers["content-type"] == "application/problem+json"


# Leases and fences


def test_a_job_is_claimed_by_one_worker_only(database: Database):
    job = new_job(database)
    with ThreadPoolExecutor(6) as threads:

        def try_it(worker: int) -> Job | None:
            with database.transaction() as connection:
                return attempts.claim(connection, job.id, f"w{worker}", LEASE_S)

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
        scene_id = scenes.begin_upload(connection, None, "a", "a.tif", None)
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
        assert registrations.find_by_job(connection, job.id) is None, "the late result was rolled back"
        finish(connection, job.id, heir.attempt, scene_id)
    assert state_of(database, job.id).state == "successful"
    with pytest.raises(UniqueViolation), database.transaction() as connection:
        finish(connection, job.id, heir.attempt, scene_id)


def finish(connection: Connection, job_id: UUID, attempt: int, scene_id: UUID) -> None:
    """Write a result and end the job, as a worker does."""
    registrations.insert_registration(
        connection,
        job_id=job_id,
        scene_id=scene_id,
        block_versions=[],
        options={},
        report={},
        verdict="good",
        files={},
    )
    attempts.succeed(connection, job_id, attempt, {})


def test_a_job_given_back_waits_again_without_counting_a_failure(database: Database):
    job = new_job(database)
    for expected in (1, 2, 3, 4, 5):
        attempt = claimed(database, job.id).attempt
        assert attempt == expected
        with database.transaction() as connection:
            attempts.give_back(connection, job.id, attempt)
    assert (state_of(database, job.id).state, state_of(database, job.id).failures) == ("accepted", 0)


def test_a_job_that_outlives_too_many_workers_fails(database: Database):
    job = new_job(database)
    for _ in range(FAILURES_ALLOWED):
        claimed(database, job.id)
        let_lease_lapse(database, job.id)
        sweep_jobs(database, LEASE_S)
    failed = state_of(database, job.id)
    assert failed.state == "failed"
    assert failed.error is not None
    assert f"died {FAILURES_ALLOWED} times" in failed.error["detail"]


def test_a_lease_that_is_renewed_is_not_taken_back(database: Database):
    job = new_job(database)
    attempt = claimed(database, job.id, lease_s=0.0).attempt
    with database.transaction() as connection:
        attempts.renew(connection, job.id, attempt, LEASE_S)
    sweep_jobs(database, LEASE_S)
    assert state_of(database, job.id).state == "running"


def test_a_job_that_the_queue_has_lost_is_put_back_into_it(database: Database):
    lost, queued = new_job(database), new_job(database)
    with database.transaction() as connection:
        connection.execute("delete from procrastinate_jobs where args ->> 'job_id' = %s", [str(lost.id)])
        connection.execute("update job set updated_at = now() - interval '1 hour'")
    sweep_jobs(database, LEASE_S)
    sweep_jobs(database, LEASE_S)
    with database.transaction() as connection:
        assert queue_entries(connection, lost.id) == 1
        assert queue_entries(connection, queued.id) == 1


def test_entries_of_the_queue_that_died_with_their_worker_are_forgotten(database: Database):
    new_job(database)
    with database.transaction() as connection:
        connection.execute(
            "insert into procrastinate_workers (last_heartbeat) values (now() - interval '1 h')"
        )
        connection.execute(
            "update procrastinate_jobs set status = 'doing',"
            " worker_id = (select id from procrastinate_workers)"
        )
    sweep_jobs(database, LEASE_S)
    with database.transaction() as connection:
        assert connection.execute("select id from procrastinate_jobs").fetchall() == []


def test_the_sweep_removes_the_files_of_attempts_that_do_not_count(database: Database, storage: Storage):
    done, running, dead = new_job(database), new_job(database), new_job(database)
    for job in (done, running, dead):
        claimed(database, job.id)
        let_lease_lapse(database, job.id)
    sweep_jobs(database, LEASE_S)
    for job in (done, running):
        claimed(database, job.id)
    with database.transaction() as connection:
        attempts.succeed(connection, done.id, 2, {})
        jobs.dismiss(connection, dead.id)
    for job in (done, running, dead):
        for attempt in (1, 2):
            storage.put(f"results/{job.id}/{attempt}/report.json", [b"{}"])
    sweep_files(database, storage, LEASE_S)
    assert storage.keys("results") == sorted(
        f"results/{job.id}/2/report.json" for job in (done, running)
    )


# Many jobs


def test_jobs_are_listed_page_by_page_and_by_kind_and_state(
    client: TestClient, me: dict[str, str], scene: str
):
    def asked() -> str:
        return str(client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()["jobID"])

    made = [asked() for _ in range(5)]
    client.delete(f"/jobs/{made[0]}", headers=me)
    seen, url = [], "/jobs?limit=2"
    while url:
        page = client.get(url, headers=me).json()
        seen += [job["jobID"] for job in page["jobs"]]
        url = next((link["href"] for link in page["links"] if link["rel"] == "next"), "")
    assert seen == made[::-1]

    def listed(query: str) -> list[str]:
        return [job["jobID"] for job in client.get(f"/jobs?{query}", headers=me).json()["jobs"]]

    assert listed("status=dismissed") == [made[0]]
    assert listed("status=dismissed&status=accepted") == made[::-1]
    assert listed("processID=ingest-block") == []
    assert client.get("/jobs?status=lost", headers=me).status_code == 400


def test_a_waiting_job_says_its_place_in_the_queue_and_its_scene(
    client: TestClient, me: dict[str, str], scene: str, database: Database
):
    first, second = (
        client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).json()["jobID"]
        for _ in range(2)
    )
    told = client.get(f"/jobs/{second}", headers=me).json()
    assert told["amers:queuePosition"] == 2
    assert told["inputs"]["scene"] == scene
    assert any(
        link["rel"] == "related" and link["href"].endswith(f"/scenes/{scene}") for link in told["links"]
    )
    claimed(database, UUID(first))
    assert client.get(f"/jobs/{second}", headers=me).json()["amers:queuePosition"] == 1
    assert "amers:queuePosition" not in client.get(f"/jobs/{first}", headers=me).json()


def test_a_token_has_no_more_jobs_at_once_than_its_quota(
    settings: Settings, me: dict[str, str], scene: str
):
    few = settings.model_copy(update={"quota_jobs": 1})
    with TestClient(create_app(few)) as client:
        first = client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me)
        assert first.status_code == 201
        assert client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).status_code == 429
        client.delete(first.headers["location"], headers=me)
        assert client.post(EXECUTE, json={"inputs": {"scene": scene}}, headers=me).status_code == 201
