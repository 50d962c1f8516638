"""Workers on two machines, one of which loses its network: the other takes over the job."""

import os
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import pytest
from psycopg.conninfo import conninfo_to_dict, make_conninfo
from pydantic import SecretStr

from amers.app.db import engine
from tests.app.flat_world import make_flat_world
from tests.app.installation import Installation, Worker
from tests.app.worker_processes import (
    alive,
    wait_until,
)
from tests.statements import run_sql

pytestmark = [pytest.mark.long, pytest.mark.endurance]

LEASE_S = 3.0
PIECE_BYTES = 65_536


@dataclass(frozen=True)
class Machine:
    """A network namespace with one line to the database.

    Attributes:
        name: of the namespace, and of the line's end outside.
        address: of that end, at which the database is reached.
    """

    name: str
    address: str

    @property
    def enter(self) -> tuple[str, ...]:
        """The prefix that runs a command in the namespace."""
        return ("ip", "netns", "exec", self.name)

    def line(self, state: str) -> None:
        """Cut (`down`) or restore (`up`) the network line."""
        _ip("link", "set", self.name, state)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


def _machine(number: int, cleanup: ExitStack) -> Machine:
    name, inside = f"amers{uuid4().hex[:6]}", f"in{uuid4().hex[:6]}"
    network = f"10.231.{os.getpid() % 250}.{4 * number}"
    address, own = (f"{network.rsplit('.', 1)[0]}.{4 * number + end}" for end in (1, 2))
    _ip("netns", "add", name)
    cleanup.callback(_ip, "netns", "delete", name)
    _ip("link", "add", name, "type", "veth", "peer", "name", inside)
    cleanup.callback(subprocess.run, ["ip", "link", "delete", name], capture_output=True)
    _ip("link", "set", inside, "netns", name)
    _ip("address", "add", f"{address}/30", "dev", name)
    _ip("link", "set", name, "up")
    _ip("-n", name, "address", "add", f"{own}/30", "dev", inside)
    _ip("-n", name, "link", "set", inside, "up")
    return Machine(name, address)


@pytest.fixture
def machines() -> Iterator[tuple[Machine, Machine]]:
    """Two machines that reach this one but not each other."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and iproute2")
    with ExitStack() as cleanup:
        try:
            made = _machine(0, cleanup), _machine(1, cleanup)
        except subprocess.CalledProcessError as refused:
            pytest.skip(f"no network namespace can be made here: {refused.stderr.strip()}")
        yield made


@pytest.fixture
def reached(machines: tuple[Machine, Machine], dsn: str) -> Iterator[tuple[str, str]]:
    """The connection string of each machine: by TCP over its own line."""
    with ExitStack() as cleanup:
        yield tuple(_listen(machine.address, dsn, cleanup) for machine in machines)


def _listen(address: str, dsn: str, cleanup: ExitStack) -> str:
    place = f"{conninfo_to_dict(dsn)['host']}/.s.PGSQL.5432"
    server = cleanup.enter_context(socket.create_server((address, 0)))

    def accept() -> None:
        with suppress(OSError):
            while True:
                near = server.accept()[0]
                far = socket.socket(socket.AF_UNIX)
                far.connect(place)
                for here, there in ((near, far), (far, near)):
                    threading.Thread(target=_relay, args=(here, there), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    cleanup.callback(server.shutdown, socket.SHUT_RDWR)
    return make_conninfo(dsn, host=address, port=server.getsockname()[1])


def _relay(here: socket.socket, there: socket.socket) -> None:
    with suppress(OSError):
        while piece := here.recv(PIECE_BYTES):
            there.sendall(piece)
    for end in (here, there):
        with suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)


def test_a_worker_that_is_cut_off_loses_its_job_to_another_and_works_again_once_it_is_back(
    machines: tuple[Machine, Machine],
    reached: tuple[str, str],
    installation: Installation,
    tmp_path: Path,
):
    world = make_flat_world(tmp_path / "world", size=800)
    ask = installation.registering(world)

    def worker_on(machine: Machine, address: str) -> Worker:
        database = SecretStr(address)
        return installation.worker({}, *machine.enter, database_url=database, lease_seconds=LEASE_S)

    lost, other = machines
    job = ask(40)
    with worker_on(lost, reached[0]) as worker:
        process = installation.process(job, worker)
        lost.line("down")
        with worker_on(other, reached[1]):
            ended_job = installation.ended(job)
        assert ended_job["status"] == "successful", ended_job
        lost.line("up")
        wait_until(lambda: not alive(process), "the process of the lost attempt ends")
        again = installation.ended(ask(1))
        assert again["status"] == "successful", "the worker that was cut off is back at work"
        assert worker.poll() is None
    assert installation.me.get(job).json() == ended_job, "what came late changed nothing"
    with engine.connect(installation.dsn) as connection:
        rows = run_sql(
            connection,
            "select attempt, (select count(*) from registration r where r.job_id = j.id) as results"
            " from job j order by created_at",
        ).fetchall()
    assert [(row["attempt"], row["results"]) for row in rows] == [(2, 1), (1, 1)]
    assert {key.split("/")[2] for key in installation.storage.keys(f"results/{ended_job['jobID']}")} == {
        "2"
    }
