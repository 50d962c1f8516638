"""Create, list and revoke tokens."""

from collections.abc import Iterable
from dataclasses import dataclass

from amers.app.auth import Scope, new_secret, secret_hash
from amers.app.db import tokens
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.errors import Conflict, InputError, NotFound

LONGEST_DAYS = 36_500
LONGEST_NAME = 200
LARGEST_QUOTA = {"storage_quota_bytes": 2**62, "job_quota": 1_000_000}


@dataclass(frozen=True)
class NewToken:
    """A token and its secret, which is shown once and not stored."""

    token: Token
    secret: str


def create_token(
    connection: Connection,
    name: str,
    scopes: Iterable[str],
    days: int | None = None,
    *,
    storage_quota_bytes: int | None = None,
    job_quota: int | None = None,
) -> NewToken:
    """Create a token whose name no other valid token has.

    Args:
        name: for people.
        scopes: one or more of `read`, `register`, `monitor`, `admin`.
        days: how long the token is valid; None without end.
        storage_quota_bytes, job_quota: the token's quotas; None for those of the settings.

    Raises:
        InputError: no name, an unknown scope or none, or a number out of range.
        Conflict: a valid token has this name.
    """
    name = name.strip()
    if not 0 < len(name) <= LONGEST_NAME:
        raise InputError(f"name: {len(name)} characters found, 1 to {LONGEST_NAME} expected")
    if days is not None and not 1 <= days <= LONGEST_DAYS:
        raise InputError(f"days: {days} found, 1 to {LONGEST_DAYS} expected")
    for field, quota in (("storage_quota_bytes", storage_quota_bytes), ("job_quota", job_quota)):
        if quota is not None and not 0 <= quota <= LARGEST_QUOTA[field]:
            raise InputError(f"{field}: {quota} found, 0 to {LARGEST_QUOTA[field]} expected")
    checked_scopes = _checked_scopes(scopes)
    _refuse_taken_name(connection, name)
    secret = new_secret()
    token = tokens.insert_token(
        connection,
        name=name,
        secret_hash=secret_hash(secret),
        scopes=checked_scopes,
        days=days,
        storage_quota_bytes=storage_quota_bytes,
        job_quota=job_quota,
    )
    return NewToken(token, secret)


def list_tokens(connection: Connection) -> list[Token]:
    """All tokens, the newest first, with the revoked and the expired ones."""
    return tokens.list_tokens(connection)


def revoke_token(connection: Connection, name_or_id: str) -> Token:
    """Revoke the token with this id, or the only valid one with this name.

    Raises:
        NotFound: no valid token has this id or name.
        Conflict: several tokens have the name.
    """
    matches = tokens.find_tokens(connection, name_or_id)
    if not matches:
        raise NotFound(f"no valid token {name_or_id}: `amers token list` lists names and ids")
    if len(matches) > 1:
        ids = ", ".join(str(token.id) for token in matches)
        raise Conflict(f"{len(matches)} tokens are named {name_or_id}: revoke by id ({ids})")
    return tokens.revoke_token(connection, matches[0].id)


def _refuse_taken_name(connection: Connection, name: str) -> None:
    """Refuse a name that a valid token has; until the end of the transaction nobody else takes it."""
    tokens.lock_names(connection)
    other = tokens.find_valid_name(connection, name)
    if other is not None:
        raise Conflict(
            f"name: the valid token {other.id} is named {other.name!r} already: choose another name, or "
            f"revoke that one first with `amers token revoke {other.id}`"
        )


def _checked_scopes(names: Iterable[str]) -> tuple[str, ...]:
    """The scopes of these names, in the order of `Scope`."""
    requested = set(names)
    if not requested or requested - set(Scope):
        raise InputError(
            f"scopes: {', '.join(sorted(requested)) or 'none'} found, "
            f"one or more of {', '.join(Scope)} expected"
        )
    return tuple(str(scope) for scope in Scope if scope in requested)
