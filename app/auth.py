"""Who calls, and what he may do: bearer tokens of 256 random bits with scopes."""

import hashlib
import secrets
from dataclasses import replace
from enum import StrEnum

from app.db.engine import Connection, Database
from app.db.tokens import Token, find_subject, find_valid_token, keep_subject
from app.errors import NotAllowed
from app.oidc import Identity

SECRET_BYTES = 32


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
    """A secret for a new token, 43 characters that need no quoting anywhere."""
    return secrets.token_urlsafe(SECRET_BYTES)


def secret_hash(secret: str) -> bytes:
    """What is stored of a secret; 256 random bits need no salt and no slow hash."""
    return hashlib.sha256(secret.encode()).digest()


def authenticate(connection: Connection, secret: str) -> Token:
    """The token of a secret.

    Raises:
        NotAllowed: unknown, expired and revoked secrets get the same answer.
    """
    token = find_valid_token(connection, secret_hash(secret))
    if token is None:
        raise NotAllowed("the token is unknown, expired or revoked", known=False)
    return token


def authenticate_identity(database: Database, identity: Identity) -> Token:
    """The row that stands for an identity, with the scopes its issuer gives it now.

    Raises:
        NotAllowed: an administrator has revoked it here.
    """
    with database.reading() as connection:
        known = find_subject(connection, identity.subject)
    if known is None:
        with database.transaction() as connection:
            known = keep_subject(connection, identity.subject, identity.name, identity.scopes)
    if known.revoked_at is not None:
        raise NotAllowed("the token is unknown, expired or revoked", known=False)
    return replace(known, scopes=identity.scopes)


def allows(token: Token, scope: Scope) -> bool:
    """Whether a token carries a scope or one that includes it."""
    return any(scope in INCLUDED[Scope(own)] for own in token.scopes)


def require(token: Token | None, scope: Scope) -> Token:
    """The token, if it allows the scope.

    Raises:
        NotAllowed: there is no token, or it lacks the scope.
    """
    if token is None:
        raise NotAllowed("this needs a token: send `Authorization: Bearer …`", known=False)
    if not allows(token, scope):
        raise NotAllowed(
            f"this needs scope {scope}; token {token.name} has {', '.join(token.scopes)}", known=True
        )
    return token
