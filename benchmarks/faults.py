"""Registrations and ingestions of an installation whose processes are killed at random moments.

The API, two workers, the processes of their jobs and PostgreSQL are killed (SIGKILL) again and again
while scenes are uploaded and registered and blocks are ingested. A killed process is restarted within a
second. At the end, every accepted upload and job must exist, every job must have ended once, every
result and block must be complete or absent, and rows and files must refer to each other after the
sweep.
Run: python -m benchmarks.faults --registrations 50 --ingestions 20 --seed 1
"""

import argparse
import hashlib
import json
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from app.config import Settings
from app.db import engine
from app.db.engine import Connection
from app.storage import Storage
from app.usecases.blocks.lifecycle import ingest_block, publish_block
from app.worker.sweep import sweep_files
from benchmarks._killed_installation import LEASE_S, KilledInstallation
from benchmarks._measuring import keep
from tests.app.flat_world import SIGMA_M, make_flat_world
from tests.factories import make_block
from tests.statements import run_sql

OPEN_AT_ONCE = 4
LONGEST_RUN_S = 1800.0
POINTS, IMAGES = 200, 2
MOST_PASSES = 30
"""Largest number of fine searches: one takes little time, many leave time to kill a process within."""
ENDED = ("successful", "failed", "dismissed")
BROKEN = {500, 501, 502, 504}


@dataclass
class Caller:
    """A client that repeats requests until they are answered, and remembers what was accepted.

    Attributes:
        scenes: id to checksum of the uploads that were accepted.
        jobs: id to the scene, or to the name of the block.
        unexpected: replies that no outage explains.
    """

    installation: KilledInstallation
    client: httpx.Client
    deadline: float
    scenes: dict[str, str] = field(default_factory=dict)
    jobs: dict[str, str] = field(default_factory=dict)
    unexpected: list[str] = field(default_factory=list)

    def ask(self, method: str, path: str, **more: Any) -> httpx.Response:
        """The reply to a request, which is repeated while the service or its database is down.

        Raises:
            TimeoutError: there was no reply until the deadline.
        """
        while time.monotonic() < self.deadline:
            with suppress(httpx.TransportError):
                reply = self.client.request(method, path, **more)
                if reply.status_code in BROKEN:
                    self.unexpected.append(f"{method} {path}: {reply.status_code} {reply.text[:200]}")
                elif reply.status_code != 503:
                    return reply
            time.sleep(0.1)
        raise TimeoutError(f"{method} {path}: not answered: see {self.installation.log}")

    def register(self, image: bytes, passes: int, key: str) -> None:
        """Upload a scene and request its registration."""
        name = f"/scenes?name=scene.tif&sigma_m={SIGMA_M}"
        scene = self._promised(self.ask("POST", name, content=image))["id"]
        self.scenes[scene] = hashlib.sha256(image).hexdigest()
        body = {"inputs": {"scene": scene, "options": {"fine_stages": passes}}}
        path = "/processes/register-scene/execution"
        job = self._promised(self.ask("POST", path, json=body, headers={"Idempotency-Key": key}))
        self.jobs[job["jobID"]] = scene

    def ingest(self, name: str, key: str) -> None:
        """Request the ingestion of a block."""
        body = {"path": name, "publish": True}
        job = self._promised(self.ask("POST", "/blocks", json=body, headers={"Idempotency-Key": key}))
        self.jobs[job["jobID"]] = name

    def wait(self, open_jobs: int) -> None:
        """Wait until at most this many jobs are open."""
        waiting = set(self.jobs)
        while len(waiting) > open_jobs:
            for job in tuple(waiting):
                if self.ask("GET", f"/jobs/{job}").json().get("status") in ENDED:
                    waiting.discard(job)
            time.sleep(0.2)

    def _promised(self, reply: httpx.Response) -> dict[str, Any]:
        if reply.status_code != 201:
            raise RuntimeError(f"{reply.request.url}: {reply.status_code} {reply.text}")
        document: dict[str, Any] = reply.json()
        return document


def run(
    folder: Path, registrations: int, ingestions: int, seed: int, kill_every_s: float
) -> dict[str, Any]:
    """Run an installation whose processes are killed; returns requests, outcomes and errors.

    Args:
        folder: for all files; other users must be able to enter it.
    """
    rng = random.Random(seed)
    world = make_flat_world(folder / "world", size=800)
    image = world.tagged.read_bytes()
    started = time.monotonic()
    with KilledInstallation(folder / "data", rng, kill_every_s) as installation:
        storage = Storage(installation.folder / "storage")
        with installation.inside() as connection:
            block = ingest_block(connection, storage, world.block).block
            publish_block(connection, str(block.number))
        tasks = ["registration"] * registrations + ["ingestion"] * ingestions
        random.Random(seed).shuffle(tasks)
        headers = {"Authorization": f"Bearer {installation.token()}"}
        installation.start_killing()
        with httpx.Client(base_url=installation.url, headers=headers, timeout=15.0) as client:
            caller = Caller(installation, client, started + LONGEST_RUN_S)
            for number, task in enumerate(tasks):
                if task == "registration":
                    passes = random.Random(seed + number).randint(1, MOST_PASSES)
                    caller.register(image, passes, f"task {number}")
                else:
                    name = f"faults-{number}"
                    box = (5.2 + number, 43.2, 5.3 + number, 43.3)
                    into = installation.ingest_folder / name
                    make_block(
                        into, POINTS, seed=number, name=name, box=box, n_images=IMAGES, gsds_m=(2.0,)
                    )
                    caller.ingest(name, f"task {number}")
                caller.wait(OPEN_AT_ONCE - 1)
                counts = ", ".join(f"{kind} {count}" for kind, count in installation.killed.items())
                print(f"{number + 1} of {len(tasks)} requested; killed: {counts}", file=sys.stderr)
            caller.wait(0)
            installation.stop_killing()
            installation.wait_ready()
    taken_s = time.monotonic() - started
    with installation.cluster.lease() as dsn:
        outcome = check_outcome(dsn, installation, caller)
    return {
        "registrations": registrations,
        "ingestions": ingestions,
        "seed": seed,
        "taken_s": round(taken_s, 1),
        "killed": dict(installation.killed),
        **outcome,
    }


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


def main() -> int:
    """Run, print and save the results; returns 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--registrations", type=int, default=50)
    parser.add_argument("--ingestions", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kill-every-s", type=float, default=2.0)
    arguments = parser.parse_args()
    # The started processes end with this command, also when it is stopped.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))
    with tempfile.TemporaryDirectory(prefix="amers-faults-", dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        outcome = run(
            folder,
            arguments.registrations,
            arguments.ingestions,
            arguments.seed,
            arguments.kill_every_s,
        )
    print(json.dumps(outcome, indent=1))
    keep("faults", outcome)
    return 1 if outcome["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
