"""The table `token`: who may call. Secrets are never stored, only their SHA-256."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID, uuid4

from app.db.engine import Connection

COLUMNS = "id, name, scopes, created_at, expires_at, revoked_at"


@dataclass(frozen=True)
class Token:
    """A bearer token without its secret.

    Attributes:
        scopes: some of `read`, `register`, `admin`.
        expires_at, revoked_at: None: never, not.
    """

    id: UUID
    name: str
    scopes: tuple[str, ...]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None


def insert_token(
    connection: Connection, name: str, secret_hash: bytes, scopes: tuple[str, ...], days: int | None
) -> Token:
    """Store a new token that expires after so many days, or never."""
    row = connection.execute(
        "insert into token (id, name, secret_hash, scopes, expires_at)"
        f" values (%s, %s, %s, %s, now() + make_interval(days => %s)) returning {COLUMNS}",
        [uuid4(), name, secret_hash, list(scopes), days],
    ).fetchone()
    assert row is not None
    return _token(row)


def find_valid_token(connection: Connection, secret_hash: bytes) -> Token | None:
    """The token of a secret if it is neither expired nor revoked."""
    row = connection.execute(
        f"select {COLUMNS} from token where secret_hash = %s"
        " and revoked_at is null and (expires_at is null or expires_at > now())",
        [secret_hash],
    ).fetchone()
    return _token(row) if row else None


def list_tokens(connection: Connection) -> list[Token]:
    """All tokens, the newest first."""
    rows = connection.execute(f"select {COLUMNS} from token order by created_at desc, id").fetchall()
    return [_token(row) for row in rows]


def find_tokens(connection: Connection, name_or_id: str) -> list[Token]:
    """The tokens not revoked yet that have this name, or the one with this id."""
    rows = connection.execute(
        f"select {COLUMNS} from token where revoked_at is null and (name = %s or id::text = %s)"
        " order by created_at",
        [name_or_id, name_or_id],
    ).fetchall()
    return [_token(row) for row in rows]


def revoke_token(connection: Connection, token_id: UUID) -> Token:
    """Refuse a token from now on; a token revoked before keeps its date."""
    row = connection.execute(
        f"update token set revoked_at = coalesce(revoked_at, now()) where id = %s returning {COLUMNS}",
        [token_id],
    ).fetchone()
    assert row is not None
    return _token(row)


def _token(row: dict[str, Any]) -> Token:
    return Token(**{**row, "scopes": tuple(row["scopes"])})
