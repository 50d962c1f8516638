"""Many concurrent clients on one API process, while blocks are ingested and scenes registered.

Each client requests footprints, single points, tiles and chips in turn, without pauses. No request may
be refused or fail. The results are the times to the last byte by kind of request, and the resident
memory of the API and of the worker over the run. The clients run on the same cores.
Run: python -m benchmarks.load --clients 64 --seconds 60
"""

import argparse
import http.client
import json
import math
import os
import random
import signal
import sys
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from amers.app.db import engine
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from amers.app.usecases.tokens import create_token
from benchmarks._measuring import keep, open_folder
from tests.app.flat_world import SIGMA_M, make_flat_world
from tests.factories import make_block
from tests.service_process import Service, until
from tests.statements import run_sql

BOX = (5.2, 43.2, 5.6, 43.6)
POINTS, IMAGES = 6_000, 2
INGESTED_POINTS = 2_000
FOOTPRINT_DEG = 0.16
"""Contains a sixth of the points, about a thousand."""
ZOOMS = (8, 10, 12)
SAMPLE_EVERY_S = 0.25
PATIENCE_S = 300.0
MOST_GROWTH = 1.15
"""Limit of the growth of resident memory from the second to the last quarter of the run."""
ENDED = ("successful", "failed", "dismissed")


@dataclass
class Load:
    """Replies that clients received, and their times.

    Attributes:
        seconds: by kind of request.
        errors: number of each kind of wrong reply.
    """

    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    errors: "Counter[str]" = field(default_factory=Counter)


def run(folder: Path, clients: int, seconds: float, seed: int) -> dict[str, Any]:
    """Load an installation; returns the results.

    Args:
        folder: for all files; other users must be able to enter it.
    """
    service = Service(folder / "data", AMERS_INGEST_FOLDER=str(folder))
    try:
        if not (until(service.is_ready) and until(service.workers)):
            raise TimeoutError("the service did not start")
        secret, first_id = _fill(service, folder)
        return _measure(
            service,
            folder,
            secret=secret,
            first_id=first_id,
            clients=clients,
            seconds=seconds,
            seed=seed,
        )
    finally:
        service.process.terminate()
        service.process.wait(timeout=60)


def _fill(service: Service, folder: Path) -> tuple[str, int]:
    """Publish a block; returns a token and the id of the first point."""
    made = make_block(
        folder / "served",
        POINTS,
        name="served",
        box=BOX,
        n_images=IMAGES,
        gsds_m=(2.0,),
        dtype=np.uint8,
    )
    with service.cluster.lease() as dsn, engine.connect(dsn) as connection:
        block = ingest_block(connection, Storage(service.folder / "storage"), made.folder).block
        publish_block(connection, str(block.number))
        row = run_sql(connection, "select min(id) as id from point").fetchone()
        secret = create_token(connection, "load", ["admin"]).secret
    assert row is not None
    return secret, int(row["id"])


def _measure(
    service: Service,
    folder: Path,
    *,
    secret: str,
    first_id: int,
    clients: int,
    seconds: float,
    seed: int,
) -> dict[str, Any]:
    """Send requests from many clients and jobs beside them; returns times, errors and memory."""
    (worker,) = service.workers()
    load, stop, lock = Load(), threading.Event(), threading.Lock()
    memory: dict[str, list[int]] = {"api": [], "worker": []}

    def client(number: int) -> None:
        rng = random.Random(seed * 1000 + number)
        line = http.client.HTTPConnection("127.0.0.1", service.port, timeout=60.0)
        while not stop.is_set():
            kind, path = rng.choice(KINDS)(rng, first_id)
            started = time.perf_counter()
            wrong = _asked(line, path, secret)
            taken = time.perf_counter() - started
            with lock:
                load.seconds[kind].append(taken)
                if wrong:
                    load.errors[f"{kind}: {wrong}"] += 1

    (api,) = service.apis()

    def sample() -> None:
        while not stop.wait(SAMPLE_EVERY_S):
            for name, pid in (("api", api), ("worker", worker)):
                memory[name].append(_resident_bytes(pid))

    threads = [threading.Thread(target=client, args=(number,)) for number in range(clients)]
    threads.append(threading.Thread(target=sample))
    jobs = _Jobs(service, folder, secret, seconds)
    began = time.monotonic()
    for thread in threads:
        thread.start()
    try:
        work = jobs.done()
        time.sleep(max(0.0, seconds - (time.monotonic() - began)))
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    taken_s = time.monotonic() - began
    growth = {name: _growth(samples) for name, samples in memory.items()}
    requests = sum(map(len, load.seconds.values()))
    return {
        "clients": clients,
        "seconds": round(taken_s, 1),
        "requests": requests,
        "requests_per_s": round(requests / taken_s, 1),
        "errors": dict(load.errors),
        "jobs": work,
        "milliseconds": {kind: _spread_ms(times) for kind, times in sorted(load.seconds.items())},
        "resident_mib": {
            name: {
                "median": round(float(np.median(samples)) / 2**20),
                "most": round(max(samples) / 2**20),
            }
            for name, samples in memory.items()
            if samples
        },
        "growth": growth,
    }


