"""Requests to an Amers service by the network of QGIS: its proxies, certificates and authentication."""

from __future__ import annotations

import json
from typing import Any
from urllib.parse import quote

from qgis.core import QgsBlockingNetworkRequest
from qgis.PyQt.QtCore import QByteArray, QUrl
from qgis.PyQt.QtNetwork import QNetworkRequest


class ServiceError(Exception):
    """One sentence for the user: what the service, or the file sent to it, did not allow.

    Attributes:
        status: HTTP status of the reply; 0 without a reply.
    """

    def __init__(self, message: str, status: int = 0) -> None:
        super().__init__(message)
        self.status = status


class Service:
    """An Amers service. Its methods block: tasks call them, the main thread does not.

    Attributes:
        url: its address without a slash at the end.
        authcfg: id of the authentication configuration of QGIS that holds the token; "" for none.
    """

    def __init__(self, url: str, authcfg: str) -> None:
        self.url = url.rstrip("/")
        self.authcfg = authcfg

    def get(self, path: str) -> Any:
        """The JSON document at a path."""
        return json.loads(self.download(path))

    def download(self, path: str) -> bytes:
        """The content at a path."""
        call = self._call()
        return self._content(call, call.get(self._request(path)))

    def post(self, path: str, content: bytes, headers: dict[str, str]) -> dict[str, str]:
        """Send content; returns the headers of the reply by their names in lower case."""
        call = self._call()
        self._content(call, call.post(self._request(path, headers), QByteArray(content)))
        return _headers(call)

    def head(self, path: str, headers: dict[str, str]) -> dict[str, str]:
        """The headers of a reply without content, by their names in lower case."""
        call = self._call()
        self._content(call, call.head(self._request(path, headers)))
        return _headers(call)

    def put(self, path: str, content: bytes) -> Any:
        """Send a file; returns the JSON document of the reply."""
        call = self._call()
        return json.loads(self._content(call, call.put(self._request(path), QByteArray(content))))

    def execute(self, process: str, inputs: dict[str, Any]) -> dict[str, Any]:
        """Start a process of OGC API - Processes; returns the state of its job."""
        call, kind = self._call(), {"Content-Type": "application/json"}
        request = self._request(f"processes/{process}/execution", kind)
        content = json.dumps({"inputs": inputs}).encode()
        return json.loads(self._content(call, call.post(request, QByteArray(content))))

    def dismiss(self, job: str) -> None:
        """Dismiss a job."""
        call = self._call()
        self._content(call, call.deleteResource(self._request(f"jobs/{job}")))

    def _call(self) -> QgsBlockingNetworkRequest:
        call = QgsBlockingNetworkRequest()
        call.setAuthCfg(self.authcfg)
        return call

    def _request(self, path: str, headers: dict[str, str] | None = None) -> QNetworkRequest:
        request = QNetworkRequest(QUrl(f"{self.url}/{quote(path, safe='/?=&')}"))
        request.setAttribute(QNetworkRequest.CacheLoadControlAttribute, QNetworkRequest.AlwaysNetwork)
        # A service that sees a script asks for no password, which QGIS would ask its user for.
        for name, value in {"Sec-Fetch-Mode": "cors", **(headers or {})}.items():
            request.setRawHeader(name.encode(), value.encode())
        return request

    def _content(self, call: QgsBlockingNetworkRequest, outcome: int) -> bytes:
        """The content of a reply.

        Raises:
            ServiceError: the service refuses the request or does not answer.
        """
        reply = call.reply()
        content = bytes(reply.content())
        if outcome == QgsBlockingNetworkRequest.NoError:
            return content
        status = reply.attribute(QNetworkRequest.HttpStatusCodeAttribute) or 0
        raise ServiceError(f"{self.url}: {_detail(content) or call.errorMessage()}", status)


def _headers(call: QgsBlockingNetworkRequest) -> dict[str, str]:
    reply = call.reply()
    return {
        bytes(name).decode().lower(): bytes(reply.rawHeader(name)).decode()
        for name in reply.rawHeaderList()
    }


def _detail(content: bytes) -> str:
    """What the problem details of a reply (RFC 9457) say; "" where it has none."""
    try:
        return json.loads(content)["detail"]
    except (ValueError, KeyError, TypeError):
        return ""
