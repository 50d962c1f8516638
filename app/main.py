"""The HTTP application: a table of contents."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import version

from fastapi import APIRouter, FastAPI
from starlette.concurrency import run_in_threadpool

from app.api import blocks, collections, jobs, points, processes, replies, scenes, system
from app.api.body import BodyLimit
from app.config import Settings, read_settings
from app.db import engine
from app.storage import Storage, StoredChips
from app.web import page

DESCRIPTION = (
    "An open base of 3D ground control points with image chips, "
    "and the service that registers satellite scenes on them."
)
ROUTERS: tuple[APIRouter, ...] = (
    system.router,
    collections.router,
    points.router,
    blocks.router,
    scenes.router,
    processes.router,
    jobs.router,
    page.router,
)


def create_app(settings: Settings | None = None) -> FastAPI:
    """The application of one installation; settings come from the environment if not given."""
    chosen = settings or read_settings()

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        opening = engine.opened(chosen)
        app.state.settings = chosen
        app.state.database = await run_in_threadpool(opening.__enter__)
        app.state.storage = Storage(chosen.data_folder / "storage")
        app.state.chips = StoredChips(app.state.storage)
        try:
            yield
        finally:
            app.state.chips.close()
            await run_in_threadpool(opening.__exit__, None, None, None)

    app = FastAPI(
        title="Amers",
        description=DESCRIPTION,
        version=version("amers"),
        lifespan=lifespan,
        openapi_url="/api",
        # Their pages load scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
    )
    app.add_middleware(
        BodyLimit, limit_bytes=chosen.body_limit_bytes, upload_limit_bytes=chosen.upload_limit_bytes
    )
    replies.install(app)
    for router in ROUTERS:
        app.include_router(router)
    return app
