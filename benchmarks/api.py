"""Latency and throughput of the commonest requests, beside tipg and pygeoapi on the same table.

A private cluster is filled with five million points. Each service is one process, and the same client
sends the same requests to all of them in turn. tipg and pygeoapi read a view of the table with the
columns that our API serves, with an index of its own; unlike ours, they check no access rights. Every
reply is read to its end; only the first reply of each kind is parsed, and all services must give the
same points.

With `--beside N` a second cluster has N points of the same density, and the ratios of latencies are
printed.
Run: python -m benchmarks.api [--tipg PYTHON] [--pygeoapi PYTHON] [--points 20000000 --beside 1000000]
"""

import argparse
import http.client
import json
import math
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from amers.app.db import engine, revisions
from amers.app.db.cluster.embedded import DATABASE, SUPERUSER, Cluster
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from benchmarks import _servers
from benchmarks._filled import ROW_BLOCKS, Ground, fill
from benchmarks._measuring import keep, open_folder
from benchmarks._servers import Server
from tests.factories import make_block
from tests.statements import run_sql

FOOTPRINT_POINTS = 1_800
PAGE_POINTS = 15_000
"""In the boxes of which pages of 10,000 are asked."""
CHIP_POINTS, CHIP_VIEWS = 250, 8
TILE_ZOOM = 8
WARM_UP = 3
KEPT_REPEATS = 4
MEBIBYTE = 1 << 20

Ask = Callable[[Server, np.random.Generator], str]


@dataclass(frozen=True)
class Times:
    """Milliseconds of one service for one kind of request, measured at the client."""

    what: str
    server: str
    median_ms: float
    p95_ms: float
    megabytes: float


@dataclass(frozen=True)
class Store:
    """A filled store and the service on it."""

    server: Server
    ground: Ground
    dsn: str


