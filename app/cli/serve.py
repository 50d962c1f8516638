"""`amers serve`: the API and one worker."""

import gc
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Annotated

import typer
import uvicorn

from app import logs
from app.api import connections
from app.config import Settings, read_settings
from app.db import revisions
from app.db.cluster import embedded

if TYPE_CHECKING:
    from fastapi import FastAPI

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
"""Time that requests under way have to finish when the service stops."""
WATCH_S = 2.0

log = logging.getLogger(__name__)


def serve(
    *,
    host: Annotated[str | None, typer.Option(help="Address to listen on; default AMERS_HOST.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; default AMERS_PORT.")] = None,
    worker: Annotated[bool, typer.Option(help="Run a worker beside the API.")] = True,
) -> None:
    """Run the API and one worker, until Ctrl-C."""
    settings = read_settings()
    logs.configure(settings)
    with embedded.database(settings) as dsn:
        revisions.ensure_schema(dsn, upgradable=settings.database_url is None)
        command = (sys.executable, "-c", WORKER, "worker", str(os.getpid()))
        with database_watched(settings), companion(command if worker else None):
            uvicorn.run(
                _application(),
                factory=True,
                host=host or settings.host,
                port=port or settings.port,
                log_config=None,
                access_log=False,
                server_header=False,
                **connections.server_options(settings),
                timeout_graceful_shutdown=DRAIN_SECONDS,
            )


def _application() -> "Callable[[], FastAPI]":
    """The factory of the application, imported without a search for garbage: what is imported stays."""
    gc.disable()
    create_app: Callable[[], FastAPI] = import_module("app.main").create_app
    gc.freeze()
    gc.enable()
    return create_app


@contextmanager
def database_watched(settings: Settings) -> Iterator[None]:
    """Restart the private database whenever it was killed, until the end of the context."""
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(WATCH_S):
            try:
                embedded.revive(settings)
            except Exception as error:
                log.error("the private database could not be restarted: %s", error)

    watcher = threading.Thread(target=watch, name="database-watcher", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        stop.set()
        watcher.join()


@contextmanager
def companion(command: tuple[str, ...] | None) -> Iterator[None]:
    """Run a command beside this one: restart it when it dies, stop it at the end of the context."""
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
    """Run a command until `stop`; the pause before a restart doubles when it dies soon."""
    pause_s = FIRST_PAUSE_S
    while not stop.is_set():
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
        lived_s = _wait(process, stop)
        if stop.is_set():
            break
        pause_s = FIRST_PAUSE_S if lived_s > LONGEST_PAUSE_S else min(2 * pause_s, LONGEST_PAUSE_S)
        log.error(
            "the worker ended with exit code %d and is restarted in %.0f s", process.returncode, pause_s
        )
        stop.wait(pause_s)


def _wait(process: "subprocess.Popen[bytes]", stop: threading.Event) -> float:
    """Wait until the process ends, or end it on `stop`; returns how many seconds it lived."""
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
