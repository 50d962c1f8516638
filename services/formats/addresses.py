"""Files in buckets and on servers, read by byte ranges; never for addresses of untrusted users.

GDAL has no network here: it asks a `RangeFile` for bytes, and sees neither addresses nor credentials.
"""

import io
import posixpath
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import unquote, urlsplit

import obstore
from obstore.exceptions import (
    BaseError,
    NotFoundError,
    NotSupportedError,
    PermissionDeniedError,
    UnauthenticatedError,
)
from obstore.store import HTTPStore, S3Store

from amers.services.errors import FormatError

SCHEMES = ("s3", "https", "http")
BLOCK_BYTES = 1 << 20
"""What a request takes at least: one of a bucket lasts about as long as the transfer of a megabyte."""
KEPT_BLOCKS = 64
"""Blocks that a process keeps: 64 MiB."""
_RETRY: Any = {"max_retries": 3, "retry_timeout": timedelta(seconds=20)}
_STORES = 256
_REFUSED = (PermissionDeniedError, UnauthenticatedError)
_ABSENT = (FileNotFoundError, NotFoundError)


@dataclass
class Traffic:
    """What this process has read at addresses.

    Attributes:
        bytes: of ranges of files.
    """

    bytes: int = 0


TRAFFIC = Traffic()


