"""What the service answers to every request that reads, in an installation with something of each kind.

Two blocks overlap; a third lies across the meridian of 180 degrees, a fourth ends at it, and a fifth is
not published. One point is suspended, three have been tried, and two scenes are described.
What is of one run alone is left out of the replies: ids, times of the run, tokens of pages.
"""

import json
import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from hashlib import blake2b
from itertools import chain
from pathlib import Path
from typing import Any
from uuid import UUID

import cv2
import httpx
import numpy as np

from amers.app.db import engine, scenes
from amers.app.request_context import Origin
from amers.app.storage import Storage
from amers.app.usecases.blocks import lifecycle
from amers.services.types import Acquisition
from tests.app.http_world import TIFF, HttpWorld
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
LEFT_OUT = ("/",)
"""The page that shows what others have."""
UNORDERED = ("features", "scenes", "jobs")
"""Lists that may be in the order of ids, which are drawn."""
ACROSS = "bbox=179,-18,-179,-16"
TRIANGLE = [[5.2, 43.2], [5.3, 43.2], [5.25, 43.28], [5.2, 43.2]]
LAT_LON = "http://www.opengis.net/def/crs/EPSG/0/4326"
MERCATOR = "http://www.opengis.net/def/crs/EPSG/0/3857"
SEARCHES: tuple[dict[str, Any], ...] = (
    {"limit": 4},
    {"limit": 3, "bbox": [float(one) for one in MIDDLE.split(",")], "properties": "block_number"},
    {"limit": 2, "crs": MERCATOR, "filter": "sigma_up_m > 0.1"},
    {"limit": 9, "intersects": {"type": "Polygon", "coordinates": [TRIANGLE]}, "properties": "n_views"},
    {"limit": 2, "bbox": [179.0, -18.0, -179.0, -16.0], "properties": "sigma_east_m,n_views"},
    {"limit": 2, "sortby": "-sigma_up_m,saliency", "properties": "sigma_up_m,saliency", "f": "csv"},
    {
        "limit": 2,
        "datetime": "../2017-06-01",
        "filter": {"op": ">", "args": [{"property": "n_views"}, 1]},
    },
)
"""Bodies of searches for points."""
SCENE_SEARCHES: tuple[dict[str, Any], ...] = (
    {"limit": 1, "sortby": [{"field": "properties.gsd", "direction": "desc"}]},
    {"limit": 1, "sortby": [{"field": "gsd", "direction": "asc"}], "bbox": [5.0, 43.0, 5.5, 43.3]},
    {"datetime": "2018-01-01T00:00:00Z/..", "collections": ["scenes"]},
    {"intersects": {"type": "Point", "coordinates": [5.35, 43.13]}},
    {"collections": ["points"]},
    {"filter": {"op": "=", "args": [{"property": "platform"}, "WV02"]}, "filter-lang": "cql2-json"},
)
"""Bodies of searches for scenes."""
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
    *(f"/collections/{name}/items?limit=4&{ACROSS}" for name in ("points", "blocks", "density")),
    "/collections/blocks/items?bbox=179,9,180,11",
    "/search?bbox=5.35,43.05,5.4,43.2",
    "/search?datetime=2018-01-01T00:00:00Z/..",
    "/collections/scenes/items?filter=gsd>1",
    "/audit?limit=2&before=4",
    *(f"/audit?limit=3&{one}" for one in ("kind=point", "subject=calanques@1", "actor=a client")),
    *(f"/collections/points/items/{FIRST + 1}?{one}" for one in ("f=html", f"crs={MERCATOR}")),
    *(f"/collections/points/items/{FIRST + 1}/chips{one}" for one in ("?f=png", "/1?f=tif", "/2")),
    "/collections/points/items?limit=3&f=html&" + ACROSS,
    "/collections/blocks/items?limit=9&f=html",
    "/collections/scenes/items?limit=9&f=html&sortby=gsd&properties=gsd,platform",
    *(f"/collections/{name}?f=html" for name in ("blocks", "scenes")),
    f"/collections/points/items?limit=3&bbox={WEST},{SOUTH},100,{EAST},{NORTH},120",
    f"/collections/points/items?limit=3&bbox-crs={MERCATOR}&bbox=581000,5344000,584000,5349000",
    f"/collections/points/items?limit=3&bbox-crs={LAT_LON}&bbox={SOUTH},{WEST},{NORTH},{EAST}",
    "/collections/points/items?limit=3&n_views=2&sortby=sigma_east_m&properties=sigma_east_m",
    "/collections/points/items?limit=2500&properties=n_views",
    *(f"/search?limit=1&sortby={one}" for one in ("gsd", "-gsd")),
    "/jobs?datetime=../2020-01-01",
    "/jobs?status=successful&minDuration=0&maxDuration=100000",
)
_ID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}")
_OF_THIS_RUN = re.compile(
    r"20[2-9]\d-\d\d-\d\d[T ]\d\d:\d\d:\d\d[\d.]*(Z|\+00:00)?"
    r"|(?<=\"token\": \")[\w.~=-]+|(?<=next=)[\w%.~-]+|(?<=\"next\": \")[\w.~=-]+|(?<=token=)[\w%.~-]+"
    r"|(?<=\")[0-9a-f]{32}(?=\")"
    r"|(?<=seconds\": )[\d.e-]+|(?<=_s\": )[\d.e-]+|/[\w./-]+/data(?=/)"
)


