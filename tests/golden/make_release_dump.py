"""Write the store of a small installation of this release, with rows of every kind, as plain SQL.

    python tests/golden/make_release_dump.py

writes `tests/golden/releases/REVISION.sql.gz`, named by the revision of the schema. A release adds its
dump; an earlier one is never made again. `tests/app/test_release_dumps.py` restores and upgrades them.
Most rows are made through the API, which changes less from release to release than the code behind it.
"""

import gzip
import os
import signal
import subprocess
import sys
import tempfile
import time
from base64 import b64encode
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psycopg
import rasterio
from fastapi.testclient import TestClient
from pydantic import SecretStr
from rasterio.transform import Affine

from amers.app.config import Settings
from amers.app.db import engine, revisions
from amers.app.db.cluster.binaries import find_binaries
from amers.app.db.cluster.embedded import Cluster
from amers.app.db.jobs import attempts
from amers.app.db.tokens import keep_subject
from amers.app.main import create_app
from amers.app.storage import open_storage
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block, withdraw_block
from amers.app.usecases.tokens import create_token
from tests.app.flat_world import SIGMA_M, FlatWorld, make_flat_world
from tests.factories import make_block

RELEASES = Path(__file__).parent / "releases"
DUMP = ("--format=plain", "--inserts", "--rows-per-insert=200", "--no-owner", "--no-privileges")
LONGEST_WAIT_S = 300.0
LONG_WORK = 10_000
"""Stages of a registration that runs until it is stopped."""
EXECUTE = "/processes/register-scene/execution"
TUS = {"Tus-Resumable": "1.0.0"}

Headers = dict[str, str]


class Installation:
    """A running application with an administrator, on a database of its own.

    Attributes:
        client: of the application.
        admin: headers of the administrator.
    """

    def __init__(self, client: TestClient, dsn: str, settings: Settings) -> None:
        self.client, self.dsn, self.settings = client, dsn, settings
        with engine.connect(dsn) as connection:
            self.admin = bearer(create_token(connection, "administrator", ["admin"]).secret)

    def ask(self, method: str, path: str, headers: Headers, **options: Any) -> Any:
        """The reply to a request, which must succeed: its JSON, or its headers where there is none."""
        reply = self.client.request(
            method, path, headers={**headers, **options.pop("more", {})}, **options
        )
        assert reply.is_success, f"{method} {path}: {reply.status_code} {reply.text}"
        return reply.json() if reply.content else reply.headers

    def token(self, name: str, scopes: list[str], **more: Any) -> tuple[Headers, str]:
        """The headers of a new token, and its id."""
        made = self.ask("POST", "/tokens", self.admin, json={"name": name, "scopes": scopes, **more})
        return bearer(made["secret"]), str(made["id"])

    def scene(self, owner: Headers, content: bytes, name: str) -> str:
        """The id of an uploaded scene."""
        path = f"/scenes?name={name}&sigma_m={SIGMA_M}"
        return str(self.ask("POST", path, owner, content=content)["id"])

    def job(self, owner: Headers, scene: str, stages: int = 1, key: str | None = None) -> str:
        """The path of a new registration."""
        body = {"inputs": {"scene": scene, "options": {"fine_stages": stages}}}
        more = {} if key is None else {"Idempotency-Key": key}
        return f"/jobs/{self.ask('POST', EXECUTE, owner, json=body, more=more)['jobID']}"

    def wait(self, job: str, *states: str) -> None:
        """Wait until a job is in one of some states."""
        deadline = time.monotonic() + LONGEST_WAIT_S
        while (state := self.ask("GET", job, self.admin))["status"] not in states:
            assert time.monotonic() < deadline, state
            time.sleep(0.1)

    @contextmanager
    def worker(self, ending: signal.Signals):
        """A worker that is ended by a signal."""
        environment = os.environ | {
            "AMERS_DATABASE_URL": self.dsn,
            "AMERS_DATA_FOLDER": str(self.settings.data_folder),
        }
        process = subprocess.Popen([sys.executable, "-m", "amers", "worker"], env=environment)
        try:
            yield
        finally:
            process.send_signal(ending)
            process.wait()


def bearer(secret: str) -> Headers:
    """The header of a token."""
    return {"Authorization": f"Bearer {secret}"}


def make_points(place: Installation, world: FlatWorld, folder: Path) -> None:
    """Blocks in each state, and a suspended point."""
    storage = open_storage(place.settings)
    with engine.connect(place.dsn) as connection:
        ingest_block(connection, storage, world.block)
        publish_block(connection, "flat")
        for version in ("1", "2"):
            ingest_block(
                connection,
                storage,
                make_block(folder / version, 3, version=version, seed=int(version)).folder,
            )
            if version == "1":
                publish_block(connection, "calanques")
                withdraw_block(connection, "calanques")
    page = place.ask("GET", "/collections/points/items?limit=1&sortby=id", place.admin)
    point = page["features"][0]["id"]
    place.ask(
        "POST",
        f"/points/{point}/suspend",
        place.admin,
        json={"because": "the roof was rebuilt"},
    )


