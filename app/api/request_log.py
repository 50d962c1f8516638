"""Every request watched: its id, its line in the log, its place in the metrics."""

import logging
import re
import time
from uuid import uuid4

from prometheus_client import CollectorRegistry, Histogram
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.request_context import Origin, working_for

HEADER = b"x-request-id"
ACCEPTED_ID = re.compile(rb"[A-Za-z0-9._\-]{1,64}")
BUCKETS_S = (0.002, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 60.0)
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
NONE = "none"
"""For paths that lead nowhere and odd methods: whoever tries names must not make a series of each."""

log = logging.getLogger("amers.requests")


class RequestMetrics:
    """How long requests took, by route, in a registry of one application."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._seconds = Histogram(
            "amers_request_duration_seconds",
            "Time from the request to the last byte of its reply.",
            ("method", "route", "status"),
            buckets=BUCKETS_S,
            registry=self.registry,
        )

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request that has ended."""
        self._seconds.labels(method, route, str(status)).observe(seconds)


class Watch:
    """Gives each request an origin, and tells the log and the metrics how it ended.

    Attributes:
        app: what is watched.
        metrics: where durations are kept.
    """

    def __init__(self, app: ASGIApp, metrics: RequestMetrics) -> None:
        self.app = app
        self.metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request; an id that the caller sends is kept if it is one."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        sent = dict(scope["headers"]).get(HEADER, b"")
        request_id = sent if ACCEPTED_ID.fullmatch(sent) else uuid4().hex.encode()
        started = time.perf_counter()
        status = 500

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = [*message.get("headers", ()), (HEADER, request_id)]
                message = {**message, "headers": headers}
            await send(message)

        origin = Origin(actor_name="anybody", request_id=request_id.decode())
        # For the reply to an unexpected error, which is made outside of this.
        scope.setdefault("state", {})["request_id"] = origin.request_id
        with working_for(origin):
            try:
                await self.app(scope, receive, answer)
            except Exception:
                log.exception("%s %s broke off", scope["method"], scope["path"])
                raise
            finally:
                self._tell(scope, status, time.perf_counter() - started)

    def _tell(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", NONE)
        method = scope["method"] if scope["method"] in METHODS else NONE
        self.metrics.observe(method, route, status, seconds)
        fields = {"status": status, "duration_ms": round(1000.0 * seconds, 1)}
        # The path, not the query: a filter may hold what its sender would not want to be kept.
        log.info("%s %s", scope["method"], scope["path"], extra=fields)