BLOCKS: tuple[tuple[str, dict[str, Any], bool], ...] = (
    ("second", {"count": 12, "seed": 2, "version": "2"}, False),
    (
        "date line",
        {"count": 7, "seed": 3, "name": "dateline", "box": (179.9, -17.2, -179.8, -16.9)},
        True,
    ),
    ("edge", {"count": 6, "seed": 5, "name": "edge", "box": (179.5, 10.0, 180.0, 10.2)}, True),
    ("elsewhere", {"count": 5, "seed": 4, "name": "elsewhere", "box": (6.0, 44.0, 6.3, 44.1)}, False),
)
"""Further blocks: where they are made, what they have, and whether they are published."""
TAKEN = (
    Acquisition("a", "PHR1A", datetime(2017, 3, 4, 10, 20, 30, tzinfo=UTC), 12.0, 75.0, 60.0, 150.0),
    Acquisition("b", "WV02", datetime(2018, 5, 6, 11, 21, 31, tzinfo=UTC), 23.0, 285.0, 41.0, 170.0),
)
REGISTRATION = """
    insert into registration (id, block_versions, options, report, verdict, files, scene_id, created_at)
    values (gen_random_uuid(), '[["calanques", "1"]]', '{}', '{}', %s, '{}', %s, %s)
"""


def populate(world: HttpWorld, dsn: str, folder: Path) -> None:
    """Add further blocks, histories of points, a scene, and what is known of both scenes."""
    other = world.client.post("/scenes?name=b.tif", content=TIFF).json()["id"]
    with engine.connect(dsn) as connection:
        storage = Storage(folder / "data" / "storage")
        for place, values, is_published in BLOCKS:
            made = make_block(folder / place, **values)
            block = lifecycle.ingest_block(connection, storage, made.folder).block
            if is_published:
                lifecycle.publish_block(connection, str(block.number))
        for number in range(3):
            values = (FIRST + number, 11 + number, 3 + number, 2.5 + number)
            run_sql(connection, HISTORY, values)
        for row, (scene, taken) in enumerate(zip((world.values["scene_id"], other), TAKEN, strict=True)):
            outline = np.array([[5.0, 43.0], [5.2, 43.0], [5.3, 43.1], [5.0, 43.15]]) + 0.1 * row
            scenes.set_footprint(connection, UUID(scene), outline)
            scenes.describe(connection, UUID(scene), taken, (3000 + row, 2000), 0.5 + row)
            for verdict, when in (("usable", "2019-01-01"), ("good", "2018-01-01")):
                run_sql(connection, REGISTRATION, [verdict, scene, when])
    world.client.post(f"/points/{FIRST + 2}/suspend", json={"because": "a crossroads was rebuilt"})


