"""Conditions of requests: what a client has already is not sent again.

A reply that states an `ETag` or `Last-Modified` needs nothing else: its route compares them with the
conditions of the request. Only an endpoint whose content is expensive asks earlier, by `if_held`.

Source: RFC 9110, sections 8.8.3, 13.1 and 13.2.2.
"""

import hashlib
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

from fastapi import Request, Response
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException

CONDITIONS = (b"if-match", b"if-none-match", b"if-modified-since", b"if-unmodified-since")
TAG = re.compile(r'(?:W/)?"[^"]*"')
ANY = "*"
DESCRIBED = (200, 206, 416)
"""Statuses of replies about a content that there is: a range of it is chosen after the conditions."""
OF_THE_BODY = frozenset(
    (
        b"accept-ranges",
        b"content-disposition",
        b"content-encoding",
        b"content-length",
        b"content-range",
        b"content-type",
    )
)
"""Headers that describe a body, which a reply with status 304 does not have."""


def tag_of(content: bytes) -> str:
    """The strong tag of a content, as `ETag` has it."""
    return f'"{hashlib.sha256(content).hexdigest()[:32]}"'


def if_held(request: Request, headers: Mapping[str, str]) -> Response | None:
    """The reply 304 to a client that has the content with these headers already; None for others."""
    if not _is_held(request.headers, Headers(headers)):
        return None
    return Response(status_code=304, headers=headers)


def is_conditional(request: Request) -> bool:
    """Whether a request has conditions."""
    return any(name in CONDITIONS for name, _ in request.scope["headers"])


def answer_conditions(request: Request, response: Response) -> Response:
    """The reply itself, or 304 to a client that reads what it has already.

    Raises:
        HTTPException: the client wants another content than there is (412).
    """
    reads = request.method == "GET" and response.status_code in DESCRIBED
    if not reads or not is_conditional(request):
        return response
    _refuse_other(request.headers, response.headers)
    if not _is_held(request.headers, response.headers):
        return response
    reply = Response(status_code=304, background=response.background)
    reply.raw_headers = [item for item in response.raw_headers if item[0] not in OF_THE_BODY]
    return reply


def refuse_change(request: Request, current: Mapping[str, str] | None) -> None:
    """Refuse a request that replaces a content on conditions which do not hold.

    Args:
        current: the headers `ETag` and `Last-Modified` of the content there is; None: there is none.

    Raises:
        HTTPException: the content is another one than the client expects (412).
    """
    sent, tags = request.headers, _tags(request.headers, "if-none-match")
    if current is None:
        if "if-match" in sent:
            raise _failed("If-Match", "there is nothing yet")
        return
    _refuse_other(sent, Headers(current))
    if tags and (ANY in tags or _opaque(current["ETag"]) in map(_opaque, tags)):
        raise _failed("If-None-Match", f"there is a content already, {current['ETag']}")


def may_send_range(sent: Headers, described: Mapping[str, str]) -> bool:
    """Whether the condition `If-Range`, if there is one, allows to send a range of a content.

    A weak tag never does, and a date only where it is that of the content.
    """
    condition = sent.get("if-range")
    return condition is None or condition in (described["ETag"], described["Last-Modified"])


def _refuse_other(sent: Headers, described: Headers) -> None:
    tag = described.get("etag")
    wanted = _tags(sent, "if-match")
    if wanted:
        # Compared strongly: a weak tag never matches.
        if ANY not in wanted and (tag is None or tag.startswith("W/") or tag not in wanted):
            raise _failed("If-Match", f"the content there is has {tag or 'no tag'}")
        return
    limit, modified = _date(sent, "if-unmodified-since"), _date(described, "last-modified")
    if limit is not None and modified is not None and modified > limit:
        raise _failed("If-Unmodified-Since", f"the content is of {described['last-modified']}")


def _is_held(sent: Headers, described: Headers) -> bool:
    tags = _tags(sent, "if-none-match")
    if tags:
        tag = described.get("etag")
        return ANY in tags or (tag is not None and _opaque(tag) in map(_opaque, tags))
    since, modified = _date(sent, "if-modified-since"), _date(described, "last-modified")
    return since is not None and modified is not None and modified <= since


def _tags(headers: Headers, name: str) -> list[str]:
    """The tags of a header that has a list of them, or `*`; empty without the header."""
    values = headers.getlist(name)
    return [ANY] if [value.strip() for value in values] == [ANY] else _found(values)


def _found(values: list[str]) -> list[str]:
    # A value without any tag is a tag that nothing has.
    return [tag for value in values for tag in TAG.findall(value) or [value]]


def _opaque(tag: str) -> str:
    """A tag without the mark of a weak one, which a proxy adds when it compresses the content."""
    return tag.removeprefix("W/")


def _date(headers: Headers, name: str) -> datetime | None:
    """The date of a header; None without one, and for what is no date, as the standard demands."""
    try:
        date = parsedate_to_datetime(headers.get(name, ""))
    except (ValueError, OverflowError):
        return None
    return date if date.tzinfo is not None else date.replace(tzinfo=UTC)


def _failed(condition: str, why: str) -> HTTPException:
    return HTTPException(412, f"{condition} does not hold: {why}")
