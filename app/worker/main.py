"""A worker: does the next job for each ticket that it takes from the queue, until a signal."""

import asyncio
import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import procrastinate
import psycopg

from amers.app.config import Settings
from amers.app.db import engine, session
from amers.app.db.engine import Database
from amers.app.db.jobs import queue
from amers.app.outages import NO_ANSWER, outage_of
from amers.app.storage import Storage, open_storage
from amers.app.usecases import storage_identity
from amers.app.worker.attempt import Attempts
from amers.app.worker.sweep import Sweeper
from amers.app.worker.warm_process import WarmServer

ENDING = (signal.SIGTERM, signal.SIGINT)
LONGEST_POLL_S = 5.0
"""Longest time until a delayed ticket is found; new tickets notify the workers."""
PAUSE_S = 2.0
"""Pause before the queue is read again after an outage of the database."""
ENDING_S = 60.0
"""A worker that is still there so long after its signal ends at once, whatever its threads wait for."""

QUEUE_ERRORS = (procrastinate.exceptions.ConnectorException, psycopg.Error)

log = logging.getLogger(__name__)


def run_worker(settings: Settings) -> None:
    """Do jobs until SIGTERM or SIGINT; a job under way then goes back to the queue.

    Signals set a flag from the start. An exception raised in the middle of the start-up could be lost
    there, and the worker would run on.
    """
    stop = threading.Event()
    for number in ENDING:
        signal.signal(number, lambda *_: stop.set())
    threading.Thread(target=_end_at_last, args=(stop, ENDING_S), name="ending", daemon=True).start()
    storage = open_storage(settings)
    with (
        engine.opened(settings) as database,
        WarmServer(_installation(settings, database)) as processes,
        _sweeping(database, storage, settings, stop),
    ):
        while not stop.is_set() and not storage_identity.announce(database.transaction, storage):
            stop.wait(storage_identity.RETRY_S)
        loop = asyncio.new_event_loop()
        # Not asyncio.run: it waits for ever when a task of the queue swallows its cancellation.
        loop.run_until_complete(_Worker(database, processes, settings, stop).run())


def _installation(settings: Settings, database: Database) -> dict[str, str]:
    """Variables with the places of the files and of the database that this worker keeps running."""
    ingest = settings.ingest_folder
    return {
        "AMERS_DATABASE_URL": database.dsn,
        "AMERS_DATA_FOLDER": str(settings.data_folder),
        **({} if ingest is None else {"AMERS_INGEST_FOLDER": str(ingest)}),
    }


def _end_at_last(stop: threading.Event, seconds: float) -> None:
    """End this process some time after its signal: a silent disk or server may hold its threads.

    The lease of its job expires, and another worker takes the job over.
    """
    stop.wait()
    time.sleep(seconds)
    log.error("this worker has not ended within %g s of its signal and is ended", seconds)
    os._exit(1)


@contextmanager
def _sweeping(
    database: Database, storage: Storage, settings: Settings, stop: threading.Event
) -> Iterator[None]:
    sweeper = threading.Thread(target=Sweeper(database, storage, settings, stop).run, name="sweeper")
    sweeper.start()
    try:
        yield
    finally:
        stop.set()
        sweeper.join()


def _log_left_error(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log the error of a task that nobody waits for: an outage of the queue in one sentence."""
    error = context.get("exception")
    if isinstance(error, QUEUE_ERRORS):
        # A ticket stays as taken; what became of its job was written by another connection.
        log.warning("the queue cannot be written: %s", (outage_of(error) or NO_ANSWER).reason)
    else:
        loop.default_exception_handler(context)


@dataclass
class _Worker:
    database: Database
    processes: WarmServer
    settings: Settings
    stop: threading.Event
    name: str = field(default_factory=lambda: f"{socket.gethostname()}:{os.getpid()}")

    async def run(self) -> None:
        """Fetch and do jobs until a signal; an outage of the database does not end the worker."""
        rounds = asyncio.create_task(self._rounds())
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(_log_left_error)
        for number in ENDING:
            loop.add_signal_handler(number, self._stop, rounds)
        try:
            await rounds
        except asyncio.CancelledError:
            log.info("worker %s stopped", self.name)

    def _stop(self, rounds: "asyncio.Task[None]") -> None:
        self.stop.set()
        rounds.cancel()

    async def _rounds(self) -> None:
        while not self.stop.is_set():
            try:
                await self._work()
            except QUEUE_ERRORS as error:
                log.warning("the queue cannot be read: %s", (outage_of(error) or NO_ANSWER).reason)
            await asyncio.sleep(PAUSE_S)

    async def _work(self) -> None:
        dsn = self.database.dsn

        async def begin(connection: psycopg.AsyncConnection) -> None:
            await asyncio.to_thread(session.begin, connection.pgconn, dsn)

        connector = procrastinate.PsycopgConnector(conninfo=session.patient(dsn), configure=begin)
        app = procrastinate.App(connector=connector)
        attempts = Attempts(self.database, self.processes, self.settings, self.name, self.stop.is_set)

        @app.task(name=queue.TASK, queue=queue.QUEUE)
        def do_next_job() -> None:
            try:
                attempts.do_next_job()
            except Exception as error:
                if (outage := outage_of(error)) is None:
                    raise
                # The sweep takes the job back and calls a worker again.
                log.warning("a job was left alone: %s", outage.reason)

        async with app.open_async():
            log.info("worker %s waits for jobs", self.name)
            await app.run_worker_async(
                queues=[queue.QUEUE],
                name=self.name,
                delete_jobs="always",
                fetch_job_polling_interval=min(self.settings.lease_seconds, LONGEST_POLL_S),
                install_signal_handlers=False,
            )
