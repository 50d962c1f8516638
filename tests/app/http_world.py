"""An installation with one thing of each kind, and every route of the service with addresses in it."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

import httpx
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.main import create_app
from amers.app.storage import Storage
from amers.app.usecases.jobs import do_attempt
from amers.app.usecases.tokens import create_token
from tests.app.job_queue import claim
from tests.app.served import serve_block
from tests.factories import BOX, make_block

SITE = "https://viewer.example"
"""A site whose pages may call the service."""
TIFF = b"II*\0" + bytes(range(250)) * 40
FORMATS = ("json", "html", "csv", "fgb", "parquet", "gpkg")
PER_REQUEST = {"date", "x-request-id"}
TUS = {"Tus-Resumable": "1.0.0"}


@dataclass(frozen=True)
class Route:
    """A route of the service.

    Attributes:
        path: with its parameters in braces.
        methods: of this path in all routes.
        names: of its parameters.
    """

    path: str
    methods: frozenset[str]
    names: tuple[str, ...]


@dataclass(frozen=True)
class HttpWorld:
    """The installation: a published block, a scene, an upload, and a finished export.

    Attributes:
        client: sends the token of an administrator.
        values: of the path parameters.
    """

    client: TestClient
    app: FastAPI
    values: dict[str, str]

    def routes(self) -> list[Route]:
        """Every path of the service with all of its methods."""
        methods: dict[str, set[str]] = {}
        for context in iter_route_contexts(self.app.routes):
            assert context.path is not None
            methods.setdefault(context.path, set()).update(context.methods or ())
        return [
            Route(path, frozenset(found), tuple(re.findall(r"{(\w+)", path)))
            for path, found in methods.items()
        ]

    def url(self, route: Route, **other: str) -> str:
        """The address of a thing that exists, or of another one."""
        values = self.values | other
        if route.path.startswith("/scenes/"):
            values = {"name": "a.tif"} | other | {k: v for k, v in values.items() if k != "name"}
        return re.sub(r"{(\w+)(:\w+)?}", lambda found: values[found[1]], route.path)

    def files(self) -> list[str]:
        """Addresses of stored files: a scene image and a result."""
        return [
            f"/scenes/{self.values['scene_id']}/files/a.tif",
            f"/jobs/{self.values['job_id']}/results/block.zip",
        ]


def headers_of(reply: httpx.Response) -> dict[str, str]:
    """The headers of a reply that are not of this request alone."""
    return {name: value for name, value in reply.headers.items() if name not in PER_REQUEST}


@contextmanager
def http_world(dsn: str, folder: Path) -> Iterator[HttpWorld]:
    """A started application on a database of its own."""
    settings = Settings(database_url=dsn, data_folder=folder / "data", cors_origins=SITE)
    with engine.connect(dsn) as connection:
        made = make_block(folder / "block", 30)
        storage = Storage(settings.data_folder / "storage")
        serve_block(connection, storage, made.folder)
        token = create_token(connection, "a client", ["admin"])
    app = create_app(settings)
    with TestClient(app, raise_server_exceptions=False, follow_redirects=False) as client:
        client.headers["Authorization"] = f"Bearer {token.secret}"
        scene = client.post("/scenes?name=a.tif", content=TIFF).json()["id"]
        upload = client.post(
            "/uploads",
            headers=TUS | {"Upload-Length": "100", "Upload-Metadata": "filename YS50aWY="},
        ).headers["location"]
        inputs = {"inputs": {"bbox": list(BOX)}}
        job = client.post("/processes/export-block/execution", json=inputs).json()["jobID"]
        with engine.opened(settings) as database:
            with database.transaction() as own:
                claimed = claim(own, UUID(job))
            assert claimed is not None
            do_attempt(database, settings, UUID(job), claimed.attempt)
        values = {
            "scene_id": scene,
            "item_id": scene,
            "upload_id": upload.rsplit("/", 1)[1],
            "job_id": job,
            "point_id": str(2**26 + 7),
            "feature_id": str(2**26 + 7),
            "reference": "calanques",
            "collection": "points",
            "process_id": "export-block",
            "token_id": str(token.token.id),
            "matrix_set": "WebMercatorQuad",
            "layer": "raw",
            "name": "block.zip",
            **dict.fromkeys(("view", "z", "y", "x"), "0"),
        }
        yield HttpWorld(client, app, values)