def make_scenes_and_jobs(place: Installation, world: FlatWorld) -> None:
    """Owners with scenes, uploads under way, and jobs in each state."""
    image, nonsense = world.tagged.read_bytes(), b"II*\0" + bytes(200)
    owner, _ = place.token("owner", ["register"], job_quota=6, storage_quota_bytes=10_000_000)
    other, _ = place.token("other", ["read", "register"])
    _, revoked = place.token("revoked", ["read"], days=30)
    place.ask("DELETE", f"/tokens/{revoked}", place.admin)
    _, expired = place.token("expired", ["read"], days=1)
    scene, bad = place.scene(owner, image, "scene.tif"), place.scene(owner, nonsense, "bad.tif")
    place.ask("DELETE", f"/scenes/{place.scene(owner, nonsense, 'removed.tif')}", owner)
    for purpose, name in (("image", "half.tif"), ("block", "half.zip")):
        sender = owner if purpose == "image" else place.admin
        begin_upload(place, sender, purpose, name)
    with place.worker(signal.SIGTERM):
        for job, state in ((place.job(owner, scene), "successful"), (place.job(owner, bad), "failed")):
            place.wait(job, state)
    place.ask("DELETE", place.job(owner, scene), owner)
    for delayed in (True, False):
        job = place.job(owner, scene, LONG_WORK)
        with place.worker(signal.SIGKILL):
            place.wait(job, "running")
        if delayed:
            with engine.connect(place.dsn) as connection:
                attempts.try_again(connection, job.removeprefix("/jobs/"), 1, 86_400.0)  # type: ignore[arg-type]
    others = place.scene(other, image, "others.tif")
    for _ in range(2):
        place.job(owner, scene)
    place.job(other, others, key="first")
    with psycopg.connect(place.dsn) as connection:
        connection.execute(
            "update token set expires_at = created_at + interval '1 second' where id = %s", [expired]
        )


def begin_upload(place: Installation, sender: Headers, purpose: str, name: str) -> None:
    """An upload of which half has arrived."""
    content = b"II*\0" + bytes(96) if purpose == "image" else b"PK\3\4" + bytes(96)
    about = ",".join(
        f"{key} {b64encode(value.encode()).decode()}"
        for key, value in (("filename", name), ("name", name), ("purpose", purpose))
    )
    more = {**TUS, "Upload-Length": "200", "Upload-Metadata": about}
    made = place.ask("POST", "/uploads", sender, more=more)
    piece = {**TUS, "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    place.ask("PATCH", made["location"], sender, content=content, more=piece)


def make_references(place: Installation) -> None:
    """A reference image with a place where a scene was found, and an identity of an OpenID issuer."""
    path = place.settings.reference_folder / "reference.tif"
    grid = Affine(10.0, 0, 5e5, 0, -10.0, 5e6)
    profile = {"driver": "GTiff", "width": 64, "height": 64, "count": 1, "dtype": "uint16"}
    with rasterio.open(path, "w", crs="EPSG:32632", transform=grid, **profile) as file:
        file.write(np.arange(4096, dtype=np.uint16).reshape(64, 64), 1)
    body = {"name": "north", "image": path.name, "sigma_m": 5.0}
    place.ask("POST", "/references", place.admin, json=body)
    with engine.connect(place.dsn) as connection:
        keep_subject(connection, "https://issuer.example#surveyor", "surveyor", ["read"])
    with psycopg.connect(place.dsn) as connection:
        connection.execute(
            "insert into reference_point (reference_id, geom, attempts, successes, last_success_at)"
            " select id, st_setsrid(st_makepoint(9, 45, 200), 4979), 2, 1, now() from reference_image"
        )


def write_dump(dsn: str, file: Path) -> None:
    """Dump a database as statements that a driver can run: no COPY, no commands of psql."""
    with psycopg.connect(dsn) as connection:
        version = connection.info.server_version // 10_000
    program = find_binaries(version).folder / "pg_dump"
    done = subprocess.run(
        [program, *DUMP, f"--dbname={dsn}"], capture_output=True, text=True, check=True
    )
    lines = [line for line in done.stdout.splitlines() if line and not line.startswith(("--", "\\"))]
    file.write_bytes(gzip.compress("\n".join(lines).encode(), 9, mtime=0))


def main(folder: Path) -> None:
    """Make the installation, and dump it."""
    file = RELEASES / f"{revisions.newest_revision()}.sql.gz"
    world = make_flat_world(folder / "world", size=600, points=12)
    (folder / "references").mkdir()
    cluster = Cluster(folder / "postgres", durable=False)
    with cluster.lease() as dsn:
        revisions.upgrade(dsn)
        settings = Settings(
            database_url=SecretStr(dsn),
            data_folder=folder / "data",
            reference_folder=folder / "references",
        )
        with TestClient(create_app(settings)) as client:
            place = Installation(client, dsn, settings)
            make_points(place, world, folder)
            make_references(place)
            make_scenes_and_jobs(place, world)
        write_dump(dsn, file)
    print(f"{file}: {file.stat().st_size} bytes")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(prefix="amers-release-") as name:
        # The server of the private cluster runs as another user.
        Path(name).chmod(0o755)
        main(Path(name))
