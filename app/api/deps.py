"""What endpoints ask for: settings, store, storage, and a caller who may."""

from collections.abc import Iterator
from typing import Annotated

from fastapi import Depends, Header, Request

from app import origin
from app.auth import Scope, authenticate, authenticate_identity, require
from app.config import Settings
from app.db.engine import Connection, Database
from app.db.tokens import Token
from app.errors import NotAllowed
from app.oidc import Issuer, looks_like_jwt
from app.storage import Storage, StoredChips


def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


def _database(request: Request) -> Database:
    database: Database = request.app.state.database
    return database


def _storage(request: Request) -> Storage:
    storage: Storage = request.app.state.storage
    return storage


def _chips(request: Request) -> StoredChips:
    chips: StoredChips = request.app.state.chips
    return chips


SettingsDep = Annotated[Settings, Depends(_settings)]
DatabaseDep = Annotated[Database, Depends(_database)]
StorageDep = Annotated[Storage, Depends(_storage)]
ChipsDep = Annotated[StoredChips, Depends(_chips)]


def _reading(database: DatabaseDep) -> Iterator[Connection]:
    with database.reading() as connection:
        yield connection


# Scope "function": committed before the reply is sent, so that a commit that fails is an error reply.
ReadConnection = Annotated[Connection, Depends(_reading, scope="function")]


def _caller(
    request: Request, database: DatabaseDep, authorization: Annotated[str | None, Header()] = None
) -> Token | None:
    """The caller's token, None when none was sent; one that is sent but wrong is refused."""
    if authorization is None:
        return None
    kind, _, secret = authorization.partition(" ")
    if kind.lower() != "bearer" or not secret.strip():
        raise NotAllowed("the Authorization header must read `Bearer TOKEN`", known=False)
    issuer: Issuer | None = request.app.state.issuer
    if issuer is not None and looks_like_jwt(secret.strip()):
        caller = authenticate_identity(database, issuer.identify(secret.strip()))
    else:
        with database.reading() as connection:
            caller = authenticate(connection, secret.strip())
    here = origin.current()
    here.actor, here.actor_name = caller.id, caller.name
    return caller


CallerDep = Annotated[Token | None, Depends(_caller)]


def _transaction(database: DatabaseDep, caller: CallerDep) -> Iterator[Connection]:
    """A transaction that begins when it is known who calls: the record of changes says so."""
    with database.transaction() as connection:
        yield connection


WriteConnection = Annotated[Connection, Depends(_transaction, scope="function")]


def _reader(caller: CallerDep) -> Token:
    return require(caller, Scope.READ)


def _registrar(caller: CallerDep) -> Token:
    return require(caller, Scope.REGISTER)


def _admin(caller: CallerDep) -> Token:
    return require(caller, Scope.ADMIN)


def _points_reader(caller: CallerDep, settings: SettingsDep) -> Token | None:
    """Anybody where points are public, else a caller with scope `read`."""
    if caller is None and settings.public_points:
        return None
    return require(caller, Scope.READ)


def _metrics_reader(caller: CallerDep, settings: SettingsDep) -> Token | None:
    """Anybody where metrics are public, else a caller with scope `monitor`."""
    if caller is None and settings.public_metrics:
        return None
    return require(caller, Scope.MONITOR)


Reader = Annotated[Token, Depends(_reader)]
Registrar = Annotated[Token, Depends(_registrar)]
Admin = Annotated[Token, Depends(_admin)]
MetricsReader = Annotated[Token | None, Depends(_metrics_reader)]
PointsReader = Annotated[Token | None, Depends(_points_reader)]
