"""Code that lies in the working folder is data: no process of Amers executes it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from amers.app.child_processes import SAFE_PATH, leave_out_working_folder
from amers.app.cli.supervisor import Child
from amers.app.usecases.executors import ComputeOptions, open_executor
from amers.app.worker.warm_process import WarmServer
from tests.hostile_folder import executed, fill_with_modules

PATIENCE_S = 120.0


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file in which modules of the working folder report that they were imported."""
    for name in ("PYTHONPATH", *SAFE_PATH):
        monkeypatch.delenv(name, raising=False)
    marker = fill_with_modules(tmp_path / "delivery")
    monkeypatch.chdir(tmp_path / "delivery")
    return marker


def test_modules_of_the_folder_report_their_import(marker: Path) -> None:
    subprocess.run([sys.executable, "-c", "import numpy"], check=False, capture_output=True)
    assert "numpy" in executed(marker)


def test_a_supervised_process_leaves_the_working_folder_out(marker: Path) -> None:
    process = Child("child", "import json, numpy, amers.app.cli.serve, amers.services.errors").start()
    assert process.wait(PATIENCE_S) == 0
    assert executed(marker) == []


@pytest.mark.long
def test_a_warm_process_leaves_the_working_folder_out(marker: Path) -> None:
    with WarmServer({}) as server:
        process = server.start("builtins:len", list("12345"), {})
        assert process.wait(PATIENCE_S) == 5
        process.close()
    assert executed(marker) == []


@pytest.mark.long
def test_processes_of_a_pool_leave_the_working_folder_out(marker: Path) -> None:
    with open_executor(ComputeOptions(jobs=2)) as (pool, _):
        assert [pool.submit(abs, -number).result() for number in range(3)] == [0, 1, 2]
    assert executed(marker) == []


def test_numba_takes_no_folder_of_compiled_code_from_the_working_folder(marker: Path) -> None:
    """What it keeps there would be executed."""
    assert numba_folder() == str(Path.cwd())
    leave_out_working_folder()
    assert numba_folder() == ""


def numba_folder() -> str:
    program = "from numba.core import config; print(config.CACHE_DIR)"
    return subprocess.check_output([sys.executable, "-P", "-c", program], text=True).strip()


@pytest.mark.parametrize("path", [":/more", "/more:", "/more::/and/more"])
def test_an_empty_part_of_the_path_of_python_is_taken_out(
    path: str, marker: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", path)
    monkeypatch.setattr(sys, "path", [os.getcwd(), *sys.path])
    leave_out_working_folder()
    assert os.getcwd() not in sys.path
    child = [sys.executable, "-c", "import json, numpy"]
    subprocess.run(child, check=True, capture_output=True)
    assert executed(marker) == []
