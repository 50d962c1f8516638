"""The table `token`: who may call, and how much. Secrets are never stored, only their SHA-256."""

from dataclasses import dataclass, replace
from datetime import datetime
from uuid import UUID, uuid4

from sqlalchemy import Text, and_, bindparam, cast, delete, exists, func, or_, select, update
from sqlalchemy.dialects.postgresql import insert

from amers.app.db.engine import Connection, driver
from amers.app.db.rows import columns_of, every, first, only
from amers.app.db.schema import ended_session, job, now, token
from amers.app.db.statements import HotStatement, hot


@dataclass(frozen=True)
class Token:
    """A caller: a bearer token without its secret, or an identity of an OpenID Connect issuer.

    Attributes:
        scopes: some of `read`, `register`, `monitor`, `admin`.
        expires_at, revoked_at: None: never, not.
        subject: the identity at the issuer; None for a token with a secret.
        storage_quota_bytes, job_quota: None: those of the settings.
    """

    id: UUID
    name: str
    scopes: tuple[str, ...]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    subject: str | None = None
    storage_quota_bytes: int | None = None
    job_quota: int | None = None


COLUMNS = columns_of(Token, token)
NAMES_LOCK = 0x616D657274
"""Advisory lock held while a token is created under a name of its own."""
_IS_VALID = and_(
    token.c.revoked_at.is_(None), or_(token.c.expires_at.is_(None), token.c.expires_at > now)
)
# Each request with a token begins with this one.
VALID_TOKEN = hot(select(*COLUMNS).where(token.c.secret_hash == bindparam("secret_hash"), _IS_VALID))
TOKEN_OF_SESSION = hot(
    select(*COLUMNS).where(
        token.c.id == bindparam("token_id"),
        token.c.secret_hash.is_not(None),
        _IS_VALID,
        ~exists().where(ended_session.c.id == bindparam("session_id")),
    )
)


def insert_token(
    connection: Connection,
    *,
    name: str,
    secret_hash: bytes,
    scopes: tuple[str, ...],
    days: int | None,
    storage_quota_bytes: int | None = None,
    job_quota: int | None = None,
) -> Token:
    """Store a new token that expires after so many days, or never."""
    statement = (
        insert(token)
        .values(
            id=uuid4(),
            name=name,
            secret_hash=secret_hash,
            scopes=scopes,
            expires_at=None if days is None else now + func.make_interval(0, 0, 0, days),
            storage_quota_bytes=storage_quota_bytes,
            job_quota=job_quota,
        )
        .returning(*COLUMNS)
    )
    return only(Token, connection.execute(statement))


def find_valid_token(connection: Connection, secret_hash: bytes) -> Token | None:
    """The token of a secret if it is neither expired nor revoked."""
    return _find_valid(connection, VALID_TOKEN, {"secret_hash": secret_hash})


def find_token_of_session(connection: Connection, token_id: UUID, session_id: UUID) -> Token | None:
    """The token of a session that was not signed out, if it is neither expired nor revoked."""
    values: dict[str, object] = {"token_id": token_id, "session_id": session_id}
    return _find_valid(connection, TOKEN_OF_SESSION, values)


def is_valid(connection: Connection, token_id: UUID) -> bool:
    """Whether a token is neither expired nor revoked now."""
    valid = select(token.c.id).where(token.c.id == token_id, _IS_VALID)
    return connection.scalar(valid) is not None


def end_session(connection: Connection, session_id: UUID, ends_at: datetime) -> None:
    """Refuse a session from now on; forgets those whose time is over."""
    connection.execute(delete(ended_session).where(ended_session.c.ends_at < now))
    ending = insert(ended_session).values(id=session_id, ends_at=ends_at)
    connection.execute(ending.on_conflict_do_nothing())


def _find_valid(
    connection: Connection, statement: HotStatement, values: dict[str, object]
) -> Token | None:
    row = driver(connection).execute(statement.sql, statement.parameters(values)).fetchone()
    if row is None:
        return None
    found = Token(*row)
    return replace(found, scopes=tuple(found.scopes))


def find_subject(connection: Connection, subject: str) -> Token | None:
    """The row of an identity of an OpenID Connect issuer, revoked or not."""
    return first(Token, connection.execute(select(*COLUMNS).where(token.c.subject == subject)))


def keep_subject(connection: Connection, subject: str, name: str, scopes: tuple[str, ...]) -> Token:
    """The row of an identity of an OpenID Connect issuer, inserted at its first call."""
    connection.execute(
        insert(token)
        .values(id=uuid4(), name=name, subject=subject, scopes=scopes)
        .on_conflict_do_nothing(index_elements=[token.c.subject])
    )
    return only(Token, connection.execute(select(*COLUMNS).where(token.c.subject == subject)))


def list_tokens(connection: Connection) -> list[Token]:
    """All tokens, the newest first."""
    statement = select(*COLUMNS).order_by(token.c.created_at.desc(), token.c.id)
    return every(Token, connection.execute(statement))


def find_tokens(connection: Connection, name_or_id: str) -> list[Token]:
    """The tokens not revoked yet that have this name, or the one with this id."""
    statement = (
        select(*COLUMNS)
        .where(
            token.c.revoked_at.is_(None),
            or_(token.c.name == name_or_id, cast(token.c.id, Text) == name_or_id),
        )
        .order_by(token.c.created_at)
    )
    return every(Token, connection.execute(statement))


def lock_names(connection: Connection) -> None:
    """Let nobody else create a token until the end of the transaction, so that names stay unique."""
    connection.execute(select(func.pg_advisory_xact_lock(NAMES_LOCK)))


def find_valid_name(connection: Connection, name: str) -> Token | None:
    """The token with a secret that has this name and is neither expired nor revoked."""
    statement = select(*COLUMNS).where(
        token.c.name == name,
        token.c.secret_hash.is_not(None),
        _IS_VALID,
    )
    return first(Token, connection.execute(statement.order_by(token.c.created_at).limit(1)))


def revoke_token(connection: Connection, token_id: UUID) -> Token:
    """Refuse a token from now on; a token revoked before keeps its date."""
    statement = (
        update(token)
        .where(token.c.id == token_id)
        .values(revoked_at=func.coalesce(token.c.revoked_at, now))
        .returning(*COLUMNS)
    )
    return only(Token, connection.execute(statement))


def find_token(connection: Connection, token_id: UUID) -> Token:
    """The token with that id."""
    return only(Token, connection.execute(select(*COLUMNS).where(token.c.id == token_id)))


def lock_token(connection: Connection, token_id: UUID) -> Token:
    """The token; others who count what it uses wait until the end of the transaction."""
    statement = select(*COLUMNS).where(token.c.id == token_id).with_for_update(key_share=True)
    return only(Token, connection.execute(statement))


def open_jobs(connection: Connection, token_id: UUID) -> int:
    """How many jobs of a token have not ended."""
    count = (
        select(func.count())
        .select_from(job)
        .where(job.c.owner == token_id, job.c.state.in_(("accepted", "running")))
    )
    return int(connection.execute(count).scalar_one())
