"""An installation whose processes are killed at random moments, while all kinds of work go on.

Scenes are uploaded whole and in pieces, and registered; blocks are ingested and exported; backups are
made. Meanwhile the API, two workers, the processes of their jobs, PostgreSQL and running backups are
killed (SIGKILL) again and again. A killed process is restarted within a second. The storage is not
mounted for some seconds, and the database is read-only, as often as requested.

At the end the run checks that every accepted upload and job exists, that every job has ended once, and
that every result, block and backup is complete or absent. After the sweep, rows and files must refer to
each other. The quotas of all owners must add up to the size of the storage.

Run: python -m benchmarks.faults [--registrations 100 --ingestions 40 --uploads 40 --exports 20 ...]
"""

import argparse
import hashlib
import json
import random
import signal
import sys
import time
from collections import Counter
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import httpx

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Connection
from amers.app.db.usage import read_all_usage
from amers.app.errors import InputError
from amers.app.storage import Storage
from amers.app.usecases.backups.manifest import find_problems, read_manifest
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from amers.app.worker.sweep import sweep_files
from benchmarks._faults_caller import ENDED, Caller
from benchmarks._killed_installation import LEASE_S, PATIENCE_S, KilledInstallation, Outages
from benchmarks._measuring import keep, open_folder
from tests.app.flat_world import CENTRE, make_flat_world
from tests.factories import make_block
from tests.statements import run_sql

POINTS, IMAGES = 200, 2
"""Of each block that is ingested."""
OPEN_AT_ONCE = 4
LONGEST_RUN_S = 3600.0
REQUEST_S = 15.0
"""Timeout of the client."""
MOST_PASSES = 30
"""Largest number of fine searches: one takes little time, many leave time to kill a process within."""
HALF_EXPORT_DEG = 0.05
KILLED_BACKUPS = 0.5
"""Share of the backups that are killed on the way."""


@dataclass(frozen=True)
class Work:
    """How often each kind of work is requested."""

    registrations: int
    ingestions: int
    uploads: int
    exports: int
    backups: int

    def tasks(self, rng: random.Random) -> list[str]:
        """The kinds of work in a random order."""
        tasks = [name.removesuffix("s") for name, count in asdict(self).items() for _ in range(count)]
        rng.shuffle(tasks)
        return tasks


def run(
    folder: Path,
    work: Work,
    seed: int,
    kill_every_s: float,
    *,
    unmounts: int = 0,
    read_onlys: int = 0,
) -> dict[str, Any]:
    """Run an installation whose processes are killed; returns requests, outcomes and errors.

    Args:
        folder: for all files; other users must be able to enter it.
        unmounts, read_onlys: how often the storage is not mounted, and the database is read-only.
    """
    world = make_flat_world(folder / "world", size=800)
    image = world.tagged.read_bytes()
    started = time.monotonic()
    deadline = started + LONGEST_RUN_S
    with KilledInstallation(folder / "data", random.Random(seed), kill_every_s) as installation:
        storage = Storage(installation.folder / "storage")
        with installation.inside() as connection:
            block = ingest_block(connection, storage, world.block).block
            publish_block(connection, str(block.number))
        headers = {"Authorization": f"Bearer {installation.token()}"}
        installation.start_killing()
        outages = Outages(installation)
        with httpx.Client(base_url=installation.url, headers=headers, timeout=REQUEST_S) as client:
            caller = Caller(client, str(installation.log), deadline)
            tasks = work.tasks(random.Random(seed))
            due = _moments(len(tasks), unmounts, read_onlys)
            for number, task in enumerate(tasks):
                if number in due:
                    outages.begin(due[number])
                _request(installation, caller, image, task, number)
                caller.wait(OPEN_AT_ONCE - 1)
                counts = ", ".join(f"{kind} {count}" for kind, count in installation.killed.items())
                print(f"{number + 1} of {len(tasks)} requested; killed: {counts}", file=sys.stderr)
            caller.wait(0)
            outages.wait()
            installation.stop_killing()
            installation.wait_ready()
    taken_s = time.monotonic() - started
    with installation.cluster.lease() as dsn:
        outcome = check_outcome(dsn, installation, caller)
    outcome["wrong"] += [*outages.wrong, *installation.hung]
    return {
        **asdict(work),
        "seed": seed,
        "taken_s": round(taken_s, 1),
        "killed": dict(installation.killed),
        "outages": dict(outages.had),
        "refused": dict(caller.refused),
        "acknowledged": {
            "scenes": len(caller.scenes),
            "jobs": len(caller.jobs),
            "backups": len(installation.finished_backups),
        },
        "longest_request": caller.longest_s,
        "limit_of_requests_s": REQUEST_S,
        "timeouts": caller.n_timeouts,
        "longest_backup_s": round(installation.longest_backup_s, 1),
        "limit_of_backups_s": PATIENCE_S,
        **outcome,
    }