def _footprint(rng: random.Random, first_id: int) -> tuple[str, str]:
    west, south = (
        rng.uniform(BOX[0], BOX[2] - FOOTPRINT_DEG),
        rng.uniform(BOX[1], BOX[3] - FOOTPRINT_DEG),
    )
    box = f"{west:.4f},{south:.4f},{west + FOOTPRINT_DEG:.4f},{south + FOOTPRINT_DEG:.4f}"
    return "footprint", f"/collections/points/items?bbox={box}&limit=2000"


def _point(rng: random.Random, first_id: int) -> tuple[str, str]:
    return "point", f"/collections/points/items/{first_id + rng.randrange(POINTS)}"


def _tile(rng: random.Random, first_id: int) -> tuple[str, str]:
    zoom = rng.choice(ZOOMS)
    lon, lat = rng.uniform(BOX[0], BOX[2]), math.radians(rng.uniform(BOX[1], BOX[3]))
    x = int((lon + 180.0) / 360.0 * 2**zoom)
    y = int((1.0 - math.asinh(math.tan(lat)) / math.pi) / 2.0 * 2**zoom)
    return "tile", f"/collections/points/tiles/WebMercatorQuad/{zoom}/{y}/{x}"


def _chips(rng: random.Random, first_id: int) -> tuple[str, str]:
    return "chips", f"/collections/points/items/{first_id + rng.randrange(POINTS)}/chips?f=npz"


KINDS: tuple[Callable[[random.Random, int], tuple[str, str]], ...] = (_footprint, _point, _tile, _chips)


def _asked(line: http.client.HTTPConnection, path: str, secret: str) -> str:
    """The error of a reply; an empty text if it is complete."""
    try:
        line.request("GET", path, headers={"Authorization": f"Bearer {secret}"})
        reply = line.getresponse()
        body = reply.read()
    except (OSError, http.client.HTTPException) as error:
        line.close()
        return type(error).__name__
    if reply.status != 200:
        return f"{reply.status} {body[:200].decode(errors='replace')}"
    return "" if body else "empty"


@dataclass
class _Jobs:
    """Ingestions and registrations, repeated until the time is over."""

    service: Service
    folder: Path
    secret: str
    seconds: float

    def done(self) -> dict[str, int]:
        """The number of jobs by kind and final state."""
        headers = {"Authorization": f"Bearer {self.secret}"}
        ended: Counter[str] = Counter()
        world = make_flat_world(self.folder / "world", size=800)
        deadline = time.monotonic() + self.seconds
        with httpx.Client(base_url=self.service.url, headers=headers, timeout=60.0) as client:
            self._end(client, self._block(client, "world/block", True), "ingestion", ended)
            scene = client.post(
                f"/scenes?name=a.tif&sigma_m={SIGMA_M}", content=world.tagged.read_bytes()
            ).json()["id"]
            number = 0
            while time.monotonic() < deadline or number == 0:
                number += 1
                name, west = f"ingested-{number}", 10.0 + number
                box = (west, 43.2, west + 0.1, 43.3)
                make_block(
                    self.folder / name,
                    INGESTED_POINTS,
                    seed=number,
                    name=name,
                    box=box,
                    n_images=IMAGES,
                    gsds_m=(2.0,),
                    dtype=np.uint8,
                )
                self._end(client, self._block(client, name, True), "ingestion", ended)
                body = {"inputs": {"scene": scene}}
                reply = client.post("/processes/register-scene/execution", json=body)
                self._end(client, reply, "registration", ended)
        return dict(ended)

    def _block(self, client: httpx.Client, path: str, publish: bool) -> httpx.Response:
        return client.post("/blocks", json={"path": path, "publish": publish})

    def _end(
        self, client: httpx.Client, asked: httpx.Response, kind: str, ended: "Counter[str]"
    ) -> None:
        if asked.status_code >= 300:
            ended[f"{kind} refused: {asked.status_code} {asked.text[:200]}"] += 1
            return
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            job = client.get(asked.headers["location"]).json()
            if job["status"] in ENDED:
                ended[f"{kind} {job['status']}"] += 1
                return
            time.sleep(0.2)
        ended[f"{kind} not ended"] += 1


def _resident_bytes(pid: int) -> int:
    with suppress(OSError):
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
    return 0


def _growth(samples: list[int]) -> float | None:
    """Ratio of the medians of the last and the second quarter; None if the run is too short."""
    quarter = len(samples) // 4
    if quarter < 4:
        return None
    return round(float(np.median(samples[-quarter:]) / np.median(samples[quarter : 2 * quarter])), 3)


def _spread_ms(times: list[float]) -> dict[str, float]:
    p50, p99 = np.percentile(times, [50, 99]) * 1000.0
    return {"count": len(times), "p50": round(float(p50), 1), "p99": round(float(p99), 1)}


def main() -> int:
    """Load an installation, print and save the results; returns 1 if a request failed or memory grew."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clients", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    # The started processes end with this command, also when it is stopped.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))
    with open_folder("amers-load-") as folder:
        outcome = run(folder, arguments.clients, arguments.seconds, arguments.seed)
    print(json.dumps(outcome, indent=1))
    keep("load", outcome)
    well = {"ingestion successful", "registration successful"}
    grew = any(growth is not None and growth > MOST_GROWTH for growth in outcome["growth"].values())
    return 1 if outcome["errors"] or set(outcome["jobs"]) != well or grew else 0


if __name__ == "__main__":
    sys.exit(main())
