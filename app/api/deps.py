"""Dependencies of endpoints: settings, database, storage, and a caller with the scope needed.

Dependencies that do not wait are `async`: FastAPI calls them directly, and runs others in a thread. An
endpoint takes a database connection in its own thread and for as long as it needs it. A dependency that
held a connection and waited for a thread could wait for a thread that waits for a connection.
"""

import time
from typing import Annotated

from fastapi import Depends, Request
from starlette.concurrency import run_in_threadpool

from amers.app import request_context
from amers.app.api.access import needs
from amers.app.api.body import body_of
from amers.app.api.credentials import BASIC, credentials_of, refuse_other_sites, session_of
from amers.app.api.session_cookie import ENDED_SESSION, Session, parse_session
from amers.app.api.turns import Turns
from amers.app.auth import (
    Scope,
    authenticate,
    authenticate_identity,
    authenticate_session,
    require,
    require_token,
)
from amers.app.config import Settings
from amers.app.db.engine import Database
from amers.app.db.tokens import Token
from amers.app.errors import NotAllowed
from amers.app.oidc import Issuer, looks_like_jwt
from amers.app.storage import Storage, StoredChips
from amers.app.usecases.features.items import page_secret
from amers.app.usecases.installation import Installation

UPLOADS_AT_ONCE = 32
UPLOADS_PER_CALLER = 8
TURN_PATIENCE_S = 10.0
CALLER = "amers.caller"


def threads_for(settings: Settings) -> int:
    """Number of threads for endpoints: one for each upload at once and for each database connection."""
    return UPLOADS_AT_ONCE + 2 * settings.pool_size


def turns_for(settings: Settings) -> Turns:
    """Turns of requests that read the database, so that one caller leaves half of its connections.

    A quarter of the connections for reading is for authentication and health checks, which take no turn.
    """
    connections = settings.pool_size
    most = max(1, connections - connections // 4)
    return Turns("requests", most, max(1, connections // 2), TURN_PATIENCE_S)


def upload_turns() -> Turns:
    """Turns of uploads: each occupies a thread until all of its bytes have arrived."""
    return Turns("uploads", UPLOADS_AT_ONCE, UPLOADS_PER_CALLER, patience_s=0.0)


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


async def identify(request: Request) -> Token | None:
    """The caller's token, None if the request has none; later dependencies get it from `caller_of`.

    A session that has ended counts as none, so that a browser sees what is public; the reply removes it.

    Raises:
        NotAllowed: the token is invalid.
        HTTPException: a page of another site uses a password or a session that the browser has kept.
    """
    caller = None
    credentials = credentials_of(request.headers)
    session = session_of(request) if credentials is None else None
    if session is not None or (credentials is not None and credentials.scheme == BASIC):
        refuse_other_sites(request)
    state = request.app.state
    if credentials is not None:
        caller = await run_in_threadpool(_token, state.issuer, state.database, credentials.secret)
    elif session is not None:
        caller = await _session_caller(request, session)
    if caller is not None:
        here = request_context.current()
        here.actor, here.actor_name = caller.id, caller.name
    request.scope[CALLER] = caller
    return caller


def _token(issuer: Issuer | None, database: Database, secret: str) -> Token:
    if issuer is not None and looks_like_jwt(secret):
        return authenticate_identity(database, issuer.identify(secret))
    with database.reading() as connection:
        return authenticate(connection, secret)


async def _session_caller(request: Request, session: str) -> Token | None:
    """The token of a session; None for one that has ended or is not of this service."""
    database: Database = request.app.state.database
    secret = await installation_secret(request, database)
    try:
        parsed = parse_session(session, time.time(), secret)
        return await run_in_threadpool(_session_token, database, parsed)
    except NotAllowed:
        setattr(request.state, ENDED_SESSION, True)
        return None


def _session_token(database: Database, session: Session) -> Token:
    with database.reading() as connection:
        return authenticate_session(connection, session.token_id, session.id)


async def installation_secret(request: Request, database: DatabaseDep) -> bytes:
    """The key that page tokens and sessions are signed with; each process reads it once."""
    secret: bytes | None = getattr(request.app.state, "page_secret", None)
    if secret is None:
        secret = request.app.state.page_secret = await run_in_threadpool(_read_secret, database)
    return secret


def _read_secret(database: Database) -> bytes:
    with database.reading() as connection:
        return page_secret(connection)


SecretDep = Annotated[bytes, Depends(installation_secret)]


async def caller_of(request: Request) -> Token | None:
    """The caller's token, None if the request has none; its route has authenticated it."""
    caller: Token | None = request.scope[CALLER]
    return caller


CallerDep = Annotated[Token | None, Depends(caller_of)]


async def takes_upload(request: Request, caller: CallerDep) -> None:
    """Accept a body as large as an upload; the route gives the request a turn among the uploads."""
    body_of(request).accept_upload()


UploadTurn = Depends(takes_upload)


@needs(None)
async def _token_holder(caller: CallerDep) -> Token:
    return require_token(caller)


@needs(Scope.READ)
async def _reader(caller: CallerDep) -> Token:
    return require(caller, Scope.READ)


@needs(Scope.REGISTER)
async def _registrar(caller: CallerDep) -> Token:
    return require(caller, Scope.REGISTER)


@needs(Scope.ADMIN)
async def _admin(caller: CallerDep) -> Token:
    return require(caller, Scope.ADMIN)


@needs(Scope.READ, "public_points")
async def _points_reader(caller: CallerDep, settings: SettingsDep) -> Token | None:
    """A caller with scope `read`, or any caller if points are public."""
    if caller is None and settings.public_points:
        return None
    return require(caller, Scope.READ)


@needs(Scope.MONITOR, "public_metrics")
async def _metrics_reader(caller: CallerDep, settings: SettingsDep) -> Token | None:
    """A caller with scope `monitor`, or any caller if metrics are public."""
    if caller is None and settings.public_metrics:
        return None
    return require(caller, Scope.MONITOR)


TokenHolder = Annotated[Token, Depends(_token_holder)]
Reader = Annotated[Token, Depends(_reader)]
Registrar = Annotated[Token, Depends(_registrar)]
Admin = Annotated[Token, Depends(_admin)]
MetricsReader = Annotated[Token | None, Depends(_metrics_reader)]
PointsReader = Annotated[Token | None, Depends(_points_reader)]
