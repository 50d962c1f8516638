"""Forty requests over all routes, with the same replies whatever is between Amers and its rows."""

import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import httpx
from fastapi.testclient import TestClient
from pydantic import SecretStr

from amers.app.main import create_app
from tests.app.flat_world import SIGMA_M, make_flat_world
from tests.app.hostile_installation import Installation, hostile_installation

POINTS = "/collections/points/items"
DAY = "2023-06-05T22:30:00%2B02:00"
REQUESTS: tuple[tuple[str, str], ...] = (
    ("read", "/"),
    ("read", "/conformance"),
    ("read", "/collections"),
    ("read", "/collections/points"),
    ("read", "/collections/points/schema"),
    ("read", "/collections/points/queryables"),
    ("read", f"{POINTS}?limit=5"),
    ("read", f"{POINTS}?limit=5&f=csv"),
    ("read", f"{POINTS}?limit=5&f=html"),
    ("read", f"{POINTS}?f=fgb"),
    ("read", f"{POINTS}?f=parquet"),
    ("read", f"{POINTS}?f=gpkg"),
    ("read", f"{POINTS}?limit=3&crs=http://www.opengis.net/def/crs/EPSG/0/3857"),
    ("read", f"{POINTS}?bbox=5.0,43.0,6.0,44.0&limit=7"),
    ("read", f"{POINTS}?datetime={DAY}/..&limit=3"),
    ("read", f"{POINTS}?datetime=../2023-03-01&limit=3"),
    ("read", f"{POINTS}?filter=saliency%3E0.25%20and%20n_views%3E1&limit=3"),
    ("read", f"{POINTS}?filter=first_view%3E=DATE('2022-01-02')&limit=3"),
    ("read", f"{POINTS}?sortby=-saliency&limit=4"),
    ("read", f"{POINTS}/<point>"),
    ("read", f"{POINTS}/<point>/chips/0"),
    ("read", "/collections/density/items?limit=9"),
    ("read", "/collections/blocks/items"),
    ("admin", "/collections/blocks/items?f=csv"),
    ("admin", "/processes"),
    ("admin", "/blocks/<staged>/quality"),
    ("read", "/collections/points/tiles/WebMercatorQuad/14/5985/8437"),
    ("read", "/collections/points/tiles/WebMercatorQuad/6/23/32"),
    ("read", "/collections/density/tiles/WebMercatorQuad/4/5/8"),
    ("read", "/collections/blocks/tiles/WebMercatorQuad/4/5/8"),
    ("other", "/scenes/<others_scene>"),
    ("other", "/scenes"),
    ("other", "/collections/scenes/items"),
    ("other", "/collections/scenes/items?datetime=2000-01-01/.."),
    ("other", "/collections/scenes/items/<others_scene>"),
    ("other", "/collections/scenes/items?f=csv"),
    ("other", "/search?limit=3"),
    ("other", f"/search?datetime=../{DAY}&limit=3"),
    ("other", "/jobs"),
    ("other", "/jobs/<done_job>"),
    ("other", "/jobs/<done_job>/messages"),
    ("other", "/jobs/<done_job>/results"),
    ("other", "/jobs/<done_job>/results/report.json"),
    ("other", "/uploads/<others_upload>"),
    ("other", "/tokens/self"),
    ("other", "/tokens/self/usage"),
    ("admin", "/tokens"),
    ("admin", "/tokens/usage"),
    ("admin", "/audit?limit=20"),
)
VARYING = (
    re.compile(rb'"timeStamp":\s*"[^"]*"'),
    re.compile(rb'"expected_?[eE]nd":\s*"[^"]*"'),
)
"""When a reply was made, and when a job that waits may end."""
WRITTEN = re.compile(rb"\d{4}-\d\d-\d\dT[\d:.]{12}Z")
"""When a GeoPackage was written; the dates of points have no times."""
COMPARED = ("content-type", "etag", "last-modified", "content-crs", "link", "location")

Reply = tuple[int, dict[str, str], bytes]


@contextmanager
def installation(dsn: str, folder: Path) -> Iterator[Installation]:
    """An installation with points, scenes, uploads, a job that waits and one that is done."""
    folder.mkdir()
    world = make_flat_world(folder / "world", size=600, points=12)
    with hostile_installation(dsn, folder, world) as store:
        scene = store.client.post(
            f"/scenes?name=b.tif&sigma_m={SIGMA_M}",
            content=world.tagged.read_bytes(),
            headers=store.headers["other"],
        ).json()["id"]
        job = store.client.post(
            "/processes/register-scene/execution",
            json={"inputs": {"scene": scene}},
            headers=store.headers["other"],
        )
        store.outcome(job)
        store.names["done_job"] = job.json()["jobID"]
        yield store


def all_replies(store: Installation, client: TestClient | httpx.Client) -> dict[str, Reply]:
    """The replies to all requests, without what tells when they were made."""
    return {f"{role} {path}": _reply(store, client, role, path) for role, path in REQUESTS}


@contextmanager
def served_from(store: Installation, dsn: str) -> Iterator[TestClient]:
    """The same installation in another process' place, on another way to its database."""
    settings = store.settings.model_copy(update={"database_url": SecretStr(dsn)})
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        yield client


def differences(found: dict[str, Reply], expected: dict[str, Reply]) -> dict[str, Any]:
    """The replies that are not equal, byte for byte."""
    return {name: (found[name], expected[name]) for name in expected if found[name] != expected[name]}


def _rows(geopackage: bytes) -> bytes:
    """All rows of a GeoPackage: its free space has pieces of former rows, with the time in them."""
    with closing(sqlite3.connect(":memory:")) as file:
        file.deserialize(geopackage)
        tables = file.execute(
            "select name from sqlite_master where type = 'table' and name not like 'rtree%' order by 1"
        ).fetchall()
        rows = {name: file.execute(f'select * from "{name}"').fetchall() for (name,) in tables}
    return repr(rows).encode()


def _reply(store: Installation, client: Any, role: str, path: str) -> Reply:
    reply = client.get(store.filled(path), headers=store.headers[role])
    body = reply.content
    if body.startswith(b"SQLite"):
        body = WRITTEN.sub(b"", _rows(body))
    for pattern in VARYING:
        body = pattern.sub(b"", body)
    headers = {name: value for name, value in reply.headers.items() if name.lower() in COMPARED}
    return reply.status_code, headers, body
