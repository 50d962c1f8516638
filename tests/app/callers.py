"""Callers of the API: headers of a token, and the requests that are sent with them."""

from collections.abc import Callable, Iterable
from typing import Any

import httpx
from fastapi.testclient import TestClient

Bearer = Callable[[str], "Caller"]
"""Makes the caller with a scope."""


class Caller(dict[str, str]):
    """The headers of a caller; its methods send a request with them to the application of the test.

    It stands wherever headers do: `me | more` is the caller with further headers.
    """

    def __init__(self, client: Callable[[], TestClient], headers: dict[str, str]) -> None:
        super().__init__(headers)
        self._client = client

    def __or__(self, more: dict[str, str]) -> "Caller":  # type: ignore[override]
        return Caller(self._client, {**self, **more})

    def request(self, method: str, path: str, **more: Any) -> httpx.Response:
        """The reply to a request; the application starts with the first one."""
        return self._client().request(method, path, headers=dict(self), **more)

    def get(self, path: str, **more: Any) -> httpx.Response:  # type: ignore[override]
        return self.request("GET", path, **more)

    def head(self, path: str, **more: Any) -> httpx.Response:
        return self.request("HEAD", path, **more)

    def put(self, path: str, **more: Any) -> httpx.Response:
        return self.request("PUT", path, **more)

    def post(self, path: str, **more: Any) -> httpx.Response:
        return self.request("POST", path, **more)

    def patch(self, path: str, **more: Any) -> httpx.Response:
        return self.request("PATCH", path, **more)

    def delete(self, path: str, **more: Any) -> httpx.Response:
        return self.request("DELETE", path, **more)

    def execute(self, process: str, inputs: Any, **more: Any) -> httpx.Response:
        """The reply to the request for a process."""
        return self.post(f"/processes/{process}/execution", json={"inputs": inputs}, **more)

    def scene(self, content: bytes | Iterable[bytes], query: str = "name=scene.tif") -> str:
        """The id of an image that is sent in one request."""
        reply = self.post(f"/scenes?{query}", content=content)
        assert reply.status_code == 201, reply.text
        scene: str = reply.json()["id"]
        return scene