def _moments(n_tasks: int, unmounts: int, read_onlys: int) -> dict[int, str]:
    """The numbers of the tasks at which an outage begins, evenly among all, and its kind."""
    kinds = [
        kind
        for pair in zip_longest(["storage"] * unmounts, ["database"] * read_onlys)
        for kind in pair
        if kind is not None
    ]
    return {(place + 1) * n_tasks // (len(kinds) + 1): kind for place, kind in enumerate(kinds)}


def _request(
    installation: KilledInstallation, caller: Caller, image: bytes, task: str, number: int
) -> None:
    """Do one task, or request its job; its random choices follow from its number."""
    key, rng = f"task {number}", random.Random(number)
    if task == "registration":
        caller.register(image, rng.randint(1, MOST_PASSES), key)
    elif task == "upload":
        caller.upload(image, rng)
    elif task == "export":
        west, south = (float(value) for value in CENTRE - HALF_EXPORT_DEG)
        caller.export((west, south, west + 2 * HALF_EXPORT_DEG, south + 2 * HALF_EXPORT_DEG), key)
    elif task == "backup":
        installation.back_up(f"backup-{number}", rng.uniform(0.2, 2.0), rng.random() < KILLED_BACKUPS)
    else:
        name = f"faults-{number}"
        box = (5.2 + number % 150, 43.2, 5.3 + number % 150, 43.3)
        into = installation.ingest_folder / name
        make_block(into, POINTS, seed=number, name=name, box=box, n_images=IMAGES, gsds_m=(2.0,))
        caller.ingest(name, key)


def main() -> int:
    """Run, print and save the results; returns 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--registrations", type=int, default=100)
    parser.add_argument("--ingestions", type=int, default=40)
    parser.add_argument("--uploads", type=int, default=40)
    parser.add_argument("--exports", type=int, default=20)
    parser.add_argument("--backups", type=int, default=10)
    parser.add_argument("--unmounts", type=int, default=2)
    parser.add_argument("--read-onlys", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kill-every-s", type=float, default=2.0)
    arguments = vars(parser.parse_args())
    how = {name: arguments.pop(name) for name in ("seed", "kill_every_s", "unmounts", "read_onlys")}
    # The started processes end with this command, also when it is stopped.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))
    with open_folder("amers-faults-") as folder:
        outcome = run(folder, Work(**arguments), **how)
    print(json.dumps(outcome, indent=1))
    keep("faults", outcome)
    return 1 if outcome["wrong"] else 0


def check_outcome(dsn: str, installation: KilledInstallation, caller: Caller) -> dict[str, Any]:
    """The outcomes of all requests, and all errors, after all processes have ended."""
    settings = Settings(database_url=dsn, data_folder=installation.folder, lease_seconds=LEASE_S)
    storage = Storage(installation.folder / "storage")
    with engine.pooled(dsn, settings) as database:
        with database.transaction() as connection:
            # Abandoned uploads are deleted after a day: simulate two days.
            run_sql(
                connection,
                "update scene set created_at = created_at - interval '2 days' where state = 'uploading'",
            )
            run_sql(
                connection,
                "update upload set expires_at = expires_at - interval '2 days'"
                " where finished_at is null",
            )
            run_sql(connection, "update uptime set elapsed_s = elapsed_s + 2 * 86400")
        sweep_files(database, storage, settings.job_seconds)
        storage.sweep_unfinished(0.0, spare="upload-")
        with database.transaction() as connection:
            jobs = run_sql(connection, "select * from job").fetchall()
            wrong = [
                *caller.unexpected,
                *wrong_jobs(connection, jobs, caller),
                *wrong_scenes(connection, storage, caller),
                *wrong_blocks(connection, jobs),
                *wrong_files(connection, storage),
                *wrong_ledger(connection, storage),
                *wrong_backups(installation),
            ]
    return {
        "ended": dict(Counter(f"{job['kind']} {job['state']}" for job in jobs)),
        "attempts": dict(sorted(Counter(job["attempt"] for job in jobs).items())),
        "failures": sorted({job["message"] for job in jobs if job["state"] == "failed"}),
        "wrong": wrong,
    }


def wrong_jobs(connection: Connection, jobs: list[dict[str, Any]], caller: Caller) -> list[str]:
    """Accepted jobs that are missing, have not ended or ended twice, and incomplete results."""
    jobs_by_id = {str(job["id"]): job for job in jobs}
    wrong = [f"job {job} is gone" for job in caller.jobs if job not in jobs_by_id]
    for name, job in jobs_by_id.items():
        ends = run_sql(
            connection,
            "select count(*) as n from audit where kind = 'job' and subject = %s"
            " and after ->> 'state' = any(%s) and before ->> 'state' <> after ->> 'state'",
            [name, list(ENDED)],
        ).fetchone()
        results = run_sql(
            connection, "select count(*) as n from registration where job_id = %s", [name]
        ).fetchone()
        assert ends is not None
        assert results is not None
        expected = int(job["kind"] == "register-scene" and job["state"] == "successful")
        if name not in caller.jobs:
            wrong.append(f"job {name} was promised to nobody")
        if job["state"] not in ENDED or ends["n"] != 1:
            wrong.append(f"job {name} is {job['state']} and ended {ends['n']} times")
        if results["n"] != expected:
            wrong.append(f"job {name} is {job['state']} and has {results['n']} results")
    return wrong


def wrong_scenes(connection: Connection, storage: Storage, caller: Caller) -> list[str]:
    """Accepted uploads that are missing or differ from what was sent."""
    wrong = []
    for scene, sha256 in caller.scenes.items():
        row = run_sql(connection, "select file_key, state from scene where id = %s", [scene]).fetchone()
        if row is None or row["state"] != "uploaded" or not storage.exists(row["file_key"]):
            wrong.append(f"scene {scene} is gone: {row}")
        elif hashlib.sha256(storage.path(row["file_key"]).read_bytes()).hexdigest() != sha256:
            wrong.append(f"scene {scene} is not what was sent")
    return wrong


def wrong_blocks(connection: Connection, jobs: list[dict[str, Any]]) -> list[str]:
    """Blocks that are present without a successful job, absent with one, or incomplete."""
    ingested = {
        job["inputs"]["path"]: job["state"] == "successful"
        for job in jobs
        if job["kind"] == "ingest-block"
    }
    rows = run_sql(
        connection,
        """select b.id, b.state,
               (select count(*) from point p where p.block_number = b.number) as points,
               (select count(*) from view v join point p on p.id = v.point_id
                where p.block_number = b.number) as views,
               (select count(*) from image i where i.block_number = b.number) as images,
               (select count(*) from chip_file c where c.block_number = b.number) as files
           from block b where b.id like 'faults-%'""",
    ).fetchall()
    whole = {
        "state": "published",
        "points": POINTS,
        "views": POINTS * IMAGES,
        "images": IMAGES,
        "files": 1,
    }
    rows_by_id = {row.pop("id"): row for row in rows}
    wrong = [f"block {name} is not whole: {row}" for name, row in rows_by_id.items() if row != whole]
    for name, there in ingested.items():
        if there != (name in rows_by_id):
            wrong.append(
                f"block {name}: the job ended {'well' if there else 'badly'}, rows: {name in rows_by_id}"
            )
    return [*wrong, *(f"block {name} has no job" for name in rows_by_id.keys() - ingested.keys())]


def wrong_files(connection: Connection, storage: Storage) -> list[str]:
    """Files without rows, rows without files, and chips with another checksum than their name."""
    named = {
        row["key"]
        for row in run_sql(
            connection,
            """select storage_key as key from chip_file
               union select file_key from scene where state = 'uploaded' and file_key is not null
               union select file.value from job,
                   lateral jsonb_each_text(coalesce(results -> 'files', '{}')) as file
               union select file_key from upload where file_key is not null""",
        ).fetchall()
    }
    stored = {
        key for top in ("chips", "scenes", "results", "blocks", "uploads") for key in storage.keys(top)
    }
    wrong = [f"{key}: no row names it" for key in stored - named]
    wrong += [f"{key}: no such file" for key in named - stored]
    wrong += [f"{path.name}: left in {path.parent.name}" for path in storage.scratch().iterdir()]
    for key in storage.keys("chips"):
        if hashlib.sha256(storage.path(key).read_bytes()).hexdigest() != Path(key).stem:
            wrong.append(f"{key}: not the chips of that checksum")
    return wrong


def wrong_ledger(connection: Connection, storage: Storage) -> list[str]:
    """Bytes that the quotas of all owners count and the storage does not hold, or the reverse."""
    counted = sum(usage.total_bytes for usage in read_all_usage(connection))
    stored = sum(
        storage.size(key) for top in ("scenes", "results", "uploads") for key in storage.keys(top)
    )
    return [] if counted == stored else [f"quotas count {counted} bytes, the storage holds {stored}"]


def wrong_backups(installation: KilledInstallation) -> list[str]:
    """Backups that are not as their manifest says, or are not whole although their command succeeded."""
    wrong = [f"{folder.name}: gone" for folder in installation.finished_backups if not folder.is_dir()]
    for folder in sorted(path for path in installation.backups.glob("[!.]*") if path.is_dir()):
        try:
            manifest = read_manifest(folder)
        except InputError as error:
            wrong.append(f"{folder.name}: {error}")
            continue
        problems = [*find_problems(folder, manifest), *(item.key for item in manifest.damaged)]
        wrong += [f"{folder.name}: {problem}" for problem in problems]
    return wrong


if __name__ == "__main__":
    sys.exit(main())
