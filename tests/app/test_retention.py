"""What ended long ago is removed, by the clock and by the time that the service has run."""

from uuid import UUID

import psycopg
import pytest

from amers.app.config import Settings
from amers.app.db.audit import list_changes
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts, jobs
from amers.app.errors import NotFound
from amers.app.request_context import Origin, working_for
from amers.app.storage import Storage
from amers.app.usecases.results import result_key
from amers.app.usecases.tokens import create_token
from amers.app.worker.sweep import sweep_files, sweep_records
from tests.app.job_queue import claim, requested, state_of, store_registration
from tests.statements import run_in, run_sql

OLDER = (
    "update job set finished_at = finished_at - make_interval(days => %s)",
    "alter table audit disable trigger audit_only_grows",
    "update audit set at = at - make_interval(days => %s)",
    "alter table audit enable trigger audit_only_grows",
)


def clock_jumps(database: Database, days: int) -> None:
    """Make everything recorded this many days older."""
    with database.transaction() as connection:
        for statement in OLDER:
            run_sql(connection, statement, [days] if "%s" in statement else [])


def service_runs(database: Database, days: int) -> None:
    """Let the service run for days."""
    clock_jumps(database, days)
    run_in(database.transaction(), "update uptime set elapsed_s = elapsed_s + 86400 * %s", [days])


def running_job(connection: Connection, storage: Storage) -> tuple[UUID, str]:
    """A registration job that has written a file of 100 bytes, and the key of the file."""
    job = requested(connection, "register-scene", {})
    assert claim(connection, job.id)
    attempts.reserve_results(connection, job.id, 1, 100)
    return job.id, storage.put(f"results/{job.id}/1/report.json", [bytes(100)]).key


def successful_job(database: Database, storage: Storage) -> UUID:
    """A registration job with a file of 100 bytes."""
    with database.transaction() as connection:
        job_id, key = running_job(connection, storage)
        store_registration(
            connection, job_id=job_id, report={"verdict": "good"}, files={"report.json": key}
        )
        attempts.succeed(connection, job_id, 1, {"files": {"report.json": key}})
    return job_id


def find(database: Database, job_id: UUID) -> jobs.Job | None:
    with database.transaction() as connection:
        return jobs.find(connection, job_id)


def test_results_then_jobs_are_removed_by_default_and_the_registration_stays(
    database: Database, storage: Storage, settings: Settings
):
    job_id = successful_job(database, storage)
    job = state_of(database, job_id)
    assert [result_key(job, "report.json")] == storage.keys("results")
    clock_jumps(database, 5000)
    sweep_records(database, storage, settings)
    assert storage.keys("results"), "the clock jumped, but the service has not run"
    service_runs(database, 91)
    sweep_records(database, storage, settings)
    assert storage.keys("results") == []
    kept = state_of(database, job_id)
    assert kept.results_removed_at is not None
    assert kept.results is not None
    with pytest.raises(NotFound, match=r"no result report\.json"):
        result_key(kept, "report.json")
    service_runs(database, 275)
    sweep_records(database, storage, settings)
    assert find(database, job_id) is None
    (row,) = run_in(database.transaction(), "select job_id, files, verdict from registration")
    assert row == {"job_id": None, "files": {}, "verdict": "good"}


def failed_job(database: Database, storage: Storage) -> UUID:
    """A registration job that failed and left a file of 100 bytes all the same."""
    with database.transaction() as connection:
        job_id, key = running_job(connection, storage)
        attempts.fail(connection, job_id, 1, {"title": "no"}, {"files": {"report.json": key}})
    return job_id


def test_the_files_of_a_job_that_failed_stay_for_their_days_and_are_removed_after_them(
    database: Database, storage: Storage, settings: Settings
):
    job_id = failed_job(database, storage)
    service_runs(database, 89)
    sweep_records(database, storage, settings)
    sweep_files(database, storage, settings.job_seconds)
    assert len(storage.keys("results")) == 1
    service_runs(database, 2)
    sweep_records(database, storage, settings)
    assert storage.keys("results") == []
    failed = state_of(database, job_id)
    assert failed.results_removed_at is not None


def test_results_are_removed_once(database: Database, storage: Storage, settings: Settings):
    job_id = successful_job(database, storage)
    service_runs(database, 91)
    sweep_records(database, storage, settings)
    removed = find(database, job_id)
    sweep_records(database, storage, settings)
    assert find(database, job_id) == removed


def test_what_is_left_of_removed_results_is_given_up(
    database: Database, storage: Storage, settings: Settings
):
    """The files of a job whose removal broke off after its row was written."""
    job_id = successful_job(database, storage)
    service_runs(database, 91)
    sweep_records(database, storage, settings)
    storage.put(f"results/{job_id}/1/report.json", [bytes(100)])
    sweep_files(database, storage, settings.job_seconds)
    assert storage.keys("results") == []


