"""The process of the API: `amers serve` starts it, and starts it again when it dies."""

import gc
import logging
import socket
from importlib import import_module

import uvicorn

from amers.app import logs
from amers.app.api import connections
from amers.app.config import Settings, read_settings

DRAIN_SECONDS = 30
"""Time that requests under way have to finish when the service stops."""

log = logging.getLogger(__name__)


class _Server(uvicorn.Server):
    """A server that logs when it is ready on given sockets; uvicorn does so for its own only."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for listener in sockets or []:
            host, port = listener.getsockname()[:2]
            log.info("running on http://%s:%d", f"[{host}]" if ":" in host else host, port)


def run(descriptors: list[int]) -> None:
    """Serve the API until a signal.

    Args:
        descriptors: file descriptors of sockets that listen; they are closed at the signal.
    """
    settings = read_settings()
    logs.configure(settings)
    log_public_address(settings)
    # What is imported stays: a search for garbage in it finds none.
    gc.disable()
    application = import_module("amers.app.main").create_app
    gc.freeze()
    gc.enable()
    config = uvicorn.Config(
        application,
        factory=True,
        log_config=None,
        access_log=False,
        server_header=False,
        **connections.server_options(settings),
        timeout_graceful_shutdown=DRAIN_SECONDS,
    )
    _Server(config).run([socket.socket(fileno=number) for number in descriptors])


def log_public_address(settings: Settings) -> None:
    """Log the address of callers, and what is certainly missing for the proxy that has it."""
    if settings.public_url is None:
        return
    log.info("callers use %s", settings.public_url)
    if settings.public_url.startswith("https:") and not settings.trusted_proxies:
        log.warning(
            "AMERS_PUBLIC_URL has TLS, which a proxy gives, and AMERS_TRUSTED_PROXIES names none: all "
            "callers share the connections and turns of one; name the address of the proxy there"
        )
