"""Authentication and authorisation: tokens of 256 random bits with scopes."""

import hashlib
import secrets
from dataclasses import replace
from enum import StrEnum
from uuid import UUID

from amers.app.db.engine import Connection, Database
from amers.app.db.tokens import (
    Token,
    find_subject,
    find_token_of_session,
    find_valid_token,
    is_valid,
    keep_subject,
)
from amers.app.errors import NotAllowed
from amers.app.oidc import Identity

SECRET_BYTES = 32
INVALID_TOKEN = "the token is unknown, expired or revoked"
MISSING_TOKEN = (
    "this request needs a token: send the header `Authorization: Bearer TOKEN`, "
    "or Basic with the token as password; in a browser, sign in on the page `sign-in`"
)


class Scope(StrEnum):
    """What a token allows; `register` includes `read`, `admin` includes everything."""

    READ = "read"
    REGISTER = "register"
    MONITOR = "monitor"
    ADMIN = "admin"


INCLUDED = {
    Scope.READ: frozenset({Scope.READ}),
    Scope.REGISTER: frozenset({Scope.READ, Scope.REGISTER}),
    Scope.MONITOR: frozenset({Scope.MONITOR}),
    Scope.ADMIN: frozenset(Scope),
}


def new_secret() -> str:
    """A secret for a new token: 43 characters that need no quoting in a shell or a URL."""
    return secrets.token_urlsafe(SECRET_BYTES)


def secret_hash(secret: str) -> bytes:
    """The SHA-256 under which a secret is stored; 256 random bits need neither salt nor a slow hash."""
    return hashlib.sha256(secret.encode()).digest()


def authenticate(connection: Connection, secret: str) -> Token:
    """The token of a secret.

    Raises:
        NotAllowed: the secret is unknown, expired or revoked; the message is the same for all three.
    """
    token = find_valid_token(connection, secret_hash(secret))
    if token is None:
        raise NotAllowed(INVALID_TOKEN, authenticated=False)
    return token


def require_still_valid(database: Database, token: Token) -> None:
    """Refuse a caller whose token was good when the request began.

    Raises:
        NotAllowed: the token was revoked, or has expired.
    """
    with database.reading() as connection:
        if not is_valid(connection, token.id):
            raise NotAllowed(INVALID_TOKEN, authenticated=False)


def authenticate_session(connection: Connection, token_id: UUID, session_id: UUID) -> Token:
    """The token that a session was opened with.

    Raises:
        NotAllowed: the token is expired or revoked, or the session was signed out.
    """
    token = find_token_of_session(connection, token_id, session_id)
    if token is None:
        raise NotAllowed(INVALID_TOKEN, authenticated=False)
    return token


def authenticate_identity(database: Database, identity: Identity) -> Token:
    """The token row of an OpenID Connect identity, with the scopes that its issuer gives it now.

    Raises:
        NotAllowed: an administrator of this installation has revoked it.
    """
    with database.reading() as connection:
        token = find_subject(connection, identity.subject)
    if token is None:
        with database.transaction() as connection:
            token = keep_subject(connection, identity.subject, identity.name, identity.scopes)
    if token.revoked_at is not None:
        raise NotAllowed(INVALID_TOKEN, authenticated=False)
    return replace(token, scopes=identity.scopes)


def allows(token: Token, scope: Scope) -> bool:
    """Whether a token carries a scope or one that includes it."""
    return any(scope in INCLUDED[Scope(own)] for own in token.scopes)


def is_administrator(caller: Token | None) -> bool:
    """Whether a caller has the scope `admin`; None is a caller without a token."""
    return caller is not None and allows(caller, Scope.ADMIN)


def may_access(caller: Token, owner: UUID | None) -> bool:
    """Whether a caller may see and change what belongs to an owner: owners and administrators may."""
    return owner == caller.id or is_administrator(caller)


def owner_filter(caller: Token) -> UUID | None:
    """The owner whose records a caller may list; None, for administrators, lists the records of all."""
    return None if is_administrator(caller) else caller.id


def require_token(caller: Token | None) -> Token:
    """The token of a caller.

    Raises:
        NotAllowed: the caller sent none.
    """
    if caller is None:
        raise NotAllowed(MISSING_TOKEN, authenticated=False)
    return caller


def require(caller: Token | None, scope: Scope) -> Token:
    """The token of a caller who has a scope.

    Raises:
        NotAllowed: the caller sent no token, or its token lacks the scope.
    """
    token = require_token(caller)
    if not allows(token, scope):
        raise NotAllowed(
            f"this request needs scope {scope}; token {token.name} has {', '.join(token.scopes)}",
            authenticated=True,
        )
    return token
