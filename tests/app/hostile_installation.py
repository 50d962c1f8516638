"""An installation with points, scenes and secrets, to check what requests change and disclose."""

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import UUID

import httpx
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.db import engine
from amers.app.db.engine import Database
from amers.app.main import create_app
from amers.app.storage import Storage
from amers.app.usecases.blocks.lifecycle import ingest_block, publish_block
from amers.app.usecases.jobs import do_attempt
from amers.app.usecases.tokens import create_token
from tests.app.flat_world import SIGMA_M, FlatWorld
from tests.app.job_queue import claim
from tests.factories import make_block
from tests.statements import run_sql

CANARY = "canary-7f3a91-must-never-be-seen"
LIMIT_BYTES = 5_000_000
BODY_LIMIT_BYTES = 200_000
LEFT_BY_JOBS = (
    "audit",
    "job",
    "job_message",
    "job_turn",
    "upload",
    "scene",
    "procrastinate_jobs",
    "procrastinate_events",
)
LEFT_BY_JOBS += ("scenes", "blocks", "uploads")
"""Tables and folders that a refused file may change: with the file, the job and the reason."""


@dataclass(frozen=True)
class Installation:
    """A running application with points, scenes and secrets.

    Attributes:
        client: without a token.
        database, settings: of the application.
        headers: of callers by scope; `other` is the owner of `names["others_scene"]`.
        names: ids that cases put into their requests.
        outside: a folder that holds the canary and is no part of the installation.
    """

    client: TestClient
    database: Database
    settings: Settings
    headers: dict[str, dict[str, str]]
    names: dict[str, str]
    outside: Path
    looked: list[dict[str, str]] = field(default_factory=list)

    def digest(self, without: tuple[str, ...] = ("audit",)) -> dict[str, str]:
        """Checksums of all tables and all files."""
        with self.database.transaction() as connection:
            tables = run_sql(
                connection,
                "select tablename as name from pg_tables"
                " where schemaname = 'public' and tablename <> 'spatial_ref_sys' order by 1",
            ).fetchall()
            sums = run_sql(
                connection,
                " union all ".join(
                    f"select '{name}' as name, md5(string_agg(t::text, '|' order by t::text)) as sum"
                    f" from {name} t"
                    for name in (table["name"] for table in tables)
                    if name not in without
                ),
            ).fetchall()
        digests = {row["name"]: str(row["sum"]) for row in sums}
        folder = self.settings.data_folder / "storage"
        for path in sorted(folder.rglob("*")):
            key = path.relative_to(folder)
            if path.is_file() and key.parts[0] not in without:
                digests[str(key)] = hashlib.sha256(path.read_bytes()).hexdigest()
        self.looked.append(digests)
        return digests

    def known_digest(self) -> dict[str, str]:
        """The digest of the last check; computed anew after a failed test."""
        if not self.looked:
            self.digest()
        return self.looked[-1]

    def filled(self, text: str) -> str:
        """The text of a case with its names replaced by ids of this installation."""
        for name, value in self.names.items():
            text = text.replace(f"<{name}>", value)
        return text

    def outcome(self, reply: httpx.Response) -> dict[str, Any]:
        """The job that a reply names, after one attempt at it by the code of the worker process."""
        job_id = UUID(reply.json()["jobID"])
        with self.database.transaction() as connection:
            job = claim(connection, job_id, "a worker", 60.0)
        assert job is not None
        do_attempt(self.database, self.settings, job_id, job.attempt)
        job_reply = self.client.get(f"/jobs/{job_id}", headers=self.headers["admin"])
        document: dict[str, Any] = job_reply.json()
        return document


@contextmanager
def hostile_installation(dsn: str, folder: Path, world: FlatWorld) -> Iterator[Installation]:
    """A started installation: a published and a staged block, scenes of two owners, a canary."""
    outside = folder / "outside"
    outside.mkdir()
    (outside / "canary.txt").write_text(CANARY)
    inside = folder / "ingest"
    inside.mkdir()
    (inside / "way-out").symlink_to(outside)
    scenes = folder / "scenes"
    scenes.mkdir()
    (scenes / "link.tif").symlink_to(outside / "canary.txt")
    (scenes / "text.tif").write_text("not an image")
    settings = Settings(
        database_url=dsn,
        data_folder=folder / "data",
        upload_limit_bytes=LIMIT_BYTES,
        body_limit_bytes=BODY_LIMIT_BYTES,
        ingest_folder=inside,
        scene_folder=scenes,
    )
    storage = Storage(settings.data_folder / "storage")
    headers = {}
    with engine.connect(dsn) as connection:
        published = ingest_block(connection, storage, world.block).block
        publish_block(connection, str(published.number))
        ingest_block(connection, storage, make_block(folder / "staged", count=5, name="staged").folder)
        for role in ("read", "register", "other", "monitor", "admin"):
            scope = "register" if role == "other" else role
            headers[role] = _bearer(create_token(connection, role, [scope]).secret)
        revoked = create_token(connection, "revoked", ["admin"])
        run_sql(connection, "update token set revoked_at = now() where id = %s", [revoked.token.id])
        expired = create_token(connection, "expired", ["admin"], 1)
        run_sql(
            connection,
            "update token set expires_at = now() - interval '1 second' where id = %s",
            [expired.token.id],
        )
    headers |= {"nobody": {}, "revoked": _bearer(revoked.secret), "expired": _bearer(expired.secret)}
    app = create_app(settings)
    with TestClient(app, raise_server_exceptions=False) as client:
        yield Installation(
            client, app.state.database, settings, headers, _names(client, headers, world), outside
        )


def _bearer(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


def _names(client: TestClient, headers: dict[str, dict[str, str]], world: FlatWorld) -> dict[str, str]:
    image = world.tagged.read_bytes()
    post: Callable[..., httpx.Response] = client.post
    names = {
        f"{whose}_scene": post(
            f"/scenes?name=a.tif&sigma_m={SIGMA_M}", content=image, headers=me
        ).json()["id"]
        for whose, me in (("own", headers["register"]), ("others", headers["other"]))
    }
    tus_headers = {
        "Tus-Resumable": "1.0.0",
        "Upload-Length": "100",
        "Upload-Metadata": "filename YS50aWY=",
    }
    for whose, role in (("own", "register"), ("others", "other")):
        begun = post("/uploads", headers=headers[role] | tus_headers)
        names[f"{whose}_upload"] = begun.headers["location"].rsplit("/", 1)[1]
    body = {"inputs": {"scene": names["others_scene"]}}
    job = post("/processes/register-scene/execution", json=body, headers=headers["other"])
    names["others_job"] = job.json()["jobID"]
    items = client.get("/collections/points/items?limit=1", headers=headers["read"]).json()
    names["point"] = str(items["features"][0]["id"])
    secret = headers["read"]["Authorization"].split()[1]
    names["secret"] = secret
    names["secret_cut"] = secret[:-1]
    names["secret_but_one"] = secret[:-1] + ("A" if secret[-1] != "A" else "B")
    blocks = client.get("/collections/blocks/items", headers=headers["admin"]).json()["features"]
    staged = next(one for one in blocks if one["properties"]["state"] == "staged")
    names["staged"] = str(staged["properties"].get("number", staged["id"]))
    return names


def told(reply: httpx.Response) -> str:
    """The headers and the body of a reply as one text."""
    return json.dumps(dict(reply.headers)) + reply.content.decode(errors="replace")
