"""Processes forked by a warm server: what they inherit, and that they and the server end together."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from amers.app.worker.warm_process import WarmProcess, WarmServer
from tests.app.worker_processes import alive, kill, wait_until

pytestmark = [pytest.mark.long, pytest.mark.thorough]

PATIENCE_S = 120.0
HERE = {"PYTHONPATH": os.getcwd()}
"""Where these processes find the functions of tests: not in the working folder by themselves."""
FUNCTIONS = "tests.app.warm_functions"
LONELY = """
import os, sys, time
from amers.app.worker.warm_process import WarmServer
server = WarmServer({"PYTHONPATH": os.getcwd()})
process = server.start("tests.app.warm_functions:sleep_with_a_child", [sys.argv[1]], {})
time.sleep(600)
"""
"""A parent of a server that never ends by itself."""


@pytest.fixture(scope="module")
def server() -> Iterator[WarmServer]:
    with WarmServer(HERE) as running:
        yield running


def run(server: WarmServer, name: str, *arguments: str, **environment: str) -> int:
    """The exit code of a function in a warm process."""
    process = server.start(f"{FUNCTIONS}:{name}", arguments, environment)
    try:
        code = process.wait(PATIENCE_S)
    finally:
        process.close()
    assert code is not None
    return code


def started(process: WarmProcess, file: Path) -> tuple[int, int]:
    """The numbers of a sleeping process and its child."""
    wait_until(file.exists, "the process has started a child")
    pid, child = map(int, file.read_text().split())
    assert process.wait(0.0) is None
    return pid, child


@pytest.mark.parametrize("code", [0, 1, 77, 78])
def test_a_process_ends_with_its_code(server: WarmServer, code: int) -> None:
    assert run(server, "end_with", str(code)) == code


def test_an_error_is_printed_and_ends_the_process_alone(
    server: WarmServer, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(server, "fail", "the reason") == 1
    assert run(server, "end_with", "0") == 0


def test_a_process_has_its_own_session_folder_variables_and_random_numbers(
    server: WarmServer, tmp_path: Path
) -> None:
    facts = []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        file = tmp_path / f"{name}.json"
        variables = {"TMPDIR": str(tmp_path / name), "AMERS_TEST_VARIABLE": name}
        assert run(server, "describe", str(file), **variables) == 0
        facts.append(json.loads(file.read_text()))
        assert facts[-1]["temporary"] == str(tmp_path / name)
        assert facts[-1]["variable"] == name
        assert facts[-1]["session"]
        assert facts[-1]["group"]
    assert facts[0]["random"] != facts[1]["random"]


def test_a_process_inherits_loaded_kernels_but_no_thread_and_no_socket(
    server: WarmServer, tmp_path: Path
) -> None:
    assert run(server, "describe", str(tmp_path / "facts")) == 0
    facts = json.loads((tmp_path / "facts").read_text())
    assert facts["kernels_loaded"]
    assert facts["threads"] == 1
    assert facts["sockets"] == 0
    assert "/dev/null" in facts["descriptors"]


def test_closing_a_process_kills_it_with_all_it_started(server: WarmServer, tmp_path: Path) -> None:
    process = server.start(f"{FUNCTIONS}:sleep_with_a_child", [str(tmp_path / "pids")], {})
    pids = started(process, tmp_path / "pids")
    process.close()
    assert not any(map(alive, pids))


def test_what_a_process_leaves_behind_is_killed_when_it_ends(server: WarmServer, tmp_path: Path) -> None:
    assert run(server, "leave_a_child", str(tmp_path / "pid")) == 0
    wait_until(lambda: not alive(int((tmp_path / "pid").read_text())), "the child is killed", 5.0)


def test_a_killed_process_has_the_code_of_its_signal_and_others_go_on(
    server: WarmServer, tmp_path: Path
) -> None:
    files = [tmp_path / "first", tmp_path / "second"]
    first, second = (server.start(f"{FUNCTIONS}:sleep_with_a_child", [str(f)], {}) for f in files)
    pid, _ = started(first, files[0])
    started(second, files[1])
    kill(pid)
    assert first.wait(5.0) == -signal.SIGKILL
    assert second.wait(0.5) is None
    first.close()
    second.close()


def test_a_killed_server_takes_its_processes_along_and_the_next_one_gets_a_new_server(
    tmp_path: Path,
) -> None:
    with WarmServer(HERE) as server:
        process = server.start(f"{FUNCTIONS}:sleep_with_a_child", [str(tmp_path / "pids")], {})
        pid, _ = started(process, tmp_path / "pids")
        assert server.pid is not None
        kill(server.pid)
        assert process.wait(5.0) == -signal.SIGKILL
        wait_until(lambda: not alive(pid), "the process dies with its server", 5.0)
        process.close()
        assert run(server, "end_with", "7") == 7


def test_a_process_that_is_closed_while_the_server_loads_never_starts(tmp_path: Path) -> None:
    with WarmServer(HERE) as server:
        process = server.start(f"{FUNCTIONS}:describe", [str(tmp_path / "facts")], {})
        began = time.monotonic()
        process.close()
        a_short_lease_s = 2.0
        assert time.monotonic() - began < a_short_lease_s
        assert run(server, "end_with", "5") == 5
    assert not (tmp_path / "facts").exists()


def test_a_killed_parent_takes_the_server_and_its_processes_along(tmp_path: Path) -> None:
    parent = subprocess.Popen([sys.executable, "-c", LONELY, str(tmp_path / "pids")])
    try:
        wait_until((tmp_path / "pids").exists, "the process has started a child", 60.0)
    finally:
        parent.kill()
        parent.wait()
    pids = [int(pid) for pid in (tmp_path / "pids").read_text().split()]
    wait_until(lambda: not any(map(alive, pids)), "all die with the parent", 5.0)


def test_a_server_that_cannot_load_says_why_and_delays_nobody(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rasterio.py").write_text("raise ImportError('no rasterio here')")
    variables = {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    with WarmServer(variables) as server:
        began = time.monotonic()
        assert run(server, "end_with", "0") == -signal.SIGKILL
        assert time.monotonic() - began < 60.0
    assert "no rasterio here" in capfd.readouterr().err
