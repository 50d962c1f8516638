"""`amers serve`: the API and one worker."""

import logging
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer
import uvicorn

from app import logs
from app.config import Settings, read_settings
from app.db import engine
from app.db.cluster import embedded

WORKER = """
import ctypes, os, signal, sys
from app.cli.main import main
ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG: end when the parent is killed
if os.getppid() == int(sys.argv.pop()):
    main()
"""
FIRST_PAUSE_S = 1.0
LONGEST_PAUSE_S = 60.0
STOP_SECONDS = 20.0
DRAIN_SECONDS = 30
"""Requests under way when the service is told to end have so long to be answered."""
WATCH_S = 2.0

log = logging.getLogger(__name__)


def serve(
    host: Annotated[str | None, typer.Option(help="Where to listen; AMERS_HOST if not given.")] = None,
    port: Annotated[int | None, typer.Option(help="Where to listen; AMERS_PORT if not given.")] = None,
    worker: Annotated[bool, typer.Option(help="Run a worker beside the API.")] = True,
) -> None:
    """Run the API and one worker, until Ctrl-C."""
    settings = read_settings()
    logs.configure(settings)
    with embedded.database(settings) as dsn:
        engine.ensure_schema(dsn, upgradable=settings.database_url is None)
        command = (sys.executable, "-c", WORKER, "worker", str(os.getpid()))
        with watched(settings), companion(command if worker else None):
            uvicorn.run(
                "app.main:create_app",
                factory=True,
                host=host or settings.host,
                port=port or settings.port,
                log_config=None,
                access_log=False,
                server_header=False,
                timeout_graceful_shutdown=DRAIN_SECONDS,
            )


@contextmanager
def watched(settings: Settings) -> Iterator[None]:
    """Starts the private database again whenever it was killed."""
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(WATCH_S):
            try:
                embedded.revive(settings)
            except Exception as error:
                log.error("the database could not be started again: %s", error)

    watcher = threading.Thread(target=watch, name="database-watcher", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        stop.set()
        watcher.join()


@contextmanager
def companion(command: tuple[str, ...] | None) -> Iterator[None]:
    """Run a command beside this one: started again when it dies, stopped at the end of the context."""
    if command is None:
        yield
        return
    stop = threading.Event()
    keeper = threading.Thread(
        target=_keep_running, args=(command, stop), name="worker-keeper", daemon=True
    )
    keeper.start()
    try:
        yield
    finally:
        stop.set()
        keeper.join()


def _keep_running(command: tuple[str, ...], stop: threading.Event) -> None:
    """A command that dies at once, again and again, is started less and less often."""
    pause_s = FIRST_PAUSE_S
    while not stop.is_set():
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        lived_s = _wait(process, stop)
        if stop.is_set():
            break
        pause_s = FIRST_PAUSE_S if lived_s > LONGEST_PAUSE_S else min(2 * pause_s, LONGEST_PAUSE_S)
        log.error("the worker ended (%d), next one in %.0f s", process.returncode, pause_s)
        stop.wait(pause_s)


def _wait(process: "subprocess.Popen[bytes]", stop: threading.Event) -> float:
    """Wait for the process to end, or end it when asked to; returns the seconds it lived, at least."""
    lived_s = 0.0
    while process.poll() is None and not stop.wait(0.2):
        lived_s += 0.2
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    return lived_s
