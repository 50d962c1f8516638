"""A day of a constellation through the queue: 64 workers, 4,000 scenes, simulated work.

Queue, database and files are real: each worker takes a ticket of procrastinate, claims a job, reads the
file of its scene, reports progress, waits for the time of a registration, stores the files of a result
with their checksums, and ends the job and its ticket. The functions are those of workers, which are
threads of one process here. Two times are measured: that of a claim, with its transaction and its wait
for other claims, and that between the end of a job and the next claim.
Run: python -m benchmarks.claims [--workers 64] [--scenes 4000] [--work-s 3]
"""

import argparse
import os
import random
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from uuid import UUID

import numpy as np

from amers.app.config import Settings
from amers.app.db import engine, revisions, stored_files
from amers.app.db.cluster.embedded import Cluster
from amers.app.db.engine import Database
from amers.app.db.jobs import attempts, queue
from amers.app.storage import Storage
from amers.app.usecases.tokens import create_token
from benchmarks._measuring import keep, open_folder
from tests.statements import run_sql

OWNERS = 8
LEASE_S = 60.0
SCENE_BYTES, RESULT_BYTES, RESULT_FILES = 8_000_000, 60_000, 8
"""Of an image of 2,000 px and of the files of its registration."""
TAKE_TICKET = "select id from procrastinate_fetch_job_v2(null, null) where id is not null"
END_TICKET = "select procrastinate_finish_job_v1(%s, 'succeeded', true)"


class Day:
    """The workers of a day, and what they saw.

    Attributes:
        seconds: by the name of a step.
    """

    def __init__(self, database: Database, storage: Storage, scene: str, work_s: float) -> None:
        """Nothing is done yet.

        Args:
            database: with the jobs.
            storage: of scenes and results.
            scene: key of the file that every job reads.
            work_s: mean of the simulated work.
        """
        self.database, self.storage, self.scene, self.work_s = database, storage, scene, work_s
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self._lock = threading.Lock()

    def work(self, number: int) -> None:
        """Do jobs until no ticket is left."""
        rng, ended_at = random.Random(number), None
        time.sleep(rng.uniform(0.0, self.work_s))  # workers do not begin in step
        while True:
            with self._timed("ticket"), self.database.transaction() as connection:
                ticket = run_sql(connection, TAKE_TICKET).fetchone()
            if ticket is None:
                return
            with self._timed("claim"), self.database.transaction() as connection:
                job = attempts.claim_next(connection, f"worker {number}", LEASE_S, None)
            if ended_at is not None:
                self._note("between jobs", time.perf_counter() - ended_at)
            if job is not None:
                self._do(job.id, job.attempt, rng)
                ended_at = time.perf_counter()
            with self._timed("ticket ended"), self.database.transaction() as connection:
                run_sql(connection, END_TICKET, [ticket["id"]])

    def _do(self, job: UUID, attempt: int, rng: random.Random) -> None:
        with self._timed("files"), self.storage.open(self.scene) as file:
            while file.read(1 << 20):
                pass
        for percent in (30, 60, 90):
            time.sleep(self.work_s / 3.0 * rng.uniform(0.5, 1.5))
            with self._timed("progress"), self.database.transaction() as connection:
                attempts.report(connection, job, attempt, percent, "matching")
        content = [rng.randbytes(RESULT_BYTES)]
        with self._timed("files"):
            files = [
                self.storage.put(f"jobs/{job}/{attempt}/{k}.bin", content) for k in range(RESULT_FILES)
            ]
        with self._timed("end"), self.database.transaction() as connection:
            for one in files:
                stored_files.record_result(connection, job, one.key, one.size_bytes, one.sha256)
            attempts.succeed(connection, job, attempt, {"files": [one.key for one in files]})

    @contextmanager
    def _timed(self, step: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self._note(step, time.perf_counter() - began)

    def _note(self, step: str, seconds: float) -> None:
        with self._lock:
            self.seconds[step].append(seconds)


def fill(database: Database, scenes: int) -> None:
    """Make waiting jobs of a few owners, each with its ticket."""
    with database.transaction() as connection:
        owners = [create_token(connection, f"owner {k}", ["register"]).token.id for k in range(OWNERS)]
        run_sql(
            connection,
            "insert into job (id, kind, state, inputs, owner)"
            " select gen_random_uuid(), 'register-scene', 'accepted', '{}',"
            " (%s::uuid[])[1 + number %% %s] from generate_series(1, %s) number",
            [owners, OWNERS, scenes],
        )
        run_sql(
            connection,
            "insert into procrastinate_jobs (queue_name, task_name)"
            " select %s, %s from generate_series(1, %s)",
            [queue.QUEUE, queue.TASK, scenes],
        )


def main() -> None:
    """Work through a day, print the times of its steps, keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=64)
    parser.add_argument("--scenes", type=int, default=4000)
    parser.add_argument("--work-s", type=float, default=3.0, help="mean of the simulated work")
    arguments = parser.parse_args()
    settings = Settings(pool_size=arguments.workers)
    with ExitStack() as stack:
        folder = stack.enter_context(open_folder())
        dsn = stack.enter_context(Cluster(folder / "postgres").lease())
        revisions.upgrade(dsn)
        database = stack.enter_context(engine.pooled(dsn, settings))
        fill(database, arguments.scenes)
        storage = Storage(folder / "storage")
        storage.put("scenes/one.tif", [os.urandom(SCENE_BYTES)])
        day = Day(database, storage, "scenes/one.tif", arguments.work_s)
        workers = [threading.Thread(target=day.work, args=(k,)) for k in range(arguments.workers)]
        began = time.perf_counter()
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        elapsed_s = time.perf_counter() - began
        with database.transaction() as connection:
            done = run_sql(connection, "select count(*) as n from job where state = 'successful'")
            jobs_done = int(done.fetchone()["n"])
    ideal_s = arguments.scenes * arguments.work_s / arguments.workers
    print(f"{jobs_done} jobs in {elapsed_s:.0f} s; {ideal_s:.0f} s of simulated work a worker")
    outcome = {"jobs": jobs_done, "elapsed_s": elapsed_s, "ideal_s": ideal_s, "ms": {}}
    for step, taken in day.seconds.items():
        ms = 1e3 * np.quantile(taken, [0.5, 0.95, 0.99, 1.0])
        outcome["ms"][step] = ms.round(2).tolist()
        print(f"{step:14} {len(taken):7} " + " ".join(f"{one:9.2f}" for one in ms))
    keep("claims", outcome)


if __name__ == "__main__":
    main()
