"""What every change of a job does to a job in every state: all columns, tickets, turns and messages.

Each change is tried in a transaction of its own, beside other jobs that must stay as they are. Times are
told in seconds from now.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import UUID

from sqlalchemy import insert

from amers.app.db.engine import Connection
from amers.app.db.jobs import attempts, jobs
from amers.app.db.jobs.attempts import LostJob
from amers.app.db.schema import job as table
from amers.app.usecases.tokens import create_token
from tests.statements import run_sql

GOLDEN = Path(__file__).parents[1] / "golden" / "job_states.json"
JOB, OLDER, NEWER = (UUID(int=number) for number in (7, 8, 9))
"""The job that is changed, and two others of its owner, of which the first waits and the second runs."""
ATTEMPT, FAILURES = 4, 2
HOUR_S = 3600.0
STEP_S = 10.0
"""Times are told to so many seconds, so that a slow machine tells the same."""

Row = dict[str, Any]
Change = Callable[[Connection], object]

_RUNNING: Row = {"state": "running", "worker": "w", "lease_until": HOUR_S}
_ENDED: Row = {"finished_at": -2 * HOUR_S, "results": {"files": {"a.tif": 1}}}
STATES: Mapping[str, Row] = {
    "waits": {"state": "accepted"},
    "waits for its first attempt": {
        **{"state": "accepted", "attempt": 0, "failures": 0},
        **{"started_at": None, "claimed_at": None},
    },
    "waits for its time": {"state": "accepted", "not_before": HOUR_S},
    "runs": _RUNNING,
    "runs with a message and room": {**_RUNNING, "progress": 37, "results_bytes": 500},
    "runs without a lease": {**_RUNNING, "lease_until": -HOUR_S},
    "has succeeded": {"state": "successful", "results_bytes": 500, **_ENDED},
    "has succeeded long ago by the clock alone": {
        **{"state": "successful", "results_bytes": 500, "created_at_uptime_s": 0.0},
        **_ENDED,
    },
    "has succeeded without files": {"state": "successful", "results_bytes": 0, **_ENDED, "results": {}},
    "has succeeded, was not measured": {"state": "successful", "results_bytes": None, **_ENDED},
    "lost its files": {"state": "successful", "results_removed_at": -HOUR_S, **_ENDED},
    "has failed": {"state": "failed", "error": {"title": "no"}, "finished_at": -2 * HOUR_S},
    "has failed with files": {"state": "failed", "results_bytes": 500, **_ENDED},
    "has failed, its room is not back": {"state": "failed", "results_bytes": 500},
    "was dismissed": {"state": "dismissed", "finished_at": -2 * HOUR_S},
    "was dismissed, its room is not back": {"state": "dismissed", "results_bytes": 500},
}
_WRITES: Mapping[str, Callable[[Connection, UUID, int], object]] = {
    "renews its lease": lambda c, job, n: attempts.renew(c, job, n, 40.0),
    "reports progress": lambda c, job, n: attempts.report(c, job, n, 71, "words"),
    "reserves room": lambda c, job, n: attempts.reserve_results(c, job, n, 555),
    "gives room back": attempts.release_results,
    "succeeds": lambda c, job, n: attempts.succeed(c, job, n, {"a": 1}),
    "succeeds with words": lambda c, job, n: attempts.succeed(c, job, n, {"a": 1}, "words"),
    "fails": lambda c, job, n: attempts.fail(c, job, n, {"title": "Title"}),
    "fails with results": lambda c, job, n: attempts.fail(
        c, job, n, {"title": "Title", "detail": "words"}, {"b": 1}
    ),
    "is given back": attempts.give_back,
    "is tried again": lambda c, job, n: attempts.try_again(c, job, n, 40.0),
    "is tried again, uncounted": lambda c, job, n: attempts.try_again(c, job, n, 40.0, counts=False),
}
"""What an attempt writes, or is written of it."""


def _of_attempt(write: Callable[[Connection, UUID, int], object], number: int) -> Change:
    return lambda connection: write(connection, JOB, number)


CHANGES: Mapping[str, Change] = {
    "is claimed": lambda c: _seen(attempts.claim_next(c, "another", 40.0)),
    "is claimed beside one that runs": lambda c: _seen(attempts.claim_next(c, "another", 40.0, 2)),
    "is not claimed beside one that runs": lambda c: _seen(attempts.claim_next(c, "another", 40.0, 1)),
    **{name: _of_attempt(write, ATTEMPT) for name, write in _WRITES.items()},
    **{f"{name}, an attempt late": _of_attempt(write, ATTEMPT - 1) for name, write in _WRITES.items()},
    "loses its worker": lambda c: attempts.take_back(c, ATTEMPT + 1),
    "loses its last worker": lambda c: attempts.take_back(c, ATTEMPT),
    "is dismissed": lambda c: jobs.dismiss(c, JOB),
    "is deleted": lambda c: jobs.delete_ended(c, [JOB]),
    "loses results of an hour": lambda c: jobs.remove_old_results(c, HOUR_S),
    "loses results of a day": lambda c: jobs.remove_old_results(c, 24 * HOUR_S),
    "is deleted after an hour": lambda c: jobs.delete_old(c, HOUR_S),
    "is deleted after a day": lambda c: jobs.delete_old(c, 24 * HOUR_S),
    "is measured": lambda c: jobs.set_measured(c, JOB, 555),
    "is asked for, unmeasured": jobs.unmeasured,
    "is asked for, with room lost": attempts.lost_reservations,
    "is asked for, with its attempt": lambda c: attempts.counting_attempts(c, [JOB, UUID(int=77)]),
}
"""What happens to a job."""


def _seen(job: jobs.Job | None) -> tuple[UUID, int, str] | None:
    return None if job is None else (job.id, job.attempt, job.state)


def outcomes(connection: Connection, state: str) -> Iterator[tuple[str, list[str]]]:
    """What each change does to a job in a state."""
    now = run_sql(connection, "select clock_timestamp() as now").fetchone()
    assert now is not None
    owner = create_token(connection, "owner", ["register"]).token.id
    connection.execute(
        insert(table),
        [
            _row(now["now"], owner, {"id": JOB, **STATES[state]}),
            _row(now["now"], owner, {"id": OLDER, "state": "accepted", "priority": -5}),
            _row(now["now"], owner, {"id": NEWER, **_RUNNING}),
        ],
    )
    before = _everything(connection)
    for name, change in CHANGES.items():
        savepoint = connection.begin_nested()
        try:
            returned = change(connection)
            texts = [] if returned is None else [f"returns {_told(returned, now['now'])}"]
            texts += _differences(before, _everything(connection), now["now"])
        except LostJob as lost:
            texts = [f"refused: {lost}"]
        savepoint.rollback()
        yield name, [text.replace(str(owner), "OWNER") for text in texts]


def _row(now: datetime, owner: UUID, own: Row) -> Row:
    """A whole row; times of `own` are in seconds from now."""
    row: Row = {
        "kind": "register-scene",
        "message": "before",
        "progress": 0,
        "inputs": {},
        "owner": owner,
        "attempt": ATTEMPT,
        "failures": FAILURES,
        "created_at": -6 * HOUR_S,
        "started_at": -5 * HOUR_S,
        "claimed_at": -4 * HOUR_S,
        "updated_at": -3 * HOUR_S,
        "created_at_uptime_s": -6 * HOUR_S,
        "results_bytes": 0,
        "priority": 0,
        **dict.fromkeys(("finished_at", "lease_until", "not_before", "results_removed_at")),
        **dict.fromkeys(("error", "results", "worker")),
        **own,
    }
    times = [
        name for name in row if name.endswith(("_at", "_until", "_before")) and row[name] is not None
    ]
    return row | {name: now + timedelta(seconds=row[name]) for name in times}


def _everything(connection: Connection) -> dict[str, Any]:
    """The values of all rows that have to do with jobs, by table, row and column."""
    values: dict[str, Any] = {}
    for name, statement in {
        "": "select * from job order by id",
        "turn": "select owner as id, * from job_turn",
        "messages": "select job_id as id, array_agg(array[attempt::text, progress::text, message]"
        " order by id) as all from job_message group by job_id",
        "ticket": "select row_number() over (order by id) as id, task_name, queue_name, scheduled_at"
        " from procrastinate_jobs where status = 'todo'",
    }.items():
        for row in run_sql(connection, statement):
            key = f"{name} {_NAMES.get(row['id'], row['id'])}".strip()
            values |= {f"{key}: {column}": value for column, value in row.items() if column != "id"}
    return values


_NAMES = {JOB: "job", OLDER: "the one that waits", NEWER: "the one that runs"}


def _differences(before: dict[str, Any], after: dict[str, Any], now: datetime) -> list[str]:
    """The values that differ, as texts."""
    gone = sorted({path.split(":")[0] for path in before.keys() - after.keys()})
    return [f"{path}: gone" for path in gone] + [
        f"{path} = {_told(value, now)}"
        for path, value in after.items()
        if path not in before or before[path] != value
    ]


def _told(value: Any, now: datetime) -> str:
    """A value as a text; a time by its distance from now."""
    if isinstance(value, datetime):
        seconds = (value.astimezone(UTC) - now).total_seconds()
        return f"now {round(seconds / STEP_S) * STEP_S:+.0f} s"
    if isinstance(value, UUID):
        return _NAMES.get(value, str(value))
    if isinstance(value, dict):
        return json.dumps({_told(key, now): _told(one, now) for key, one in value.items()})
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_told(one, now) for one in value) + "]"
    return str(value)


def _written(name: str, found: dict[str, list[str]]) -> str:
    rows = [f"  {json.dumps(change)}: {json.dumps(texts)}" for change, texts in found.items()]
    return f" {json.dumps(name)}: {{\n" + ",\n".join(rows) + "\n }"


def written(found: dict[str, dict[str, list[str]]]) -> str:
    """The table as a file, a line for each change in each state."""
    return "{\n" + ",\n".join(_written(name, changes) for name, changes in found.items()) + "\n}\n"
