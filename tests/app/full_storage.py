"""An installation whose storage has files of every kind, in a folder or a bucket."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine, stored_files
from amers.app.db.cluster.embedded import Cluster
from amers.app.db.engine import Connection
from amers.app.main import create_app
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block
from amers.app.usecases.tokens import create_token
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.s3_server import running_bucket
from tests.factories import make_block
from tests.statements import run_sql
from tests.unproven import unproven_storage

TIFF = b"II*\0" + bytes(1000)
FAMILIES = ("chips", "scenes", "results", "uploads")


@dataclass(frozen=True)
class Full:
    """An installation with files of every family.

    Attributes:
        dsn: of its database, which nobody is connected to.
        settings: with its storage.
        files: key to content.
    """

    dsn: str
    settings: Settings
    files: dict[str, bytes]


def contents(storage: Storage) -> dict[str, bytes]:
    """All files of a storage but its marker, and its uploads that are still arriving."""
    files = {}
    for key in (key for family in FAMILIES for key in storage.keys(family)):
        with storage.open(key) as file:
            files[key] = file.read()
    arriving = storage.scratch().glob("upload-*")
    return files | {path.name: path.read_bytes() for path in arriving}


def run_service(settings: Settings, folder: Path, seed: int) -> None:
    """Run a service for a moment: it gets files of every family."""
    storage = unproven_storage(settings)
    dsn = settings.database_url.get_secret_value() if settings.database_url else ""
    with TestClient(create_app(settings)) as client:
        with engine.connect(dsn) as connection:
            made = make_block(folder / f"block-{seed}", count=5, seed=seed, version=f"1.{seed}")
            ingest_block(connection, storage, made.folder)
            secret = create_token(connection, f"user {seed}", ["admin"]).secret
            finish_job(connection, storage)
        client.headers["Authorization"] = f"Bearer {secret}"
        scene = client.post("/scenes?name=a.tif", content=TIFF).raise_for_status().json()["id"]
        client.put(f"/scenes/{scene}/files/a_RPC.TXT", content=b"LINE_OFF: 1").raise_for_status()
        client.put("/blocks/uploads/a.zip", content=b"PK\3\4" * 10).raise_for_status()
        announced = {
            "Upload-Length": "20",
            "Upload-Metadata": "filename YS50aWY=",
            "Tus-Resumable": "1.0.0",
        }
        client.post("/uploads", headers=announced).raise_for_status()


def finish_job(connection: Connection, storage: Storage) -> None:
    """Add a successful job with one file of results."""
    job = uuid4()
    file = storage.put(f"results/{job}/1/report.json", [b"{}"])
    run_sql(
        connection,
        "insert into job (id, kind, state, attempt, inputs, finished_at, results)"
        " values (%s, 'register-scene', 'successful', 1, '{}', now(),"
        " jsonb_build_object('files', jsonb_build_object('report.json', %s::text)))",
        [job, file.key],
    )
    stored_files.record_result(connection, job, file.key, file.size_bytes, file.sha256)


def database_name(dsn: str) -> str:
    """The name of the database of a connection string."""
    return dsn.split("dbname=")[1].split()[0]


@contextmanager
def another(cluster: Cluster, dsn: str | None = None) -> Iterator[str]:
    """A database of an installation of its own; or a copy of a database, as a restored backup is."""
    with fresh_database(cluster, TEMPLATE if dsn is None else database_name(dsn)) as copy:
        if dsn is None:
            with engine.connect(copy) as connection:
                run_sql(connection, "update installation set id = gen_random_uuid()")
        yield copy


@contextmanager
def filled(kind: str, dsn: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Full]:
    """An installation whose storage, a `folder` or a `bucket`, is full."""
    with running_bucket(monkeypatch) as url:
        settings = Settings(
            database_url=dsn,
            data_folder=folder / "data",
            storage_url=url if kind == "bucket" else None,
        )
        if settings.storage_url is not None:
            # For services in processes of their own.
            monkeypatch.setenv("AMERS_STORAGE_URL", settings.storage_url)
        run_service(settings, folder, 1)
        yield Full(dsn, settings, contents(unproven_storage(settings)))
