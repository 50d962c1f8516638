"""The table `token`: who may call, and how much. Secrets are never stored, only their SHA-256."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any
from uuid import UUID, uuid4

from app.db.engine import Connection

COLUMNS = "id, name, scopes, created_at, expires_at, revoked_at, subject, upload_quota_bytes, job_quota"


@dataclass(frozen=True)
class Token:
    """Somebody who may call: a bearer token without its secret, or an identity vouched for elsewhere.

    Attributes:
        scopes: some of `read`, `register`, `monitor`, `admin`.
        expires_at, revoked_at: None: never, not.
        subject: who it is at an OpenID Connect issuer; None for a token with a secret.
        upload_quota_bytes, job_quota: None: those of the settings.
    """

    id: UUID
    name: str
    scopes: tuple[str, ...]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    subject: str | None = None
    upload_quota_bytes: int | None = None
    job_quota: int | None = None


def insert_token(
    connection: Connection,
    name: str,
    secret_hash: bytes,
    scopes: tuple[str, ...],
    days: int | None,
    upload_quota_bytes: int | None = None,
    job_quota: int | None = None,
) -> Token:
    """Store a new token that expires after so many days, or never."""
    row = connection.execute(
        "insert into token (id, name, secret_hash, scopes, expires_at, upload_quota_bytes, job_quota)"
        f" values (%s, %s, %s, %s, now() + make_interval(days => %s), %s, %s) returning {COLUMNS}",
        [uuid4(), name, secret_hash, list(scopes), days, upload_quota_bytes, job_quota],
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


def find_subject(connection: Connection, subject: str) -> Token | None:
    """The row that stands for an identity vouched for elsewhere, revoked or not."""
    row = connection.execute(f"select {COLUMNS} from token where subject = %s", [subject]).fetchone()
    return _token(row) if row else None


def keep_subject(connection: Connection, subject: str, name: str, scopes: tuple[str, ...]) -> Token:
    """The row that stands for an identity vouched for elsewhere, made at its first call."""
    connection.execute(
        "insert into token (id, name, subject, scopes) values (%s, %s, %s, %s)"
        " on conflict (subject) do nothing",
        [uuid4(), name, subject, list(scopes)],
    )
    found = find_subject(connection, subject)
    assert found is not None
    return found


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


def lock_token(connection: Connection, token_id: UUID) -> None:
    """Make others who count what this token has wait until the end of the transaction."""
    connection.execute("select 1 from token where id = %s for no key update", [token_id])


def uploaded_bytes(connection: Connection, token_id: UUID) -> int:
    """Bytes that the scenes of a token take in the storage, and its uploads under way will take."""
    row = connection.execute(
        """select (select coalesce(sum(size_bytes), 0) from scene s
                   where owner = %(owner)s and state <> 'removed'
                       and not exists (select from upload u where u.scene_id = s.id
                                       and u.purpose = 'image' and u.finished_at is null))
                + (select coalesce(sum((beside.value->>'size_bytes')::bigint), 0)
                   from scene s, jsonb_each(s.models) beside
                   where owner = %(owner)s and state <> 'removed')
                + (select coalesce(sum(size_bytes), 0) from upload
                   where owner = %(owner)s and finished_at is null) as used""",
        {"owner": token_id},
    ).fetchone()
    assert row is not None
    return int(row["used"])


def open_jobs(connection: Connection, token_id: UUID) -> int:
    """How many jobs of a token have not ended."""
    row = connection.execute(
        "select count(*) as n from job where owner = %s and state in ('accepted', 'running')",
        [token_id],
    ).fetchone()
    assert row is not None
    return int(row["n"])


def _token(row: dict[str, Any]) -> Token:
    return Token(**{**row, "scopes": tuple(row["scopes"])})
