"""The log and the metrics of requests: each request has an id, a line in the log and a duration."""

import logging
import re
import time
from uuid import uuid4

from prometheus_client import CollectorRegistry, Histogram
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from amers.app.request_context import Origin, working_for

HEADER = b"x-request-id"
ACCEPTED_ID = re.compile(rb"[A-Za-z0-9._\-]{1,64}")
BUCKETS_S = (0.002, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 60.0)
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
LEFT = 499
"""Status, in log and metrics only, of a request whose caller left before it got a reply."""
NONE = "none"
"""Label of unknown paths and methods: requests for random names must not each make a time series."""

log = logging.getLogger("amers.requests")


class RequestMetrics:
    """The durations of requests by route, in the registry of one application."""

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
        """Record the duration of a request."""
        self._seconds.labels(method, route, str(status)).observe(seconds)


class RequestLog:
    """Gives each request an id and a context; logs its outcome and records its duration.

    Attributes:
        app: the application that gets the requests.
        metrics: durations of the requests.
    """

    def __init__(self, app: ASGIApp, metrics: RequestMetrics) -> None:
        self.app = app
        self.metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request; a valid `X-Request-ID` of the caller is kept as its id."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        sent = dict(scope["headers"]).get(HEADER, b"")
        request_id = sent if ACCEPTED_ID.fullmatch(sent) else uuid4().hex.encode()
        started = time.perf_counter()
        status, is_started = 500, False

        async def send_with_id(message: Message) -> None:
            nonlocal status, is_started
            if message["type"] == "http.response.start":
                status, is_started = message["status"], True
                headers = [*message.get("headers", ()), (HEADER, request_id)]
                message = {**message, "headers": headers}
            await send(message)

        origin = Origin(actor_name="anybody", request_id=request_id.decode())
        # The reply to an unexpected error is made outside of this middleware.
        scope.setdefault("state", {})["request_id"] = origin.request_id
        with working_for(origin):
            try:
                await self.app(scope, receive, send_with_id)
            except ClientDisconnect:
                if is_started:
                    raise
                status = LEFT
            except Exception:
                log.exception("%s %s failed", scope["method"], scope["path"])
                raise
            finally:
                self._record(scope, status, time.perf_counter() - started)

    def _record(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", NONE)
        method = scope["method"] if scope["method"] in METHODS else NONE
        self.metrics.observe(method, route, status, seconds)
        fields = {"status": status, "duration_ms": round(1000.0 * seconds, 1)}
        # Without the query: a filter may contain confidential values.
        log.info("%s %s", scope["method"], scope["path"], extra=fields)