def requests(world: HttpWorld) -> Iterator[str]:
    """Addresses of everything that can be read."""
    routes = [world.url(route) for route in world.routes() if "GET" in route.methods]
    routes = [
        address for address in routes if address not in LEFT_OUT and not address.startswith(DESCRIPTIONS)
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
            document = json.loads(text, parse_float=lambda digits: float(f"{float(digits):.9g}"))
            for name in UNORDERED if isinstance(document, dict) else ():
                if isinstance(document.get(name), list):
                    document[name].sort(key=_without_ids)
            text = json.dumps(document, indent=0, sort_keys=True)
        found["body"] = _plain(text, names)
        if len(found["body"]) > LONGEST:
            rest = blake2b(found["body"].encode(), digest_size=8).hexdigest()
            found["body"] = f"{found['body'][:LONGEST]} ... {len(found['body'])} {rest}"
    elif kind.startswith(("image", "application/vnd.mapbox", "application/x-npz")):
        found["body"] = _pixels(reply.content) or blake2b(reply.content, digest_size=8).hexdigest()
    return {name: _plain(one, names) if isinstance(one, str) else one for name, one in found.items()}


def _without_ids(one: object) -> str:
    return _ID.sub("", json.dumps(one, sort_keys=True))


def _pixels(content: bytes) -> list[float]:
    """Size, mean and standard deviation of an image; nothing of what is none."""
    buffer = np.frombuffer(content, np.uint8)
    pixels = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED) if len(buffer) else None
    if pixels is None:
        return []
    return [*pixels.shape, *(float(f"{one:.6g}") for one in (pixels.mean(), pixels.std()))]


def _plain(text: str, names: dict[str, str]) -> str:
    plain = _ID.sub(lambda found: names.setdefault(found[0], f"ID{len(names)}"), text)
    return _OF_THIS_RUN.sub("…", plain.replace(Origin().actor_name, "somebody"))


def answers(world: HttpWorld, reader: Mapping[str, str]) -> Mapping[str, dict[str, Any]]:
    """What is answered to each address and each search; to a reader, where it is another answer.

    Args:
        world: asked by an administrator.
        reader: headers of a caller who may read.
    """
    names = {value: f"ID of {name}" for name, value in world.values.items() if _ID.fullmatch(value)}
    found = {}
    for address in requests(world):
        name = _plain(address, names)
        found[name] = told(world.client.get(address), names)
        as_reader = told(world.client.get(address, headers=reader), names)
        if as_reader != found[name]:
            found[f"{name} as a reader"] = as_reader
    searches = (
        ("search", "/collections/points/search", SEARCHES),
        ("scenes", "/search", SCENE_SEARCHES),
    )
    for name, path, bodies in searches:
        for number, body in enumerate(bodies):
            reply = world.client.post(path, json=body)
            found[f"{name} {number}"] = told(reply, names)
            links = reply.json().get("links", []) if "json" in reply.headers["content-type"] else []
            for one in (one for one in links if one["rel"] == "next"):
                again = world.client.request(one.get("method", "GET"), one["href"], json=one.get("body"))
                found[f"{name} {number}, second page"] = told(again, names)
    return found


def _written(address: str, found: dict[str, Any]) -> str:
    rows = [
        f"  {json.dumps(name)}: {json.dumps(value, ensure_ascii=False)}" for name, value in found.items()
    ]
    return f" {json.dumps(address)}: {{\n" + ",\n".join(rows) + "\n }"


def written(found: Mapping[str, dict[str, Any]]) -> str:
    """The replies as a file, a line for each status, header and body."""
    return "{\n" + ",\n".join(_written(*one) for one in found.items()) + "\n}\n"