def main() -> None:
    """Fill the stores, measure, print and save the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=5_000_000)
    parser.add_argument("--beside", type=int, help="points of a second store to compare latencies with")
    parser.add_argument("--tipg", type=Path, metavar="PYTHON", help="interpreter that has tipg")
    parser.add_argument("--pygeoapi", type=Path, metavar="PYTHON", help="interpreter that has pygeoapi")
    parser.add_argument("--repeats", type=int, default=60)
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measure of throughput")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # Clean up on SIGTERM too.
    console = Console()
    with ExitStack() as stack:
        store = stack.enter_context(filled(arguments.points, console))
        outcome: dict[str, object] = {"points": arguments.points}
        if arguments.beside is not None:
            other = stack.enter_context(filled(arguments.beside, console))
            outcome["beside"] = arguments.beside
            outcome["grown"] = grown(store, other, arguments.repeats, console)
        else:
            servers = [store.server, *peers(stack, store, arguments, console)]
            same_points(servers, store.ground)
            times = latencies(servers, store.ground, arguments.repeats)
            times += [*kept_open(store, arguments.repeats), chips(store, arguments.repeats)]
            outcome["times"] = [asdict(one) for one in times]
            outcome["throughput_per_s"] = rates = throughput(
                servers, store.ground, arguments.clients, arguments.seconds
            )
            outcome["pages"] = memory = page_memory(store, arguments.repeats)
            show(times, rates, memory, arguments.clients, console)
    keep(f"api_{arguments.points}", outcome)


@contextmanager
def filled(count: int, console: Console) -> Iterator[Store]:
    """A store with this many points and one small block with chips, and our service on it."""
    with open_folder() as folder, ExitStack() as stack:
        cluster = Cluster(folder / "postgres", durable=False)
        dsn = stack.enter_context(cluster.lease())
        revisions.upgrade(dsn)
        start = time.perf_counter()
        ground = fill(cluster.dsn(DATABASE, SUPERUSER), count, console)
        console.print(f"{count:,} points in {time.perf_counter() - start:.0f} s")
        made = make_block(
            folder / "block",
            count=2 * CHIP_POINTS,
            name="chips",
            box=(5.0, 80.0, 5.4, 80.08),  # North of the points of `fill`.
            n_images=CHIP_VIEWS,
            gsds_m=(2.0,),
            dtype=np.uint8,
        )
        with engine.connect(dsn) as connection:
            ingest_block(connection, Storage(folder / "storage"), made.folder)
            publish_block(connection, "chips")
        yield Store(stack.enter_context(_servers.amers(folder)), ground, dsn)


def peers(
    stack: ExitStack, store: Store, arguments: argparse.Namespace, console: Console
) -> Iterator[Server]:
    """The other services, where their interpreters are given."""
    if arguments.tipg or arguments.pygeoapi:
        with engine.connect(store.dsn) as connection:
            _servers.show_to_peers(connection)
    if arguments.tipg is None:
        console.print("without tipg: give --tipg PYTHON")
    else:
        yield stack.enter_context(_servers.tipg(arguments.tipg, store.dsn))
    if arguments.pygeoapi is None:
        console.print("without pygeoapi: give --pygeoapi PYTHON")
    else:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="amers-bench-")))
        server = _servers.pygeoapi(arguments.pygeoapi, store.dsn, folder, arguments.clients)
        yield stack.enter_context(server)


def kinds(ground: Ground) -> dict[str, Ask]:
    """The requests, by name; a path is empty where a service has no such resource."""
    # Tiles further south cover more degrees, and so more points.
    first_row = replace(ground, west_south_deg=ground.west_south_deg[:ROW_BLOCKS])

    def in_box(count: int) -> Ask:
        def ask(server: Server, rng: np.random.Generator) -> str:
            box = ",".join(repr(side) for side in ground.box(rng, count))
            return f"{server.items}?{server.page}&bbox={box}"

        return ask

    def point(server: Server, rng: np.random.Generator) -> str:
        return f"{server.items}/{ground.point_id(rng)}?f={server.page.partition('f=')[2]}"

    def tile(server: Server, rng: np.random.Generator) -> str:
        west, south, _, _ = first_row.box(rng, FOOTPRINT_POINTS)
        side = 2**TILE_ZOOM
        x = int((west + 180.0) / 360.0 * side)
        y = int((1.0 - math.asinh(math.tan(math.radians(south))) / math.pi) / 2.0 * side)
        place = f"{TILE_ZOOM}/{x}/{y}" if server.name == "tipg" else f"{TILE_ZOOM}/{y}/{x}"
        return f"{server.tiles}/{place}" if server.tiles else ""

    return {
        f"footprint of {FOOTPRINT_POINTS:,} points": in_box(FOOTPRINT_POINTS),
        "point by id": point,
        f"tile at zoom {TILE_ZOOM}": tile,
        "page of 10,000": in_box(PAGE_POINTS),
    }


def latencies(servers: Sequence[Server], ground: Ground, repeats: int) -> list[Times]:
    """Times of each kind of request; all services get the same requests in turn."""
    found = []
    for what, ask in kinds(ground).items():
        turns = max(5, repeats // 6) if "page" in what else repeats
        answering = [server for server in servers if ask(server, np.random.default_rng(0))]
        found += in_turn(what, {server.name: (server, ask) for server in answering}, turns)
    return found


def in_turn(what: str, ways: Mapping[str, tuple[Server, Ask]], repeats: int) -> list[Times]:
    """Times of services that get the same request one after the other in every turn."""
    taken: dict[str, list[float]] = {name: [] for name in ways}
    size: dict[str, list[int]] = {name: [] for name in ways}
    for turn in range(repeats + WARM_UP):
        for name, (server, ask) in ways.items():
            path = ask(server, np.random.default_rng(turn))
            connection = server.connect()  # Its turn may come after the keep-alive time of the server.
            connection.connect()
            start = time.perf_counter()
            body = get(connection, path)
            if turn >= WARM_UP:
                taken[name].append(time.perf_counter() - start)
                size[name].append(len(body))
            connection.close()
    return [times_of(what, name, taken[name], float(np.median(size[name]))) for name in ways]


def times_of(what: str, server: str, taken_s: Sequence[float], size: float) -> Times:
    """The median and the 95 % quantile of times, and the size of a reply."""
    median_s, most_s = np.quantile(taken_s, [0.5, 0.95])
    return Times(what, server, 1000.0 * float(median_s), 1000.0 * float(most_s), size / 1e6)


def kept_open(store: Store, repeats: int) -> list[Times]:
    """Times of our service alone on a kept connection, as most clients use it."""
    found, open_one = [], store.server.connect()
    for what, ask in list(kinds(store.ground).items())[:2]:
        taken, size = [], 0
        for turn in range(KEPT_REPEATS * repeats + WARM_UP):
            path = ask(store.server, np.random.default_rng(turn))
            start = time.perf_counter()
            size = len(get(open_one, path))
            if turn >= WARM_UP:
                taken.append(time.perf_counter() - start)
        found.append(times_of(f"{what}, connection kept", "amers", taken, size))
    return found


def get(connection: http.client.HTTPConnection, path: str, body: bytes | None = None) -> bytes:
    """The body of a reply with status 200."""
    headers = {} if body is None else {"Content-Type": "application/json"}
    connection.request("GET" if body is None else "POST", path, body, headers)
    reply = connection.getresponse()
    content = reply.read()
    if reply.status != 200:
        raise RuntimeError(f"{path}: {reply.status}: {content[:300]!r}")
    return content


def same_points(servers: Sequence[Server], ground: Ground) -> None:
    """Check that all services give the same points of a box."""
    ask = next(iter(kinds(ground).values()))
    found = []
    for server in servers:
        reply = json.loads(get(server.connect(), ask(server, np.random.default_rng(1))))
        found.append({int(feature["id"]) for feature in reply["features"]})
    if not found[0] or any(other != found[0] for other in found):
        raise RuntimeError(f"services differ: {[len(points) for points in found]} points")


def throughput(
    servers: Sequence[Server], ground: Ground, clients: int, seconds: float
) -> dict[str, float]:
    """Footprints per second of each service, with several concurrent clients."""
    ask = next(iter(kinds(ground).values()))
    rates = {}
    for server in servers:
        done = [0] * clients
        start = time.perf_counter()

        def work(k: int, server: Server = server, done: list[int] = done, start: float = start) -> None:
            connection, rng = server.connect(), np.random.default_rng(k)
            while time.perf_counter() - start < seconds:
                get(connection, ask(server, rng))
                done[k] += 1

        threads = [threading.Thread(target=work, args=(k,)) for k in range(clients)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        rates[server.name] = sum(done) / (time.perf_counter() - start)
    return rates


def chips(store: Store, repeats: int) -> Times:
    """The chips of 250 points, 2,000 views, as one archive."""
    with engine.connect(store.dsn) as connection:
        rows = run_sql(
            connection,
            "select p.id from point p join block b on b.number = p.block_number where b.id = 'chips'",
        ).fetchall()
    ids = np.array([row["id"] for row in rows])
    open_one, taken, size = store.server.connect(), [], 0
    for turn in range(repeats + WARM_UP):
        chosen = np.random.default_rng(turn).choice(ids, CHIP_POINTS, replace=False)
        body = json.dumps({"ids": chosen.tolist()}).encode()
        start = time.perf_counter()
        size = len(get(open_one, "/collections/points/chips", body))
        if turn >= WARM_UP:
            taken.append(time.perf_counter() - start)
    what = f"chips of {CHIP_POINTS} points, {CHIP_POINTS * CHIP_VIEWS:,} views"
    return times_of(what, "amers", taken, size)


def page_memory(store: Store, repeats: int) -> dict[str, float]:
    """Resident memory of our process before and after pages of 10,000, and its peak between."""
    ask = kinds(store.ground)["page of 10,000"]
    process, open_one = store.server.replying, store.server.connect()
    Path(f"/proc/{process}/clear_refs").write_text("5")
    before = resident_mib(process, "VmRSS")
    size = 0
    for turn in range(repeats):
        size = len(get(open_one, ask(store.server, np.random.default_rng(turn))))
    return {
        "pages": repeats,
        "page_mib": size / MEBIBYTE,
        "before_mib": before,
        "peak_mib": resident_mib(process, "VmHWM"),
        "after_mib": resident_mib(process, "VmRSS"),
    }


def resident_mib(process: int, line: str) -> float:
    """A line of /proc/PID/status in MiB."""
    status = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(text.split()[1]) for text in status if text.startswith(f"{line}:")) / 1024.0


def grown(store: Store, other: Store, repeats: int, console: Console) -> dict[str, dict[str, float]]:
    """Ratios of latencies on two stores, measured in turn."""
    table = Table("request", f"{other.ground.points:,}", f"{store.ground.points:,}", "ratio")
    ratios: dict[str, dict[str, float]] = {}
    here = kinds(store.ground)
    for what, there in kinds(other.ground).items():
        ways = {"small": (other.server, there), "large": (store.server, here[what])}
        small, large = in_turn(what, ways, repeats)
        ratio = large.median_ms / small.median_ms
        ratios[what] = {"small_ms": small.median_ms, "large_ms": large.median_ms, "ratio": ratio}
        table.add_row(what, f"{small.median_ms:.1f} ms", f"{large.median_ms:.1f} ms", f"{ratio:.2f}")
    console.print(table)
    return ratios


def show(
    times: Sequence[Times],
    rates: Mapping[str, float],
    memory: Mapping[str, float],
    clients: int,
    console: Console,
) -> None:
    """Print the results."""
    table = Table("request", "service", "median", "95 %", "MB", "beside amers")
    ours = {one.what: one.median_ms for one in times if one.server == "amers"}
    for one in times:
        cells = f"{one.median_ms:.1f} ms", f"{one.p95_ms:.1f} ms", f"{one.megabytes:.2f}"
        table.add_row(one.what, one.server, *cells, f"{one.median_ms / ours[one.what]:.1f}")
    console.print(table)
    table = Table("service", f"footprints/s, {clients} clients", "amers is so many times faster")
    for name, rate in rates.items():
        table.add_row(name, f"{rate:.1f}", f"{rates['amers'] / rate:.1f}")
    console.print(table)
    console.print(
        f"{memory['pages']:.0f} pages of {memory['page_mib']:.1f} MiB: resident MiB: "
        f"{memory['before_mib']:.0f} before, {memory['peak_mib']:.0f} at most, "
        f"{memory['after_mib']:.0f} after"
    )


if __name__ == "__main__":
    main()
