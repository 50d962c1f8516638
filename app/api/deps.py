"""What endpoints ask for: settings, store, storage, and a caller who may.

What does not wait is `async`: it costs a call, where anything else costs a change of threads.
"""

from collections.abc import Iterator
from typing import Annotated

from fastapi import Depends, Header, Request
from starlette.concurrency import run_in_threadpool

from app import origin
from app.auth import Scope, authenticate, authenticate_identity, require
from app.config import Settings
from app.db.engine import Connection, Database
from app.db.tokens import Token
from app.errors import NotAllowed
from app.oidc import Issuer, looks_like_jwt
from app.storage import Storage, StoredChips


async def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


async def _database(request: Request) -> Database:
    database: Database = request.app.state.database
    return database


async def _storage(request: Request) -> Storage:
    storage: Storage = request.app.state.storage
    return storage


async def _chips(request: Request) -> StoredChips:
    chips: StoredChips = request.app.state.chips
    return chips


SettingsDep = Annotated[Settings, Depends(_settings)]
DatabaseDep = Annotated[Database, Depends(_database)]
StorageDep = Annotated[Storage, Depends(_storage)]
ChipsDep = Annotated[StoredChips, Depends(_chips)]


async def _caller(
    request: Request, database: DatabaseDep, authorization: Annotated[str | None, Header()] = None
) -> Token | None:
    """The caller's token, None when none was sent; one that is sent but wrong is refused."""
    if authorization is None:
        return None
    kind, _, secret = authorization.partition(" ")
    if kind.lower() != "bearer" or not secret.strip():
        raise NotAllowed("the Authorization header must read `Bearer TOKEN`", known=False)
    caller = await run_in_threadpool(_known, request.app.state.issuer, database, secret.strip())
    here = origin.current()
    here.actor, here.actor_name = caller.id, caller.name
    return caller


def _known(issuer: Issuer | None, database: Database, secret: str) -> Token:
    if issuer is not None and looks_like_jwt(secret):
        return authenticate_identity(database, issuer.identify(secret))
    with database.reading() as connection:
        return authenticate(connection, secret)


CallerDep = Annotated[Token | None, Depends(_caller)]


def _reading(database: DatabaseDep, caller: CallerDep) -> Iterator[Connection]:
    """A connection once it is known who calls: who held one and waited for another would block all."""
    with database.reading() as connection:
        yield connection


# Scope "function": committed before the reply is sent, so that a commit that fails is an error reply.
ReadConnection = Annotated[Connection, Depends(_reading, scope="function")]


def _transaction(database: DatabaseDep, caller: CallerDep) -> Iterator[Connection]:
    """A transaction that begins when it is known who calls: the record of changes says so."""
    with database.transaction() as connection:
        yield connection


WriteConnection = Annotated[Connection, Depends(_transaction, scope="function")]


async def _reader(caller: CallerDep) -> Token:
    return require(caller, Scope.READ)


async def _registrar(caller: CallerDep) -> Token:
    return require(caller, Scope.REGISTER)


async def _admin(caller: CallerDep) -> Token:
    return require(caller, Scope.ADMIN)


async def _points_reader(caller: CallerDep, settings: SettingsDep) -> Token | None:
    """Anybody where points are public, else a caller with scope `read`."""
    if caller is None and settings.public_points:
        return None
    return require(caller, Scope.READ)


async def _metrics_reader(caller: CallerDep, settings: SettingsDep) -> Token | None:
    """Anybody where metrics are public, else a caller with scope `monitor`."""
    if caller is None and settings.public_metrics:
        return None
    return require(caller, Scope.MONITOR)


Reader = Annotated[Token, Depends(_reader)]
Registrar = Annotated[Token, Depends(_registrar)]
Admin = Annotated[Token, Depends(_admin)]
MetricsReader = Annotated[Token | None, Depends(_metrics_reader)]
PointsReader = Annotated[Token | None, Depends(_points_reader)]
