"""The fair queue: whose job is next, who may have how many running, and that no job is forgotten."""

import random
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts, jobs, progress, queue
from amers.app.db.jobs.attempts import LostJob
from amers.app.usecases.tokens import create_token
from amers.app.worker.attempt import ATTEMPTS_ALLOWED
from amers.app.worker.sweep import sweep_jobs
from tests.app.job_queue import LEASE_S, let_lease_lapse, requested, tickets
from tests.app.worker_processes import ended, running_worker, wait_until
from tests.statements import run_in, run_sql

FLOOD = 1000
TAKE_TICKET = "select id from procrastinate_fetch_job_v2(null, null) where id is not null"
END_TICKET = "select procrastinate_finish_job_v1(%s, 'succeeded', true)"
MOST_RUNNING = """select coalesce(max(n), 0) as n
    from (select count(*) as n from job where state = 'running' group by owner) owners"""


def owner_named(connection: Connection, name: str) -> UUID:
    """The id of a new token."""
    return create_token(connection, name, ["register"]).token.id


def ask(connection: Connection, owner: UUID | None, priority: int = 0) -> UUID:
    """The id of a new job of an owner."""
    job = requested(connection, "register-scene", {"scene": str(uuid4())}, owner, priority=priority)
    return job.id


def flood(connection: Connection, owner: UUID, count: int = FLOOD) -> None:
    """Many waiting jobs of one owner, each with its ticket."""
    run_sql(
        connection,
        "insert into job (id, kind, state, inputs, owner)"
        " select gen_random_uuid(), 'register-scene', 'accepted', '{}', %s from generate_series(1, %s)",
        [owner, count],
    )
    run_sql(
        connection,
        "insert into procrastinate_jobs (queue_name, task_name)"
        " select %s, %s from generate_series(1, %s)",
        [queue.QUEUE, queue.TASK, count],
    )


def claim(connection: Connection, limit: int | None = None) -> jobs.Job:
    """The next job, claimed."""
    job = attempts.claim_next(connection, "w", LEASE_S, limit)
    assert job is not None
    return job


def do_one(connection: Connection) -> UUID | None:
    """The owner of the next job, after that job was done."""
    job = claim(connection)
    attempts.succeed(connection, job.id, job.attempt, {})
    return job.owner


def test_a_flood_of_jobs_delays_another_owner_by_one_job(connection: Connection):
    many, one = owner_named(connection, "many"), owner_named(connection, "one")
    flood(connection, many)
    running = claim(connection)
    wanted = ask(connection, one)
    assert progress.outlook(connection, wanted).position == 1
    attempts.succeed(connection, running.id, running.attempt, {})
    assert claim(connection).id == wanted


def test_a_flood_on_many_workers_leaves_the_next_free_one_to_another_owner(connection: Connection):
    many, one = owner_named(connection, "many"), owner_named(connection, "one")
    flood(connection, many)
    for _ in range(4):
        assert claim(connection).owner == many, "whoever is alone has all workers"
    mine = [ask(connection, one) for _ in range(3)]
    assert [claim(connection).id for _ in range(3)] == mine, "three running jobs are fewer than four"


def test_owners_take_turns_and_each_has_his_oldest_job_done_first(connection: Connection):
    first, second = owner_named(connection, "first"), owner_named(connection, "second")
    for owner in (first, first, first, second, second, None):
        ask(connection, owner)
    assert [do_one(connection) for _ in range(6)] == [first, second, None, first, second, first]


def test_an_owner_who_comes_back_waits_behind_those_who_were_served_before(connection: Connection):
    early, late = owner_named(connection, "early"), owner_named(connection, "late")
    ask(connection, early)
    ask(connection, late)
    assert [do_one(connection), do_one(connection)] == [early, late]
    run_sql(connection, "delete from job")
    ask(connection, late)
    ask(connection, early)
    assert do_one(connection) == early, "to delete one's jobs does not win a turn"


def test_jobs_of_a_higher_priority_come_first_whosever_they_are(connection: Connection):
    one, other = owner_named(connection, "one"), owner_named(connection, "other")
    ask(connection, one)
    low, urgent, high = (ask(connection, other, priority) for priority in (-5, 90, 10))
    order = [claim(connection).id for _ in range(3)]
    assert order[:2] == [urgent, high]
    assert order[2] != low


def test_only_administrators_give_priorities(client: TestClient, bearer):
    scene = client.post(
        "/scenes?name=a.tif", content=b"II*\0" + bytes(100), headers=(me := bearer("register"))
    )
    body = {"inputs": {"scene": scene.json()["id"]}, "amers:priority": 7}
    execute = "/processes/register-scene/execution"
    refused = me.post(execute, json=body)
    assert (refused.status_code, refused.json()["detail"].count("admin")) == (403, 1)
    job = bearer("admin").post(execute, json=body)
    assert (job.status_code, job.json()["amers:priority"]) == (201, 7)
    beyond = bearer("admin").post(execute, json={**body, "amers:priority": 101})
    assert (beyond.status_code, "amers:priority" in beyond.json()["detail"]) == (422, True)


