"""Signed tokens in the links to next pages: the last feature of the page before, and the total count."""

import base64
import hmac
import json

from amers.app.db.features.counts import Count
from amers.app.db.features.query import Key
from amers.app.errors import InvalidParameter


def format_token(last: Key, matched: Count, fingerprint: str, secret: bytes) -> str:
    """The token of the page after a feature.

    Args:
        last: key of the last feature of the page before: its values of the sort properties.
        matched: number of features on all pages.
        fingerprint: of the query and the caller; the token is valid for these alone.
        secret: of the installation.
    """
    packed = json.dumps([last, matched.number, matched.exact], separators=(",", ":")).encode()
    return base64.urlsafe_b64encode(_seal(packed, fingerprint, secret) + packed).decode()


def parse_token(token: str, fingerprint: str, secret: bytes) -> tuple[Key, Count]:
    """The key of the last feature before a page, and the number of features on all pages.

    Raises:
        InvalidParameter: the token was not issued for this query and caller.
    """
    try:
        raw = base64.b64decode(token.encode("ascii"), altchars=b"-_", validate=True)
    except ValueError:
        raw = b""
    seal, packed = raw[:16], raw[16:]
    if not hmac.compare_digest(seal, _seal(packed, fingerprint, secret)):
        raise InvalidParameter(
            f"token: {token!r:.100} does not belong to this query; follow the link `next` of its replies"
        )
    last, number, exact = json.loads(packed)
    return tuple(last), Count(number, exact)


def _seal(packed: bytes, fingerprint: str, secret: bytes) -> bytes:
    """The signature of a token for one query of one caller."""
    return hmac.digest(secret, fingerprint.encode() + packed, "sha256")[:16]
