"""Making, listing and revoking tokens."""

from collections.abc import Iterable
from dataclasses import dataclass

from app.auth import Scope, new_secret, secret_hash
from app.db import tokens
from app.db.engine import Connection
from app.db.tokens import Token
from app.errors import Conflict, InputError, NotFound

LONGEST_DAYS = 36_500
LONGEST_NAME = 200
LARGEST_QUOTA = {"upload_quota_bytes": 2**62, "job_quota": 1_000_000}


@dataclass(frozen=True)
class NewToken:
    """A token and its secret, which is shown once and kept nowhere."""

    token: Token
    secret: str


def create_token(
    connection: Connection,
    name: str,
    scopes: Iterable[str],
    days: int | None = None,
    upload_quota_bytes: int | None = None,
    job_quota: int | None = None,
) -> NewToken:
    """Make a token.

    Args:
        name: for people, need not be unique.
        scopes: one or more of `read`, `register`, `monitor`, `admin`.
        days: how long it is valid; None for ever.
        upload_quota_bytes, job_quota: what it may have at once; None: as much as the settings say.

    Raises:
        InputError: no name, an unknown scope or none, or a number that makes no sense.
    """
    if not 0 < len(name.strip()) <= LONGEST_NAME:
        raise InputError(f"the name of a token has 1 to {LONGEST_NAME} characters")
    if days is not None and not 1 <= days <= LONGEST_DAYS:
        raise InputError(f"a token is valid for 1 to {LONGEST_DAYS} days, {days} asked for")
    for field, quota in (("upload_quota_bytes", upload_quota_bytes), ("job_quota", job_quota)):
        if quota is not None and not 0 <= quota <= LARGEST_QUOTA[field]:
            raise InputError(f"{field}: {quota} found, 0 to {LARGEST_QUOTA[field]} expected")
    secret = new_secret()
    token = tokens.insert_token(
        connection,
        name.strip(),
        secret_hash(secret),
        _known(scopes),
        days,
        upload_quota_bytes,
        job_quota,
    )
    return NewToken(token, secret)


def list_tokens(connection: Connection) -> list[Token]:
    """All tokens, the newest first, revoked and expired ones too."""
    return tokens.list_tokens(connection)


def revoke_token(connection: Connection, name_or_id: str) -> Token:
    """Revoke the token with this id, or the only one with this name.

    Raises:
        NotFound: there is none that is not revoked yet.
        Conflict: several tokens have the name.
    """
    found = tokens.find_tokens(connection, name_or_id)
    if not found:
        raise NotFound(f"no valid token {name_or_id}")
    if len(found) > 1:
        ids = ", ".join(str(token.id) for token in found)
        raise Conflict(f"{len(found)} tokens are named {name_or_id}: revoke by id ({ids})")
    return tokens.revoke_token(connection, found[0].id)


def _known(scopes: Iterable[str]) -> tuple[str, ...]:
    asked = set(scopes)
    unknown = asked - set(Scope)
    if unknown or not asked:
        raise InputError(
            f"scopes are {', '.join(Scope)}; asked for: {', '.join(sorted(asked)) or 'none'}"
        )
    return tuple(str(scope) for scope in Scope if scope in asked)
