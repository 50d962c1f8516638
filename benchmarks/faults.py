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
import json
import random
import signal
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import httpx

from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from benchmarks._faults_caller import Caller
from benchmarks._faults_outcome import IMAGES, POINTS, check_outcome
from benchmarks._killed_installation import PATIENCE_S, KilledInstallation
from benchmarks._measuring import keep
from benchmarks._outages import Outages
from tests.app.flat_world import CENTRE, make_flat_world
from tests.factories import make_block

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
    with tempfile.TemporaryDirectory(prefix="amers-faults-", dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o755)
        outcome = run(folder, Work(**arguments), **how)
    print(json.dumps(outcome, indent=1))
    keep("faults", outcome)
    return 1 if outcome["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