def test_the_oldest_jobs_are_deleted_first(
    database: Database, storage: Storage, settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(jobs, "MOST_DELETED", 2)
    ended = []
    with database.transaction() as connection:
        for _ in range(4):
            job = requested(connection, "register-scene", {})
            jobs.dismiss(connection, job.id)
            ended.append(job.id)
    service_runs(database, 400)
    sweep_records(database, storage, settings)
    assert [find(database, job_id) is None for job_id in ended] == [True, True, False, False]


def test_a_job_that_goes_on_is_not_deleted_with_those_that_have_ended(database: Database):
    with database.transaction() as connection:
        made = [jobs.create(connection, "register-scene", {}) for _ in range(3)]
        waiting, running, ended = (job.id for job in made if job is not None)
        assert claim(connection, running)
        jobs.dismiss(connection, ended)
        assert jobs.delete_ended(connection, [waiting, running, ended]) == [ended]


def test_a_size_that_is_recorded_meanwhile_is_not_replaced_by_a_measured_one(database: Database):
    with database.transaction() as connection:
        job = requested(connection, "register-scene", {})
        for before, after in ((None, 7), (100, 100)):
            run_sql(connection, "update job set results_bytes = %s", [before])
            jobs.set_measured(connection, job.id, 7)
            row = run_sql(connection, "select results_bytes from job").fetchone()
            assert row == {"results_bytes": after}


def test_jobs_with_files_stay_when_results_are_kept_for_ever(
    database: Database, storage: Storage, settings: Settings
):
    job_id = successful_job(database, storage)
    service_runs(database, 5000)
    sweep_records(database, storage, settings.model_copy(update={"result_days": None}))
    assert find(database, job_id) is not None
    assert len(storage.keys("results")) == 1


def test_results_stored_before_sizes_were_recorded_are_measured(
    database: Database, storage: Storage, settings: Settings
):
    job_id = successful_job(database, storage)
    run_in(database.transaction(), "update job set results_bytes = null")
    sweep_records(database, storage, settings)
    (row,) = run_in(database.transaction(), "select results_bytes from job where id = %s", [job_id])
    assert row == {"results_bytes": 100}


def test_the_oldest_rows_of_the_audit_are_removed_and_a_row_says_so(
    database: Database, storage: Storage, settings: Settings
):
    with database.transaction() as connection:
        create_token(connection, "old", ["read"])
        create_token(connection, "old too", ["read"])
    service_runs(database, 700)
    with database.transaction() as connection:
        create_token(connection, "young", ["read"])
    clock_jumps(database, 5000)
    sweep_records(database, storage, settings)
    assert len(all_changes(database)) == 3, "the clock jumped, but the service has not run"
    clock_jumps(database, -5000)
    service_runs(database, 40)
    sweep_records(database, storage, settings)
    young, removal = sorted(all_changes(database), key=lambda change: change.id)
    assert (young.after or {})["name"] == "young"
    assert (removal.kind, removal.action, removal.actor_name) == ("audit", "deleted", "retention")
    first, last = removal.subject.split("-")
    assert (int(first), int(last)) == (young.id - 2, young.id - 1)
    assert removal.before is not None
    assert removal.before["rows"] == 2


def test_a_young_row_of_the_audit_stays_beside_old_ones_when_the_clock_jumps(
    database: Database, storage: Storage, settings: Settings
):
    with database.transaction() as connection:
        create_token(connection, "old", ["read"])
    service_runs(database, 750)
    with database.transaction() as connection:
        create_token(connection, "young", ["read"])
    clock_jumps(database, 5000)
    sweep_records(database, storage, settings)
    young, removal = sorted(all_changes(database), key=lambda change: change.id)
    assert (young.after or {})["name"] == "young"
    assert removal.subject == f"{young.id - 1}-{young.id - 1}"


@pytest.mark.parametrize(("clock_days", "service_days"), [(29, 1000), (1000, 29)])
def test_the_audit_keeps_rows_that_are_a_month_old_by_clock_or_service_alone(
    connection: Connection, database: Database, clock_days: int, service_days: int
):
    create_token(connection, "kept", ["read"])
    connection.commit()
    service_runs(database, service_days)
    clock_jumps(database, clock_days - service_days)
    with pytest.raises(psycopg.errors.InsufficientPrivilege, match="30 days after them"):
        run_sql(connection, "delete from audit")


def all_changes(database: Database) -> list:
    with database.transaction() as connection:
        return list_changes(connection, 1000, None, None, None)


@pytest.mark.parametrize(
    ("days", "statement"),
    [
        (29, "delete from audit"),
        (1000, "delete from audit where id = (select max(id) from audit)"),
        (1000, "update audit set actor_name = 'x'"),
        (1000, "truncate audit"),
    ],
)
def test_the_audit_gives_up_nothing_but_its_oldest_rows(
    connection: Connection, database: Database, days: int, statement: str
):
    for name in ("a", "b"):
        create_token(connection, name, ["read"])
    connection.commit()
    service_runs(database, days)
    with pytest.raises(psycopg.errors.InsufficientPrivilege, match="only grows"):
        run_sql(connection, statement)


def test_a_removed_job_leaves_its_owner_in_the_audit(connection: Connection, database: Database):
    owner = create_token(connection, "owner", ["register"]).token
    job = requested(connection, "register-scene", {}, owner.id)
    connection.commit()
    with working_for(Origin(actor_name="worker", job_id=job.id)), database.transaction() as own:
        jobs.dismiss(own, job.id)
    with database.transaction() as own:
        assert jobs.delete_ended(own, [job.id]) == [job.id]
    recorded = list_changes(connection, 10, None, "job", str(job.id))
    assert [change.action for change in recorded] == ["deleted", "changed", "created"]
    assert recorded[1].actor == owner.id