@dataclass(frozen=True)
class Address:
    """A file at `s3://BUCKET/KEY` or `https://…`, with what readers need of a path.

    Its text leaves out the query, where signed addresses have their credentials. The `AWS_…` variables
    of the process that reads set credentials, region and endpoint of buckets.

    Attributes:
        url: whole.
    """

    url: str = field(repr=False)

    def __post_init__(self) -> None:
        """Refuse addresses that cannot be read.

        Raises:
            FormatError: another scheme, no file, or credentials before the name of the server.
        """
        scheme, _, rest = self.url.partition("://")
        server, _, path = rest.partition("/")
        if "@" in server:
            raise FormatError(
                f"{scheme}://…@{server.rpartition('@')[2]}: a name or password before the server found, "
                "an address without them expected; set the AWS_… variables, or use a signed address"
            )
        if scheme not in SCHEMES or not server or not path:
            raise FormatError(f"{self}: s3://BUCKET/KEY or https://SERVER/FILE expected")

    def __str__(self) -> str:
        """The address without its query, for messages, reports and names."""
        return without_query(self.url)

    def __repr__(self) -> str:
        """As its text: logs of workers show the arguments of tasks."""
        return f"Address({str(self)!r})"

    @property
    def name(self) -> str:
        """The last part."""
        last = str(self).rpartition("/")[2]
        return last if self._is_key else unquote(last)

    @property
    def stem(self) -> str:
        """The last part without its suffix."""
        return posixpath.splitext(self.name)[0]

    @property
    def suffix(self) -> str:
        """The suffix of the last part, with its dot."""
        return posixpath.splitext(self.name)[1]

    def with_name(self, name: str) -> "Address":
        """The address of a file beside; a query stays."""
        start = str(self)
        return replace(self, url=start.rpartition("/")[0] + "/" + name + self.url[len(start) :])

    def is_file(self) -> bool:
        """Whether it can be read: servers that list nothing refuse what is not there.

        Raises:
            FormatError: the server does not answer.
        """
        store, key = self._store()
        try:
            with self._errors():
                obstore.head(store, key)
        except _AbsentError:
            return False
        return True

    def open(self) -> "RangeFile":
        """A reader of it.

        Raises:
            FormatError: nothing can be read there.
        """
        store, key = self._store()
        with self._errors():
            head = obstore.head(store, key)
        version = f"{head['e_tag']} {head['last_modified'].isoformat()}"
        return RangeFile(self, int(head["size"]), version)

    def read_bytes(self, most: int) -> bytes:
        """All of a small file.

        Raises:
            FormatError: it cannot be read, or is larger than `most`.
        """
        store, key = self._store()
        with self._errors():
            found = obstore.get(store, key)
            if found.meta["size"] <= most:
                return bytes(found.bytes())
        raise FormatError(f"{self}: {found.meta['size']} bytes found, at most {most} expected")

    def read_range(self, start: int, length: int) -> bytes:
        """Bytes of it.

        Raises:
            FormatError: they cannot be read.
        """
        store, key = self._store()
        with self._errors():
            content = bytes(obstore.get_range(store, key, start=start, length=length))
        TRAFFIC.bytes += len(content)
        if len(content) != length:
            raise FormatError(
                f"{self}: {len(content)} bytes from byte {start} on found, {length} expected: the file "
                "has changed; start again"
            )
        return content

    @property
    def _is_key(self) -> bool:
        """Whether "?", "#" and "%" mean themselves."""
        return self.url.startswith("s3://")

    def _store(self) -> tuple[Any, str]:
        if not self._is_key:
            return _server(self.url), ""
        bucket, _, key = self.url.removeprefix("s3://").partition("/")
        return _bucket(bucket), key

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Translate errors, whose own texts have the whole address, and more."""
        try:
            yield
        except _ABSENT:
            of_bucket = ", or region and endpoint of the bucket (AWS_REGION, AWS_ENDPOINT_URL)"
            raise _AbsentError(
                f"{self}: nothing found there, a file expected; correct the address"
                + (of_bucket if self._is_key else "")
            ) from None
        except _REFUSED:
            how = (
                "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY here and where workers run, or "
                "AWS_SKIP_SIGNATURE=true for a public bucket"
                if self._is_key
                else "a signed address may be too old: take it from the catalogue again"
            )
            raise AccessRefused(f"{self}: access refused, a readable file expected; {how}") from None
        except NotSupportedError:
            raise FormatError(
                f"{self}: the server sends no parts of files (range requests), which are expected; copy "
                "the file into a bucket or a shared folder"
            ) from None
        except (BaseError, ValueError) as error:
            host = urlsplit(self.url).hostname
            raise NoUsableReply(
                f"{self}: no usable reply ({type(error).__name__}), a file expected; check the network"
                + (", AWS_REGION and AWS_ENDPOINT_URL" if self._is_key else f" and the server {host}")
                + ", here and where workers run"
            ) from None


FilePlace = Path | Address
"""Where a file is."""


class NoUsableReply(FormatError):
    """A server does not answer, or not as expected, however often it is asked."""


class _AbsentError(FormatError):
    """Nothing can be read at an address, whose server answers."""


class AccessRefused(_AbsentError):
    """A server refuses a file, such as at a signed address whose time is over."""


def without_query(address: str) -> str:
    """An address as messages and reports show it: queries of servers have signatures and tokens."""
    is_server = address.partition("://")[0].lower() in ("http", "https")
    return address.partition("#")[0].partition("?")[0] if is_server else address


def file_place(text: str) -> FilePlace:
    """The address, or the path, that an operator or a catalogue states.

    Raises:
        FormatError: an address that cannot be read.
    """
    return Address(text) if text.partition("://")[0] in SCHEMES else Path(text)


def file_bytes(place: FilePlace) -> int:
    """The size of a file.

    Raises:
        FormatError: nothing can be read at the address.
        OSError: nor at the path.
    """
    return place.open().size if isinstance(place, Address) else place.stat().st_size


class RangeFile(io.RawIOBase):
    """A file at an address, read by blocks that all readers of a process share.

    Attributes:
        address: of the file.
        size: bytes.
        version: changes with the content.
    """

    def __init__(self, address: Address, size: int, version: str) -> None:
        """Begin at the start; see `Address.open`."""
        super().__init__()
        self.size = size
        self.version = version
        self.address = address
        self._at = 0

    def readable(self) -> bool:
        """True."""
        return True

    def seekable(self) -> bool:
        """True."""
        return True

    def tell(self) -> int:
        """Where the next byte is read."""
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place; returns it."""
        origin = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self.size}[whence]
        self._at = max(0, origin + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer as far as the file goes; returns the number of bytes.

        Raises:
            FormatError: they cannot be read.
        """
        length = max(0, min(len(buffer), self.size - self._at))
        if length == 0:
            return 0
        first = self._at // BLOCK_BYTES
        last = (self._at + length - 1) // BLOCK_BYTES
        content = b"".join(self._blocks(first, last))
        start = self._at - first * BLOCK_BYTES
        buffer[:length] = memoryview(content)[start : start + length]
        self._at += length
        return length

    def _blocks(self, first: int, last: int) -> list[bytes]:
        """Blocks that follow each other; those not in memory are read at once."""
        keys = [(self.address.url, self.version, number) for number in range(first, last + 1)]
        blocks = [_KEPT.get(key) for key in keys]
        missing = [first + i for i, block in enumerate(blocks) if block is None]
        if missing:
            start = missing[0] * BLOCK_BYTES
            end = min((missing[-1] + 1) * BLOCK_BYTES, self.size)
            content = self.address.read_range(start, end - start)
            for number in range(missing[0], missing[-1] + 1):
                begin = (number - missing[0]) * BLOCK_BYTES
                blocks[number - first] = content[begin : begin + BLOCK_BYTES]
                _KEPT.put(keys[number - first], content[begin : begin + BLOCK_BYTES])
        return [block for block in blocks if block is not None]


class _KeptBlocks:
    """The blocks that were used last."""

    def __init__(self) -> None:
        self._blocks: OrderedDict[tuple[str, str, int], bytes] = OrderedDict()
        self._lock = Lock()

    def get(self, key: tuple[str, str, int]) -> bytes | None:
        with self._lock:
            if key in self._blocks:
                self._blocks.move_to_end(key)
            return self._blocks.get(key)

    def put(self, key: tuple[str, str, int], block: bytes) -> None:
        with self._lock:
            self._blocks[key] = block
            if len(self._blocks) > KEPT_BLOCKS:
                self._blocks.popitem(last=False)


_KEPT = _KeptBlocks()


@lru_cache(maxsize=_STORES)
def _bucket(name: str) -> S3Store:
    # Plain HTTP is used only if AWS_ENDPOINT_URL begins with http://.
    return S3Store(name, client_options={"allow_http": True}, retry_config=_RETRY)


@lru_cache(maxsize=_STORES)
def _server(url: str) -> HTTPStore:
    # An https address is not followed to a plain one.
    plain = url.startswith("http://")
    return HTTPStore.from_url(url, client_options={"allow_http": plain}, retry_config=_RETRY)
