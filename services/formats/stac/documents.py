"""JSON documents of a catalogue, from files, one server or one bucket, within limits of size and time.

A catalogue in files stays in files, and one on a server stays on that server: links that lead elsewhere
are not followed.
"""

import json
import os
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import unquote, urljoin, urlsplit

from amers.services.errors import FormatError
from amers.services.formats.addresses import SCHEMES, Address, without_query
from amers.services.formats.text_files import load_json

LARGEST_DOCUMENT_BYTES = 512_000_000
LARGEST_REPLY_BYTES = 64_000_000
TIMEOUT_S = 30.0
_MOST_REDIRECTS = 5
_TRY_AGAIN = (429, 500, 502, 503, 504)
"""Status of a server that has too much to do for a while."""
_MOST_TRIES = 5
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0
"""Pauses double; a server that names a longer one (Retry-After) gets it, up to the longest."""


def is_address(source: str) -> bool:
    """Whether a source is the address of a server or a bucket, not a path."""
    return source.partition("://")[0].lower() in SCHEMES


class Documents:
    """A reader of the documents of one catalogue; a context manager.

    Attributes:
        source: path or address of the catalogue.
    """

    def __init__(self, source: str, *, elsewhere: bool = False) -> None:
        """Read documents of one catalogue.

        Args:
            source: path or address of it.
            elsewhere: whether its links may lead to other servers: those of our own selections do.
        """
        self.source = source
        self._elsewhere = elsewhere
        self._client: Any = None
        if is_address(source) and not _in_bucket(source):
            import httpx  # imported here because only catalogues on servers need it

            self._client = httpx.Client(timeout=TIMEOUT_S, transport=httpx.HTTPTransport(retries=2))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._client is not None:
            self._client.close()

    def resolved(self, address: str, base: str) -> str:
        """The absolute form of an address in a document.

        Raises:
            FormatError: it leads away from the files or the server of the catalogue.
        """
        if is_address(base):
            absolute = absolute_address(address, base)
            if _origin(absolute) == _origin(self.source):
                return absolute
        elif self._elsewhere and is_address(address):
            return address
        elif not is_address(address) and urlsplit(address).scheme in ("", "file"):
            path = unquote(urlsplit(address).path if address.startswith("file:") else address)
            return _beside(base, path)
        raise FormatError(
            f"{without_query(base)}: {without_query(address):.200} leads away from the catalogue; links "
            "there are not read"
        )

    def read(self, address: str, body: dict[str, Any] | None = None) -> Any:
        """The JSON of a file or a reply.

        Args:
            address: absolute, as `resolved` gives it.
            body: of a POST; None makes a GET.

        Raises:
            FormatError: it cannot be read, or is no JSON, or exceeds the limits.
        """
        if is_address(address) and (self._client is None or _in_bucket(address)):
            place = Address(address)
            return load_json(
                place.read_bytes(LARGEST_REPLY_BYTES).decode("utf-8", "replace"), str(place)
            )
        if self._client is None:
            return load_json(_file_text(Path(address)), address)
        content = self._reply(address, body).decode("utf-8", "replace")
        return load_json(content, without_query(address))

    def _reply(self, address: str, body: dict[str, Any] | None) -> bytes:
        import httpx

        shown = without_query(address)
        request = self._client.build_request(
            "GET" if body is None else "POST",
            address,
            headers={"Accept": "application/geo+json, application/json"},
            json=body,
        )
        redirects = tries = 0
        try:
            while redirects < _MOST_REDIRECTS:
                reply = self._client.send(request, stream=True)
                if reply.status_code in _TRY_AGAIN and tries < _MOST_TRIES - 1:
                    reply.close()
                    time.sleep(_pause_s(reply.headers.get("Retry-After"), tries))
                    tries += 1
                    continue
                if not reply.has_redirect_location:
                    return _content(reply, shown)
                reply.close()
                request = reply.next_request
                self.resolved(str(request.url), address)
                redirects += 1
        except httpx.HTTPError as error:
            raise FormatError(f"{shown}: no reply ({error or type(error).__name__})") from None
        raise FormatError(f"{shown}: more than {_MOST_REDIRECTS} redirects")


def absolute_address(address: str, base: str) -> str:
    """The absolute form of an address in a document, wherever it leads."""
    if urlsplit(address).scheme:
        return address
    if _in_bucket(base):
        bucket, _, key = base.removeprefix("s3://").partition("/")
        return f"s3://{bucket}" + _beside(f"/{key}", unquote(address))
    return urljoin(base, address) if is_address(base) else _beside(base, unquote(address))


def _in_bucket(address: str) -> bool:
    return address.startswith("s3://")


def _beside(base: str, path: str) -> str:
    """The absolute form of a path in a file."""
    return os.path.abspath(os.path.join(os.path.dirname(base), path))


def json_bytes(value: Any) -> bytes:
    """One line of compact JSON."""
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False).encode() + b"\n"


def _pause_s(retry_after: str | None, tries: int) -> float:
    """Seconds until a request is sent again, after a number of tries."""
    pause_s = _FIRST_PAUSE_S * 2.0**tries
    if retry_after is not None and retry_after.strip().isdigit():
        pause_s = max(pause_s, float(retry_after))
    return min(pause_s, _LONGEST_PAUSE_S)


def _content(reply: Any, address: str) -> bytes:
    try:
        if reply.status_code != 200:
            raise FormatError(f"{address}: status {reply.status_code} found, 200 expected")
        content = bytearray()
        for piece in reply.iter_bytes():
            content += piece
            if len(content) > LARGEST_REPLY_BYTES:
                raise FormatError(f"{address}: reply of more than {LARGEST_REPLY_BYTES} bytes")
        return bytes(content)
    finally:
        reply.close()


def _file_text(path: Path) -> str:
    try:
        if not path.is_file() or path.stat().st_size > LARGEST_DOCUMENT_BYTES:
            raise FormatError(
                f"{path}: expected an existing file of at most {LARGEST_DOCUMENT_BYTES} bytes; larger "
                "catalogues are read as lines of items (.ndjson)"
            )
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise FormatError(f"{path}: expected text in UTF-8") from None


def _origin(address: str) -> tuple[str, str]:
    parts = urlsplit(address)
    return parts.scheme, parts.netloc