def test_nobody_else_gives_a_priority_below_the_usual_one_either(bearer):
    execute, me = "/processes/register-scene/execution", bearer("register")
    scene = me.scene(b"II*\0" + bytes(100), "name=a.tif")
    for priority, status in ((-1, 403), (0, 201)):
        body = {"inputs": {"scene": scene}, "amers:priority": priority}
        assert me.post(execute, json=body).status_code == status


def test_an_owner_at_his_limit_waits_and_others_go_on(connection: Connection):
    greedy, other = owner_named(connection, "greedy"), owner_named(connection, "other")
    flood(connection, greedy, 10)
    assert [claim(connection, 2).owner for _ in range(2)] == [greedy, greedy]
    assert attempts.claim_next(connection, "w", LEASE_S, 2) is None
    ask(connection, other)
    assert claim(connection, 2).owner == other


@pytest.mark.parametrize("how", ["succeed", "fail", "give_back", "try_again", "dismiss", "die"])
def test_a_ticket_spent_at_the_limit_comes_back_when_a_job_of_the_owner_ends(
    database: Database, dsn: str, how: str
):
    with engine.connect(dsn) as connection:
        owner = owner_named(connection, "one")
        running = ask(connection, owner)
        waiting = ask(connection, owner)
        first = claim(connection, 1)
        assert first.id == running
        assert attempts.claim_next(connection, "w", LEASE_S, 1) is None
        run_sql(connection, "delete from procrastinate_jobs")
    end = {
        "succeed": lambda c: attempts.succeed(c, running, 1, {}),
        "fail": lambda c: attempts.fail(c, running, 1, {"title": "no"}),
        "give_back": lambda c: attempts.give_back(c, running, 1),
        "try_again": lambda c: attempts.try_again(c, running, 1, 3600.0),
        "dismiss": lambda c: jobs.dismiss(c, running),
        "die": lambda c: None,
    }[how]
    with database.transaction() as connection:
        end(connection)
    if how == "die":
        let_lease_lapse(database, running)
        sweep_jobs(database, LEASE_S, 1)
    with database.transaction() as connection:
        (due,) = run_sql(
            connection,
            "select count(*) as n from procrastinate_jobs where coalesce(scheduled_at, now()) <= now()",
        ).fetchall()
        assert due["n"] == 1
        assert claim(connection, 1).id == (running if how in ("give_back", "die") else waiting)


def test_the_end_of_a_job_issues_no_ticket_that_nobody_needs(connection: Connection):
    owner = owner_named(connection, "one")
    for _ in range(3):
        ask(connection, owner)
    run_sql(
        connection,
        "delete from procrastinate_jobs where id in (select min(id) from procrastinate_jobs)",
    )
    job = claim(connection)
    attempts.succeed(connection, job.id, job.attempt, {})
    assert tickets(connection) == 2, "two jobs wait"


def test_a_spent_ticket_is_replaced_once_few_are_left(
    connection: Connection, monkeypatch: pytest.MonkeyPatch
):
    """With many tickets nothing is counted: claims would wait for it."""
    monkeypatch.setattr(queue, "MANY_TICKETS", 2)
    owner = owner_named(connection, "one")
    for _ in range(5):
        ask(connection, owner)
    spend = "delete from procrastinate_jobs where id in (select min(id) from procrastinate_jobs)"
    left = []
    for spent in (3, 1, 0):
        job = claim(connection)
        for _ in range(spent):
            run_sql(connection, spend)
        attempts.succeed(connection, job.id, job.attempt, {})
        left.append(tickets(connection))
    assert left == [2, 2, 2], "4, 3 and 2 jobs wait: two tickets are many, one is replaced"


def test_every_ticket_lies_in_the_queue_of_the_workers_under_the_name_of_their_task(
    connection: Connection,
):
    for _ in range(3):
        ask(connection, None)
    back = claim(connection)
    attempts.give_back(connection, back.id, back.attempt)
    again = claim(connection)
    attempts.try_again(connection, again.id, again.attempt, 3600.0)
    last = claim(connection)
    run_sql(connection, "delete from procrastinate_jobs where scheduled_at is null")
    attempts.succeed(connection, last.id, last.attempt, {})
    found = run_sql(
        connection,
        "select queue_name, task_name, status, scheduled_at is null as at_once"
        " from procrastinate_jobs order by at_once",
    ).fetchall()
    named = {"queue_name": queue.QUEUE, "task_name": queue.TASK, "status": "todo"}
    assert found == [{**named, "at_once": False}, {**named, "at_once": True}]


