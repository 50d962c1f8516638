"""Dependencies of endpoints: settings, database, storage, and a caller with the scope needed.

Dependencies that do not wait are `async`: FastAPI calls them directly, and runs others in a thread. An
endpoint takes a database connection in its own thread and for as long as it needs it. A dependency that
held a connection and waited for a thread could wait for a thread that waits for a connection.
"""

from collections.abc import AsyncIterator
from typing import Annotated

from anyio import CapacityLimiter, WouldBlock
from fastapi import Depends, Header, Request
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from app import request_context
from app.auth import Scope, authenticate, authenticate_identity, require
from app.config import Settings
from app.db.engine import Database
from app.db.tokens import Token
from app.errors import NotAllowed
from app.oidc import Issuer, looks_like_jwt
from app.storage import Storage, StoredChips
from app.usecases.installation import Installation

UPLOADS_AT_ONCE = 32


def threads_for(settings: Settings) -> int:
    """Number of threads for endpoints: one for each upload at once and for each database connection."""
    return UPLOADS_AT_ONCE + 2 * settings.pool_size


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


async def _installation(
    database: DatabaseDep, storage: StorageDep, settings: SettingsDep
) -> Installation:
    return Installation(database, storage, settings)


InstallationDep = Annotated[Installation, Depends(_installation)]


async def _caller(
    request: Request, database: DatabaseDep, authorization: Annotated[str | None, Header()] = None
) -> Token | None:
    """The caller's token, None if the request has none; an invalid token is refused."""
    if authorization is None:
        return None
    kind, _, secret = authorization.partition(" ")
    if kind.lower() != "bearer" or not secret.strip():
        raise NotAllowed("the Authorization header must read `Bearer TOKEN`", authenticated=False)
    caller = await run_in_threadpool(_token, request.app.state.issuer, database, secret.strip())
    here = request_context.current()
    here.actor, here.actor_name = caller.id, caller.name
    return caller


def _token(issuer: Issuer | None, database: Database, secret: str) -> Token:
    if issuer is not None and looks_like_jwt(secret):
        return authenticate_identity(database, issuer.identify(secret))
    with database.reading() as connection:
        return authenticate(connection, secret)


CallerDep = Annotated[Token | None, Depends(_caller)]


async def _turn(request: Request, caller: CallerDep) -> AsyncIterator[None]:
    """Count an upload in progress: each occupies a thread until all of its bytes have arrived.

    Raises:
        HTTPException: as many uploads as are allowed are in progress.
    """
    turns: CapacityLimiter = request.app.state.upload_turns
    try:
        turns.acquire_on_behalf_of_nowait(request)
    except WouldBlock:
        detail = (
            f"{UPLOADS_AT_ONCE} uploads are in progress, the most that are allowed at once: try again"
        )
        raise HTTPException(503, detail, {"Retry-After": "5"}) from None
    try:
        yield
    finally:
        turns.release_on_behalf_of(request)


UploadTurn = Depends(_turn, scope="function")


async def _reader(caller: CallerDep) -> Token:
    return require(caller, Scope.READ)


async def _registrar(caller: CallerDep) -> Token:
    return require(caller, Scope.REGISTER)


async def _admin(caller: CallerDep) -> Token:
    return require(caller, Scope.ADMIN)


async def _points_reader(caller: CallerDep, settings: SettingsDep) -> Token | None:
    """A caller with scope `read`, or any caller if points are public."""
    if caller is None and settings.public_points:
        return None
    return require(caller, Scope.READ)


async def _metrics_reader(caller: CallerDep, settings: SettingsDep) -> Token | None:
    """A caller with scope `monitor`, or any caller if metrics are public."""
    if caller is None and settings.public_metrics:
        return None
    return require(caller, Scope.MONITOR)


Reader = Annotated[Token, Depends(_reader)]
Registrar = Annotated[Token, Depends(_registrar)]
Admin = Annotated[Token, Depends(_admin)]
MetricsReader = Annotated[Token | None, Depends(_metrics_reader)]
PointsReader = Annotated[Token | None, Depends(_points_reader)]
