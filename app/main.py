"""The HTTP application: its routers and its middleware."""

import sys
from asyncio import create_task, sleep
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from anyio import to_thread
from fastapi import APIRouter, FastAPI
from starlette.concurrency import run_in_threadpool
from starlette.middleware.cors import CORSMiddleware

from amers.app import reserve
from amers.app.api import (
    blocks,
    chips,
    collections,
    connect,
    cors,
    deps,
    error_responses,
    features,
    history,
    jobs,
    marks,
    openapi,
    operations,
    points,
    processes,
    references,
    results,
    scene_tiles,
    scenes,
    sign_in,
    stac,
    surface_heights,
    system,
    tiles,
    tokens,
    uploads,
)
from amers.app.api.body import BoundedBodies
from amers.app.api.hosts import TrustedHosts
from amers.app.api.paths import TrailingSlashes
from amers.app.api.public_address import PublicAddress
from amers.app.api.reply_headers import ReplyHeaders
from amers.app.api.request_log import RequestLog, RequestMetrics
from amers.app.api.routes import CallerRoute
from amers.app.api.tus import TusRequests
from amers.app.config import Settings, read_settings
from amers.app.db import engine
from amers.app.oidc import Issuer
from amers.app.storage import open_storage
from amers.app.usecases import storage_identity
from amers.app.usecases.damage import open_chips
from amers.app.usecases.installation import Installation
from amers.app.usecases.readiness import Readiness
from amers.app.web import page

SWITCH_INTERVAL_S = 0.0005
"""A thread that computes a large reply lets others run after so long; a small request waits several
times for its turn of the interpreter."""

DESCRIPTION = (
    "An open base of 3D ground control points with image chips, "
    "and the service that registers satellite scenes on them."
)
ROUTERS: tuple[APIRouter, ...] = (
    system.router,
    collections.router,
    points.router,
    chips.router,
    stac.router,
    history.router,
    tiles.router,
    features.router,
    blocks.router,
    scenes.router,
    scene_tiles.router,
    surface_heights.router,
    marks.router,
    uploads.router,
    processes.router,
    references.router,
    jobs.router,
    results.router,
    tokens.router,
    operations.router,
    connect.router,
    sign_in.router,
    page.router,
)


def create_app(settings: Settings | None = None) -> FastAPI:
    """The application of one installation; by default its settings come from the environment."""
    settings = settings or read_settings()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        to_thread.current_default_thread_limiter().total_tokens = deps.threads_for(settings)
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        opening = engine.opened(settings)
        app.state.settings = settings
        app.state.database = await run_in_threadpool(opening.__enter__)
        app.state.storage = open_storage(settings)
        installation = Installation(app.state.database, app.state.storage, settings)
        is_prepared = await run_in_threadpool(_prepare_storage, installation)
        preparing = None if is_prepared else create_task(_prepare_storage_later(installation))
        app.state.chips = open_chips(app.state.database, app.state.storage)
        app.state.readiness = Readiness(installation)
        try:
            yield
        finally:
            if preparing is not None:
                preparing.cancel()
            app.state.readiness.close()
            app.state.chips.close()
            await run_in_threadpool(opening.__exit__, None, None, None)

    app = FastAPI(
        title="Amers",
        description=DESCRIPTION,
        version=version("amers"),
        lifespan=lifespan,
        openapi_url=None,
        # The pages of FastAPI load scripts from other sites.
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.router.route_class = CallerRoute
    app.add_middleware(BoundedBodies, settings=settings)
    app.add_middleware(TrailingSlashes)
    app.add_middleware(CORSMiddleware, **cors.options(settings))
    app.add_middleware(TusRequests)
    if settings.public_url is not None:
        app.add_middleware(PublicAddress, url=settings.public_url)
    app.add_middleware(TrustedHosts, settings=settings)
    app.state.metrics = RequestMetrics()
    app.state.uploads = deps.upload_turns()
    app.state.turns = deps.turns_for(settings)
    app.state.issuer = None if settings.oidc_issuer is None else Issuer(settings)
    app.add_middleware(RequestLog, metrics=app.state.metrics)
    app.add_middleware(ReplyHeaders, settings=settings)
    error_responses.install(app)
    openapi.install(app, ROUTERS, settings)
    # As they are: included, they would be built anew for each application, at its first request.
    app.router.routes.extend(route for router in ROUTERS for route in router.routes)
    return app


def _prepare_storage(installation: Installation) -> bool:
    """Prepare the storage and keep a reserve in it; returns whether it belongs to the database."""
    is_prepared = storage_identity.announce(installation.database.transaction, installation.storage)
    if is_prepared:
        reserve.keep(installation.settings)
    return is_prepared


async def _prepare_storage_later(installation: Installation) -> None:
    """Prepare a storage that was away, or whose database was, when the service began."""
    is_prepared = False
    while not is_prepared:
        await sleep(storage_identity.RETRY_S)
        is_prepared = await run_in_threadpool(_prepare_storage, installation)