def test_a_repeated_attempt_waits_for_its_delay(connection: Connection):
    delayed = ask(connection, None)
    job = claim(connection)
    attempts.try_again(connection, job.id, job.attempt, 3600.0)
    assert attempts.claim_next(connection, "w", LEASE_S) is None
    other = ask(connection, None)
    assert claim(connection).id == other, "younger jobs of the same owner need not wait for it"
    scheduled = run_sql(
        connection,
        "select scheduled_at = not_before as same from procrastinate_jobs, job"
        " where scheduled_at is not null and job.id = %s",
        [delayed],
    ).fetchall()
    assert [row["same"] for row in scheduled] == [True], "a ticket that came earlier would be spent"
    run_sql(connection, "update job set not_before = now()")
    assert claim(connection).id == delayed


def test_whoever_owns_a_job_that_is_not_due_it_is_not_claimed_before(connection: Connection):
    owners = (None, owner_named(connection, "one"), owner_named(connection, "two"))
    for owner in owners:
        ask(connection, owner)
        job = claim(connection)
        attempts.try_again(connection, job.id, job.attempt, 3600.0)
    assert attempts.claim_next(connection, "w", LEASE_S) is None
    run_sql(connection, "update job set priority = 50")
    for owner in owners:
        run_sql(
            connection,
            "update job set not_before = now(), priority = 0 where owner is not distinct from %s",
            [owner],
        )
        job = claim(connection)
        assert job.owner == owner
        assert attempts.claim_next(connection, "w", LEASE_S) is None, "the others are not due"
        run_sql(connection, "update job set priority = 50")
        attempts.try_again(connection, job.id, job.attempt, 3600.0)


def test_the_next_job_of_an_owner_is_called_when_one_has_lost_too_many_workers(connection: Connection):
    owner = owner_named(connection, "one")
    lost, waiting = ask(connection, owner), ask(connection, owner)
    assert claim(connection, 1).id == lost
    run_sql(connection, "delete from procrastinate_jobs")
    run_sql(
        connection,
        "update job set lease_until = now() - interval '1 s', attempt = %s where id = %s",
        [ATTEMPTS_ALLOWED, lost],
    )
    assert attempts.take_back(connection, ATTEMPTS_ALLOWED) == [lost]
    assert tickets(connection) == 1
    assert claim(connection, 1).id == waiting


def test_of_several_lost_jobs_each_waits_again_or_fails_by_its_own_attempts(connection: Connection):
    owner = owner_named(connection, "one")
    lost = [ask(connection, owner) for _ in range(4)]
    for number, job in enumerate(lost):
        claim(connection)
        attempt = ATTEMPTS_ALLOWED if number % 2 else 1
        run_sql(connection, "update job set attempt = %s where id = %s", [attempt, job])
    run_sql(connection, "update job set lease_until = now() - interval '1 s'")
    assert sorted(attempts.take_back(connection, ATTEMPTS_ALLOWED)) == sorted(lost)
    states = [job.state for job in map(partial(jobs.find, connection), lost) if job is not None]
    assert states == ["accepted", "failed", "accepted", "failed"]


def test_jobs_at_the_limit_need_no_lost_tickets_and_others_get_them(database: Database):
    with database.transaction() as connection:
        greedy = owner_named(connection, "greedy")
        flood(connection, greedy, 40)
        for _ in range(2):
            claim(connection, 2)
        run_sql(connection, "delete from procrastinate_jobs")
        run_sql(connection, "update job set updated_at = now() - interval '1 hour'")
        assert queue.replace_lost_tickets(connection, LEASE_S, 2) == 0
        assert queue.replace_lost_tickets(connection, LEASE_S, 5) == 3
        assert queue.replace_lost_tickets(connection, LEASE_S, None) == queue.TICKETS_PER_SWEEP


def test_positions_follow_the_turns_of_the_owners(connection: Connection):
    first, second = owner_named(connection, "first"), owner_named(connection, "second")
    ask(connection, first)
    running = claim(connection)
    waiting = [ask(connection, owner) for owner in (first, first, first, second, second, None)]
    urgent = ask(connection, first, priority=1)
    places = [progress.outlook(connection, job).position for job in (*waiting, urgent)]
    assert places == [4, 6, 7, 2, 5, 3, 1]
    assert progress.outlook(connection, running.id).position is None
    attempts.succeed(connection, running.id, running.attempt, {})
    order = []
    for _ in range(7):
        job = claim(connection)
        attempts.succeed(connection, job.id, job.attempt, {})
        order.append(job.id)
    assert [order.index(job) + 1 for job in (*waiting, urgent)] == places


