"""The session of a browser: a signed cookie with the id of a token and the end of the session.

The cookie opens what the token may read, and nothing else: requests that change something need the token
itself, which no browser adds to them. So no page of another site can forge one. The cookie holds no
secret of the token, and ends with it: every request looks the token up. The service remembers the
sessions that were signed out until their hour is over.

Source: RFC 6265bis, cookies; OWASP, Cross-Site Request Forgery Prevention.
"""

import hmac
from dataclasses import dataclass
from datetime import UTC, datetime
from uuid import UUID, uuid4

from amers.app.errors import NotAllowed

COOKIE = "amers_session"
LIFETIME_S = 3600
ENDED_SESSION = "ended_session"
"""In the state of a request whose session serves no longer: the reply removes its cookie."""


@dataclass(frozen=True)
class Session:
    """A session of a browser.

    Attributes:
        id: of this session alone.
        token_id: what it was opened with.
        ends_at: after which it serves no longer.
    """

    id: UUID
    token_id: UUID
    ends_at: datetime


def format_session(token_id: UUID, now_s: float, secret: bytes) -> str:
    """The value of the cookie for a new session that begins now.

    Args:
        now_s: seconds since 1970.
        secret: of the installation.
    """
    content = f"{token_id}.{uuid4()}.{int(now_s) + LIFETIME_S}"
    return f"{content}.{_seal(content, secret)}"


def parse_session(value: str, now_s: float, secret: bytes) -> Session:
    """The session of a cookie.

    Raises:
        NotAllowed: this service did not make the cookie, or the session has ended.
    """
    content, _, seal = value.rpartition(".")
    if not hmac.compare_digest(seal.encode(), _seal(content, secret).encode()):
        raise _ended("the session cookie is not one of this service")
    try:
        token_id, session_id, end_s = content.split(".")
    except ValueError:
        raise _ended("the session cookie is that of an earlier version") from None
    if now_s >= int(end_s):
        raise _ended("the session has ended")
    return Session(UUID(session_id), UUID(token_id), datetime.fromtimestamp(int(end_s), UTC))


def removal(path: str) -> str:
    """The value of `Set-Cookie` that removes the cookie below a path."""
    return f'{COOKIE}=""; HttpOnly; Max-Age=0; Path={path}; SameSite=lax'


def _seal(content: str, secret: bytes) -> str:
    """The signature of a session; page tokens are signed with the same secret, under other names."""
    return hmac.digest(secret, f"session {content}".encode(), "sha256").hex()


def _ended(why: str) -> NotAllowed:
    return NotAllowed(f"{why}: sign in again on the page `sign-in`", authenticated=False)
