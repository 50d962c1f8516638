"""Processes that are kept running: restarted after a crash, ended with their supervisor."""

import signal
import subprocess
import sys
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import pytest

from amers.app.cli import serve
from amers.app.usecases import local_access

PATIENCE_S = 60.0
SUPERVISOR = """
import logging, sys
from amers.app.cli.supervisor import Child, Supervisor
logging.basicConfig(level="INFO")
supervisor = Supervisor()
children = [
    Child("the first", sys.argv[1], must_start=True, ending_s=float(sys.argv[3])),
    Child("the second", sys.argv[2], ending_s=float(sys.argv[3])),
]
supervisor.run(children, at_stop=lambda: print("stops", flush=True))
sys.exit(supervisor.exit_code)
"""
REPORTS = r"import os, signal, time; os.write(1, b'{0} %d\n' % os.getpid()); "
"""In one write: two processes write into the same log."""
LIVES = REPORTS + "time.sleep(1000)"
CRASHES = REPORTS + "os.kill(os.getpid(), signal.SIGSEGV)"
REFUSES = "sys.exit(3)"
DEAF = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); " + LIVES


def supervised(first: str, second: str, log: Path, ending_s: float = 20.0) -> "subprocess.Popen[bytes]":
    with log.open("ab") as output:
        return subprocess.Popen(
            [
                sys.executable,
                "-c",
                SUPERVISOR,
                first.format("first"),
                second.format("second"),
                str(ending_s),
            ],
            stdout=output,
            stderr=output,
        )


def pids(log: Path, name: str) -> list[int]:
    return [int(line.split()[1]) for line in log.read_text().splitlines() if line.startswith(name)]


def wait_until(condition) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_process_that_crashes_is_restarted_with_growing_pauses_and_the_other_lives(tmp_path):
    log = tmp_path / "log"
    supervisor = supervised(CRASHES, LIVES, log)
    wait_until(lambda: len(pids(log, "first")) >= 3)
    assert len(pids(log, "second")) == 1
    supervisor.terminate()
    assert supervisor.wait(PATIENCE_S) == 128 + signal.SIGTERM
    assert "is restarted in 1 s" in log.read_text()
    assert "is restarted in 2 s" in log.read_text()
    assert not Path(f"/proc/{pids(log, 'second')[0]}").exists()


def test_a_process_that_cannot_start_ends_the_service_with_its_exit_code(tmp_path):
    log = tmp_path / "log"
    supervisor = supervised(REFUSES, LIVES, log)
    assert supervisor.wait(PATIENCE_S) == 3
    assert "the first cannot start: exit code 3" in log.read_text()
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids(log, "second"))


def test_ctrl_c_ends_the_service_with_success(tmp_path):
    log = tmp_path / "log"
    supervisor = supervised(LIVES, LIVES, log)
    wait_until(lambda: pids(log, "first") and pids(log, "second"))
    supervisor.send_signal(signal.SIGINT)
    assert supervisor.wait(PATIENCE_S) == 0
    assert "stops" in log.read_text()


def test_a_second_signal_ends_a_process_that_does_not_listen(tmp_path):
    log = tmp_path / "log"
    supervisor = supervised(DEAF, LIVES, log, ending_s=10 * PATIENCE_S)
    wait_until(lambda: pids(log, "first"))
    supervisor.terminate()
    wait_until(lambda: "stops" in log.read_text())
    assert supervisor.poll() is None
    supervisor.terminate()
    assert supervisor.wait(PATIENCE_S) == 128 + signal.SIGTERM
    assert not Path(f"/proc/{pids(log, 'first')[0]}").exists()


def test_a_process_that_does_not_listen_is_killed_after_its_time(tmp_path):
    log = tmp_path / "log"
    supervisor = supervised(DEAF, LIVES, log, ending_s=1.0)
    wait_until(lambda: pids(log, "first"))
    supervisor.terminate()
    assert supervisor.wait(PATIENCE_S) == 128 + signal.SIGTERM


@pytest.mark.long
def test_the_supervisor_imports_neither_the_server_nor_the_science():
    program = (
        "import sys, amers.app.cli.serve;"
        "print(*{'fastapi', 'uvicorn', 'numpy', 'rasterio', 'sqlalchemy'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == ""


class Listener(nullcontext[None]):
    """Stands for a socket that listens on an address."""

    def __init__(self, host: str) -> None:
        super().__init__()
        self.host = host

    def getsockname(self) -> tuple[str, int]:
        return self.host, 8000

    def fileno(self) -> int:
        return 7


@pytest.mark.parametrize(
    ("hosts", "shown"),
    [(["127.0.0.1"], True), (["::1", "127.0.0.5"], True), (["127.0.0.1", "192.0.2.7"], False)],
)
def test_the_address_that_signs_in_is_shown_where_this_machine_alone_can_reach_it(
    hosts: list[str], shown: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The hosts are addresses that one name can have; the others must not find a session."""
    addresses: list[str] = []

    def signed_in(_: str, address: str) -> AbstractContextManager[str]:
        addresses.append(address)
        return nullcontext(address)

    monkeypatch.setenv("AMERS_DATA_FOLDER", str(tmp_path))
    monkeypatch.delenv("AMERS_DATABASE_URL", raising=False)
    monkeypatch.setattr(serve, "_listeners", lambda *_: list(map(Listener, hosts)))
    monkeypatch.setattr(serve, "ready_database", lambda _: nullcontext("a dsn"))
    monkeypatch.setattr(serve, "database_watched", lambda _: nullcontext())
    monkeypatch.setattr(serve.logs, "configure", lambda _: None)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setattr(serve.Supervisor, "run", lambda *_, **__: None)
    monkeypatch.setattr(local_access, "signed_in_address", signed_in)
    serve.serve()
    assert bool(addresses) == shown