@dataclass
class Crowd:
    """Workers whose jobs do nothing but end: well or badly, given back, repeated, lost or dismissed.

    Attributes:
        limit: most running jobs of one owner.
        claims: jobs and attempts as the workers got them.
        over_limit: the numbers of running jobs of one owner that exceeded the limit.
        stop: ends the workers.
    """

    database: Database
    limit: int
    claims: list[tuple[UUID, int]] = field(default_factory=list)
    over_limit: list[int] = field(default_factory=list)
    stop: threading.Event = field(default_factory=threading.Event)

    def work(self, number: int) -> None:
        """Take tickets, as procrastinate's workers take them, and end the jobs they call for."""
        chance = random.Random(number)
        while not self.stop.is_set():
            taken = run_in(self.database.transaction(), TAKE_TICKET)
            if not taken:
                time.sleep(0.005)
                continue
            job = self.claim(f"w{number}")
            if job is not None:
                with suppress(LostJob), self.database.transaction() as connection:
                    self.end(connection, job, chance.random())
            run_in(self.database.transaction(), END_TICKET, [taken[0]["id"]])

    def claim(self, worker: str) -> jobs.Job | None:
        """The next job, noted together with the running jobs beside it."""
        with self.database.transaction() as connection:
            job = attempts.claim_next(connection, worker, LEASE_S, self.limit)
            running = run_sql(connection, MOST_RUNNING).fetchone()
        assert running is not None
        if running["n"] > self.limit:
            self.over_limit.append(running["n"])
        if job is not None:
            self.claims.append((job.id, job.attempt))
        return job

    def end(self, connection: Connection, job: jobs.Job, roll: float) -> None:
        """End the attempt in one of the ways in which attempts end."""
        if roll < 0.1:
            attempts.give_back(connection, job.id, job.attempt)
        elif roll < 0.2:
            attempts.try_again(connection, job.id, job.attempt, 0.02)
        elif roll < 0.3:
            jobs.dismiss(connection, job.id)
        elif roll < 0.4:
            attempts.fail(connection, job.id, job.attempt, {"title": "no"})
        elif roll < 0.5:
            attempts.renew(connection, job.id, job.attempt, -1.0)
            attempts.take_back(connection, ATTEMPTS_ALLOWED)
        else:
            attempts.succeed(connection, job.id, job.attempt, {})


@pytest.mark.thorough
def test_workers_at_once_do_every_job_once_within_the_limit_and_forget_none(database: Database):
    with database.transaction() as connection:
        for number in range(5):
            owner = owner_named(connection, f"owner {number}")
            for _ in range(20):
                ask(connection, owner)
    crowd = Crowd(database, limit=2)
    with ThreadPoolExecutor(3) as threads:
        workers = [threads.submit(crowd.work, number) for number in range(3)]
        try:
            wait_until(lambda: not open_jobs(database), "all jobs end without a sweep")
        finally:
            crowd.stop.set()
    for worker in workers:
        worker.result()
    assert len(set(crowd.claims)) == len(crowd.claims) >= 100
    assert crowd.over_limit == []


def open_jobs(database: Database) -> int:
    """The number of jobs that have not ended."""
    (row,) = run_in(
        database.transaction(), "select count(*) as n from job where state in ('accepted', 'running')"
    )
    return int(row["n"])


def test_a_worker_killed_between_its_ticket_and_the_claim_leaves_the_job_to_others(database: Database):
    with database.transaction() as connection:
        waiting = ask(connection, None)
        run_sql(
            connection,
            "insert into procrastinate_workers (last_heartbeat) values (now() - interval '1 h')",
        )
        run_sql(
            connection,
            "update procrastinate_jobs set status = 'doing',"
            " worker_id = (select id from procrastinate_workers)",
        )
        run_sql(connection, "update job set updated_at = now() - interval '1 hour'")
    sweep_jobs(database, LEASE_S)
    with database.transaction() as connection:
        assert tickets(connection) == 1
        assert claim(connection).id == waiting


@pytest.mark.thorough
def test_a_real_worker_does_the_job_of_another_owner_before_the_rest_of_a_flood(
    client: TestClient, settings: Settings, bearer, tmp_path: Path
):
    """Each job fails quickly: its scene is no image."""
    jobs_of: dict[str, list[str]] = {}
    for name, count in (("many", 6), ("one", 1)):
        me = bearer("register")
        scene = me.scene(b"II*\0" + bytes(100), "name=a.tif")
        made = [me.execute("register-scene", {"scene": scene}) for _ in range(count)]
        jobs_of[name] = [str(reply.json()["jobID"]) for reply in made]
    admin = bearer("admin")
    with running_worker(settings, tmp_path / "log"):
        ended(client, f"/jobs/{jobs_of['one'][0]}", admin)
        states = [admin.get(f"/jobs/{job}").json()["status"] for job in jobs_of["many"]]
    assert states[0] == "failed", "the oldest job of all came first"
    assert states[2:] == ["accepted"] * 4
