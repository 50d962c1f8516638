"""`amers serve`: the API and one worker, each a process that is restarted when it dies.

This process supervises: it has the private database, the listening sockets and the two processes. It
imports little and reads nothing that a caller sends. A crash of the API ends neither the worker nor the
connections that wait to be accepted.
"""

import errno
import ipaddress
import logging
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from amers.app import logs
from amers.app.cli.supervisor import Child, Supervisor
from amers.app.config import Settings, read_settings, use_folder
from amers.app.db.cluster import embedded
from amers.app.db.ready import ready_database
from amers.app.errors import InputError, PortInUse

BACKLOG = 2048
"""Connections that wait to be accepted, as while the API is restarted."""
API_ENDING_S = 45.0
"""Time to complete requests under way (30 s) and to close what the API has opened."""
WATCH_S = 2.0
WATCH_ENDING_S = 10.0
"""The watcher may be starting the database again; the end does not wait for it longer."""

log = logging.getLogger(__name__)


def serve(
    *,
    host: Annotated[str | None, typer.Option(help="Address to listen on; default AMERS_HOST.")] = None,
    port: Annotated[
        int | None, typer.Option(help="Port to listen on; default AMERS_PORT.", min=1, max=65535)
    ] = None,
    worker: Annotated[bool, typer.Option(help="Run a worker together with the API.")] = True,
    data: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            file_okay=False,
            help="Data folder with a private database and its files, instead of the settings.",
        ),
    ] = None,
) -> None:
    """Run the API and one worker until Ctrl-C.

    On a terminal, with a private database and a loopback address, the command prints an address that
    opens the map without a further sign-in. The address is valid until the command ends.
    """
    if data is not None:
        use_folder(data.resolve())
    settings = read_settings()
    logs.configure(settings)
    supervisor = Supervisor()
    with ExitStack() as stack:
        listeners = _listeners(host or settings.host, port or settings.port)
        close = stack.enter_context(ExitStack())
        for listener in listeners:
            close.enter_context(listener)
        database_url = stack.enter_context(ready_database(settings))
        # Its token belongs to the person at the terminal, not into a log.
        if settings.database_url is None and sys.stdout.isatty() and all(map(_is_loopback, listeners)):
            stack.enter_context(_shown_address(database_url, listeners[0]))
        with database_watched(settings):
            supervisor.run(_children(listeners, worker), at_stop=close.close)
    if supervisor.exit_code:
        raise typer.Exit(supervisor.exit_code)


def _is_loopback(listener: socket.socket) -> bool:
    return ipaddress.ip_address(listener.getsockname()[0]).is_loopback


@contextmanager
def _shown_address(database_url: str, listener: socket.socket) -> Iterator[None]:
    """The address that signs in, printed; it serves as long as the context."""
    from amers.app.usecases.local_access import signed_in_address  # only a private service needs it

    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    with signed_in_address(database_url, f"http://{shown}:{port}") as address:
        typer.echo(f"Map, signed in on this machine: {address}")
        yield


def _children(listeners: list[socket.socket], worker: bool) -> list[Child]:
    descriptors = tuple(listener.fileno() for listener in listeners)
    api = Child(
        "the API",
        "from amers.app.cli.api_process import run; run([int(text) for text in sys.argv[2:]])",
        ("api", *map(str, descriptors)),
        death_signal=signal.SIGKILL,
        descriptors=descriptors,
        ending_s=API_ENDING_S,
        must_start=True,
    )
    the_worker = Child("the worker", "from amers.app.cli.main import main; main()", ("worker",))
    return [api, the_worker] if worker else [api]


def _listeners(host: str, port: int) -> list[socket.socket]:
    """Sockets that listen on all addresses of a host.

    Raises:
        PortInUse: another program listens there.
        InputError: there is no such host, or the port is forbidden.
    """
    listeners: list[socket.socket] = []
    try:
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        for family, _, _, _, address in dict.fromkeys(places):
            listeners.append(socket.create_server(address[:2], family=family, backlog=BACKLOG))
    except OSError as error:
        for listener in listeners:
            listener.close()
        if error.errno == errno.EADDRINUSE:
            raise PortInUse(
                f"port {port} of {host} is in use by another program: end that program, or choose a "
                "free port with --port or AMERS_PORT"
            ) from None
        raise InputError(
            f"cannot listen on {host}, port {port} ({error.strerror}): choose an address of this "
            "machine with --host and a port that you may use with --port"
        ) from None
    return listeners


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
        watcher.join(WATCH_ENDING_S)
