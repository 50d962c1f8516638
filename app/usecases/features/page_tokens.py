"""Where the next page of an answer begins, signed, so that a link leads nowhere else."""

import base64
import hmac
import json

from app.db.features.counts import Count
from app.db.features.query import Key
from app.errors import InvalidParameter


def format_token(last: Key, matched: Count, fingerprint: str, secret: bytes) -> str:
    """The place after a feature in the answer to one question of one caller.

    Args:
        last: the values that order features, of the last one on the page before.
        matched: how many features all pages have.
        fingerprint: of the question and the caller.
        secret: of the installation.
    """
    packed = json.dumps([last, matched.number, matched.exact], separators=(",", ":")).encode()
    return base64.urlsafe_b64encode(_seal(packed, fingerprint, secret) + packed).decode()


def parse_token(token: str, fingerprint: str, secret: bytes) -> tuple[Key, Count]:
    """The place that a token means: the last feature before it, and how many features there are.

    Raises:
        InvalidParameter: it was not given for this question.
    """
    try:
        raw = base64.b64decode(token.encode("ascii"), altchars=b"-_", validate=True)
    except ValueError:
        raw = b""
    seal, packed = raw[:16], raw[16:]
    if not hmac.compare_digest(seal, _seal(packed, fingerprint, secret)):
        raise InvalidParameter(f"token: {token!r:.100} is not of this query; follow the link `next`")
    last, number, exact = json.loads(packed)
    return tuple(last), Count(number, exact)


def _seal(packed: bytes, fingerprint: str, secret: bytes) -> bytes:
    """Signs a place in the answer to one question of one caller."""
    return hmac.digest(secret, fingerprint.encode() + packed, "sha256")[:16]
