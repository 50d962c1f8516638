"""Requests to a service; error replies raise."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

from .errors import RequestRefused, ServiceFailure

CHUNK_BYTES = 1 << 20


class Connection:
    """A pool of connections to one service."""

    def __init__(self, url: str, token: str, timeout_s: float) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._http = httpx.Client(base_url=url, headers=headers, timeout=timeout_s)

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        """The reply to a request.

        Raises:
            RequestRefused: the service refuses it.
            ServiceFailure: the service does not answer, or not as expected.
        """
        with self._failures():
            reply = self._http.request(method, path, **options)
            self._check(reply)
        return reply

    def download(self, path: str, target: Path) -> None:
        """Write the body of a reply into a file.

        Raises:
            RequestRefused: the service refuses the request.
            ServiceFailure: the service does not answer, or not as expected.
        """
        with self._failures(), self._http.stream("GET", path) as reply:
            if reply.is_error:
                reply.read()
            self._check(reply)
            with target.open("wb") as file:
                for chunk in reply.iter_bytes(CHUNK_BYTES):
                    file.write(chunk)

    @contextmanager
    def _failures(self) -> Iterator[None]:
        try:
            yield
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            reason = str(error) or type(error).__name__
            raise ServiceFailure(f"{self._http.base_url}: {reason}") from error

    def _check(self, reply: httpx.Response) -> None:
        if reply.is_success:
            return
        problem = _problem(reply)
        detail = problem.get("detail", f"{reply.status_code} {reply.reason_phrase}")
        if reply.is_client_error:
            message = f"{self._http.base_url}: {detail}"
            raise RequestRefused(message, reply.status_code, str(problem.get("error", "")))
        raise ServiceFailure(f"{self._http.base_url}: {reply.status_code} {detail}")


def _problem(reply: httpx.Response) -> dict[str, Any]:
    """The problem details of a reply; empty where it has none."""
    try:
        problem = reply.json()
    except ValueError:
        return {}
    return problem if isinstance(problem, dict) else {}
