"""A worker that receives a signal ends, whatever its queue still runs."""

import asyncio
import gc
import signal
import subprocess
import sys
from pathlib import Path

import psycopg
import pytest

from amers.app.config import Settings
from amers.app.worker import main
from tests.app.worker_processes import wait_until
from tests.command_line import environment_of

PATIENCE_S = 60
STUBBORN = """
import asyncio, procrastinate
from amers.app.config import read_settings
from amers.app.worker.main import run_worker

run = procrastinate.App.run_worker_async

async def deaf():
    while True:
        try:
            await asyncio.sleep(3600)
        except asyncio.CancelledError:
            print("deaf", flush=True)

async def run_beside(self, **options):
    self.beside = asyncio.create_task(deaf())
    await asyncio.sleep(0)
    print("waits", flush=True)
    await run(self, **options)

procrastinate.App.run_worker_async = run_beside
run_worker(read_settings())
"""
"""A worker whose queue has a leftover task that ignores its cancellation."""


STUCK = """
import sys, threading
import amers.app.worker.main as main
from amers.app.config import read_settings
from amers.app.worker.sweep import Sweeper

def sweep(self):
    print("waits", flush=True)
    threading.Event().wait()

main.ENDING_S = 0.5
Sweeper.run = sweep
main.run_worker(read_settings())
"""
"""A worker whose sweeper waits for a disk that never answers."""


@pytest.mark.parametrize(("program", "code"), [(STUBBORN, 0), (STUCK, 1)])
def test_a_worker_ends_although_a_task_ignores_its_cancellation_or_a_thread_never_ends(
    settings: Settings, tmp_path: Path, program: str, code: int
) -> None:
    environment = environment_of(settings)
    told = tmp_path / "told"
    with told.open("wb") as output:
        worker = subprocess.Popen([sys.executable, "-c", program], env=environment, stdout=output)
    try:
        wait_until(lambda: "waits" in told.read_text(), "the worker waits for jobs")
        worker.send_signal(signal.SIGTERM)
        assert worker.wait(timeout=PATIENCE_S) == code
    finally:
        worker.kill()
        worker.wait()


def test_an_error_of_the_queue_that_nobody_waits_for_is_one_sentence(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def fail(error: Exception) -> None:
        raise error

    async def leave(error: Exception) -> None:
        asyncio.get_running_loop().set_exception_handler(main._log_left_error)
        task = asyncio.create_task(fail(error))
        await asyncio.sleep(0)
        del task
        gc.collect()

    asyncio.run(leave(psycopg.OperationalError("server closed the connection unexpectedly")))
    assert [record.message for record in caplog.records] == [
        "the queue cannot be written: the connection to the database was lost"
    ]
    caplog.clear()
    asyncio.run(leave(ValueError("a defect")))
    assert [record.exc_info is not None for record in caplog.records] == [True]
