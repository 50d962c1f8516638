"""What an installation whose processes were killed must look like at its end."""

import hashlib
from collections import Counter
from pathlib import Path
from typing import Any

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Connection
from amers.app.db.usage import read_all_usage
from amers.app.errors import InputError
from amers.app.storage import Storage
from amers.app.usecases.backups.manifest import find_problems, read_manifest
from amers.app.worker.sweep import sweep_files
from benchmarks._faults_caller import ENDED, Caller
from benchmarks._killed_installation import LEASE_S, KilledInstallation
from tests.statements import run_sql

POINTS, IMAGES = 200, 2
"""Of each block that is ingested."""


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
