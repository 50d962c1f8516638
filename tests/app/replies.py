"""What the service answers to every request that reads, in an installation with one thing of each kind.

Two blocks overlap, so that points are superseded; one point is suspended, and three have been tried.
What is of one run alone is left out of the replies: ids, times of the run, tokens of pages.
"""

import json
import re
from collections.abc import Iterator, Mapping
from hashlib import blake2b
from itertools import chain
from pathlib import Path
from typing import Any

import httpx

from amers.app.db import engine
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle
from tests.app.http_world import HttpWorld
from tests.factories import BOX, make_block
from tests.statements import run_sql

GOLDEN = Path(__file__).parents[1] / "golden" / "replies.json"
FIRST = 2**26
"""Id of the first point."""
WEST, SOUTH, EAST, NORTH = BOX
MIDDLE = f"{(WEST + EAST) / 2},{(SOUTH + NORTH) / 2},{EAST},{NORTH}"
LONGEST = 3000
"""Characters of a reply that are kept; of a longer one its beginning, its length and its checksum."""
HEADERS = ("allow", "cache-control", "content-disposition", "content-type", "link", "location", "vary")
HISTORY = """
    insert into point_history (point_id, attempts, successes, expected) values (%s, %s, %s, %s)
"""
DESCRIPTIONS = (
    *(
        "/api",
        "/connect",
        "/map",
        "/metrics",
        "/processes",
        "/readyz",
        "/schemas",
        "/sign-in",
        "/status",
    ),
    *("/collections/points/schema", "/conformance", "/tileMatrixSets"),
)
"""How addresses begin of what describes the service or the process, and not what it has."""
UNORDERED = ("/collections/scenes/items", "/search")
"""Lists in the order of ids, which are drawn."""
FILTERS = {
    "points": (
        "sigma_east_m<0.2",
        "block_number=1 AND sigma_up_m BETWEEN 0.1 AND 0.3",
        "corr_east_north>0",
    ),
    "blocks": ("number=2", "version<>'1'", "title LIKE 'C%'"),
    "density": ("n_points>20", "points_per_km2<1"),
    "point-history": ("attempts>=12", "health IS NULL", "state='suspended'"),
}
"""Of each collection, filters that some features fit."""
PAGES = (
    "limit=3",
    f"limit=2&bbox={MIDDLE}",
    "limit=2&datetime=2017-01-01T00:00:00Z/..",
    "limit=2&datetime=../2017-01-01T00:00:00Z",
    "limit=2&sortby=-id",
    "f=csv&limit=2",
    "f=html&limit=1",
    "f=fgb&limit=1",
)
REFUSED = (
    "limit=1&bbox=1,2,3",
    "limit=0",
    "limit=10001",
    "unknown=1",
    "crs=EPSG:32631",
    "filter=nothing=1",
)
OTHERS = (
    "/jobs?limit=1",
    "/jobs?state=successful",
    "/jobs?processID=export-block&minDuration=0",
    "/jobs?maxDuration=0",
    "/audit?limit=2",
    "/audit?kind=block",
    f"/collections/points/chips?ids={FIRST},{FIRST + 1}",
    f"/collections/points/chips?bbox={MIDDLE}",
    "/blocks/calanques@1/quality",
    "/collections/points/tiles/WebMercatorQuad/12/1494/2108",
    "/nothing",
)
_ID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}")
_OF_THIS_RUN = re.compile(
    r"20[2-9]\d-\d\d-\d\d[T ]\d\d:\d\d:\d\d[\d.]*(Z|\+00:00)?"
    r"|(?<=next=)[\w%.~-]+|(?<=\"next\": \")[\w.~=-]+|(?<=token=)[\w%.~-]+"
    r"|(?<=\")[0-9a-f]{32}(?=\")"
    r"|(?<=seconds\": )[\d.e-]+|(?<=_s\": )[\d.e-]+|/[\w./-]+/data(?=/)"
)


def populate(world: HttpWorld, dsn: str, folder: Path) -> None:
    """Add a second version of the block over a part of the first, and histories of points."""
    with engine.connect(dsn) as connection:
        made = make_block(folder / "second", 12, seed=2, version="2")
        storage = Storage(folder / "data" / "storage")
        lifecycle.ingest_block(connection, storage, made.folder)
        for number in range(3):
            values = (FIRST + number, 11 + number, 3 + number, 2.5 + number)
            run_sql(connection, HISTORY, values)
    world.client.post(f"/points/{FIRST + 2}/suspend", json={"because": "a crossroads was rebuilt"})


def requests(world: HttpWorld) -> Iterator[str]:
    """Addresses of everything that can be read."""
    routes = [world.url(route) for route in world.routes() if "GET" in route.methods]
    routes = [
        address
        for address in routes
        if address != "/" and not address.startswith(DESCRIPTIONS + UNORDERED)
    ]
    pages = [
        f"/collections/{name}/items?{query}"
        for name, filters in FILTERS.items()
        for query in (*PAGES, *(f"limit=2&filter={one}" for one in filters))
    ] + [f"/collections/points/items?{query}" for query in REFUSED]
    items = [
        f"/collections/{name}/items/{FIRST + number}"
        for name in ("points", "point-history")
        for number in (0, 2, 29, 30)
    ]
    yield from dict.fromkeys(chain(routes, pages, items, OTHERS))


def told(reply: httpx.Response, names: dict[str, str]) -> dict[str, Any]:
    """A reply without what is of this run alone."""
    found: dict[str, Any] = {"status": reply.status_code}
    found |= {name: reply.headers[name] for name in HEADERS if name in reply.headers}
    kind = reply.headers.get("content-type", "")
    if "json" in kind or "text" in kind:
        text = reply.text
        if "json" in kind:
            text = json.dumps(reply.json(), indent=0, sort_keys=True)
        found["body"] = _plain(text, names)
        if len(found["body"]) > LONGEST:
            rest = blake2b(found["body"].encode(), digest_size=8).hexdigest()
            found["body"] = f"{found['body'][:LONGEST]} ... {len(found['body'])} {rest}"
    elif kind.startswith("image") or "mapbox" in kind:
        found["body"] = f"{len(reply.content)} bytes {blake2b(reply.content, digest_size=8).hexdigest()}"
    return {name: _plain(one, names) if isinstance(one, str) else one for name, one in found.items()}


def _plain(text: str, names: dict[str, str]) -> str:
    plain = _ID.sub(lambda found: names.setdefault(found[0], f"ID{len(names)}"), text)
    return _OF_THIS_RUN.sub("…", plain)


def answers(world: HttpWorld) -> Mapping[str, dict[str, Any]]:
    """What is answered to each address."""
    names = {value: f"ID of {name}" for name, value in world.values.items() if _ID.fullmatch(value)}
    found = {}
    for address in requests(world):
        reply = world.client.get(address)
        found[_plain(address, names)] = told(reply, names)
    return found


def _written(address: str, found: dict[str, Any]) -> str:
    rows = [
        f"  {json.dumps(name)}: {json.dumps(value, ensure_ascii=False)}" for name, value in found.items()
    ]
    return f" {json.dumps(address)}: {{\n" + ",\n".join(rows) + "\n }"


def written(found: Mapping[str, dict[str, Any]]) -> str:
    """The replies as a file, a line for each status, header and body."""
    return "{\n" + ",\n".join(_written(*one) for one in found.items()) + "\n}\n"
