"""Credentials of a request: a token in the header Authorization, as bearer or as the password of Basic,
or the session of a browser.

A browser that has asked its user for a password sends it by itself with every later request, also with
those that pages of other sites cause, as it does with cookies. No browser does that with a bearer token.
So a request with Basic or with a session has to come from a program, from this service or from the user:
`refuse_other_sites`; and a session serves no request that changes something.

Source: RFC 6750, bearer tokens; RFC 7617, Basic; RFC 9110, section 11; W3C, Fetch Metadata Request
Headers.
"""

import binascii
from base64 import b64decode
from dataclasses import dataclass, field
from typing import Literal
from urllib.parse import urlsplit

from fastapi import Request
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException

from amers.app.api.session_cookie import COOKIE
from amers.app.errors import NotAllowed

BEARER: Literal["bearer"] = "bearer"
BASIC: Literal["basic"] = "basic"
BEARER_CHALLENGE = 'Bearer realm="amers"'
BASIC_CHALLENGE = 'Basic realm="amers", charset="UTF-8"'
EXPECTED = "expected `Bearer TOKEN`, or `Basic` with any user name and the token as password"
OWN_SITES = ("same-origin", "none")
"""Values of `Sec-Fetch-Site`: a page of this service; an address that the user has typed or kept."""
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
OTHER_SITE = (
    "this request comes from a page of another site, with a password or a session that the browser "
    "has kept: such a page sends the token as `Authorization: Bearer TOKEN`"
)


@dataclass(frozen=True)
class Credentials:
    """The token of a request.

    Attributes:
        scheme: how it was sent.
        secret: the token itself.
    """

    scheme: Literal["bearer", "basic"]
    secret: str = field(repr=False)


def credentials_of(headers: Headers) -> Credentials | None:
    """The credentials of a request; None without any.

    Raises:
        NotAllowed: they are malformed; the message never repeats them.
    """
    sent = headers.getlist("authorization")
    if not sent:
        return None
    if len(sent) > 1:
        raise _malformed(f"{len(sent)} Authorization headers found, one expected")
    scheme, _, value = sent[0].partition(" ")
    value = value.strip()
    if scheme.lower() not in (BEARER, BASIC):
        raise _malformed(f"the Authorization header has another scheme; {EXPECTED}")
    if not value:
        raise _malformed(f"the Authorization header is empty behind its scheme; {EXPECTED}")
    if scheme.lower() == BEARER:
        return Credentials(BEARER, value)
    return Credentials(BASIC, _password(value))


def refuse_other_sites(request: Request) -> None:
    """Refuse a request that a page of another site has made a browser send.

    Browsers state the site in `Sec-Fetch-Site`, older ones and those without TLS in `Origin` where the
    method changes something; programs send neither. Links of other sites to a page are followed. Images,
    frames and scripts of other sites get nothing: they would show what the user may see.

    Raises:
        HTTPException: the request comes from another site (403).
    """
    if _is_from_own_site(request.headers):
        return
    if request.method in SAFE_METHODS and _follows_link(request.headers):
        return
    raise HTTPException(403, OTHER_SITE)


def session_of(request: Request) -> str | None:
    """The session cookie of a request that only reads; None without one."""
    return request.cookies.get(COOKIE) if request.method in SAFE_METHODS else None


def browser_may_have_added(headers: Headers) -> bool:
    """Whether a request has credentials that a browser may have added by itself."""
    by_password = headers.get("authorization", "").lower().startswith(f"{BASIC} ")
    return by_password or f"{COOKIE}=" in headers.get("cookie", "")


def challenges(headers: Headers) -> list[str]:
    """The values of `WWW-Authenticate` in the reply to a request without valid credentials.

    At a challenge to Basic a browser asks its user for a password, also over a page whose script has
    made the request. So scripts, and callers who send bearer tokens, are asked for a bearer token only.
    """
    is_script = headers.get("sec-fetch-mode", "navigate") != "navigate"
    sends_bearer = headers.get("authorization", "").lower().startswith(f"{BEARER} ")
    return [BEARER_CHALLENGE] if is_script or sends_bearer else [BEARER_CHALLENGE, BASIC_CHALLENGE]


def _password(value: str) -> str:
    """The password in the value of a Basic header.

    Raises:
        NotAllowed: there is none.
    """
    try:
        user_and_password = b64decode(value, validate=True).decode()
    except UnicodeDecodeError:
        raise _malformed("user name and password of Basic are not in UTF-8") from None
    except (binascii.Error, ValueError):
        raise _malformed("the value of Basic is not Base64") from None
    _, colon, password = user_and_password.partition(":")
    if not colon:
        raise _malformed("there is no colon between user name and password of Basic")
    if not password.strip():
        raise _malformed("the password of Basic is empty: the token is the password, not the user name")
    return password.strip()


def _malformed(fault: str) -> NotAllowed:
    return NotAllowed(fault, authenticated=False)


def _is_from_own_site(headers: Headers) -> bool:
    site = headers.get("sec-fetch-site")
    if site is not None:
        return site in OWN_SITES
    origin = headers.get("origin")
    return origin is None or _host_of(origin) == headers.get("host", "").lower()


def _host_of(origin: str) -> str | None:
    """Host and port of an origin; a proxy may have changed the scheme. None: there is no host."""
    try:
        return urlsplit(origin).netloc.lower() or None
    except ValueError:
        return None


def _follows_link(headers: Headers) -> bool:
    return headers.get("sec-fetch-mode") == "navigate" and headers.get("sec-fetch-dest") == "document"
