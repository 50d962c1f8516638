"""Methods, slashes and other sites, over all routes of the application."""

import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from amers.app.db.features import pages
from amers.app.usecases.features import items
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.http_world import FORMATS, SITE, TIFF, TUS, HttpWorld, headers_of, http_world


@pytest.fixture(scope="module")
def world(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[HttpWorld]:
    folder = tmp_path_factory.mktemp("http")
    with fresh_database(cluster, TEMPLATE) as dsn, http_world(dsn, folder) as world:
        yield world


def like_get(world: HttpWorld, url: str, **headers: str) -> httpx.Response:
    """The reply to HEAD, compared with that to GET; what two GETs do not have in common may differ."""
    first, head, second = (
        world.client.request(method, url, headers=headers) for method in ("GET", "HEAD", "GET")
    )
    assert (head.status_code, head.content) == (first.status_code, b""), url
    stable = dict(headers_of(first).items() & headers_of(second).items())
    assert stable.items() <= headers_of(head).items(), url
    assert headers_of(head).keys() == headers_of(first).keys(), url
    return head


def test_head_replies_like_get_on_every_route(world: HttpWorld):
    tried = 0
    for route in world.routes():
        if "GET" in route.methods and "HEAD" not in route.methods:
            tried += like_get(world, world.url(route)).is_success
    assert tried > 35
    assert like_get(world, "/collections/points/items/1").status_code == 404
    assert like_get(world, "/collections/points/items?limit=x").status_code == 400


def test_head_of_every_format_has_the_headers_of_its_page(world: HttpWorld):
    for name in FORMATS:
        head = like_get(world, f"/collections/points/items?f={name}&limit=5")
        assert int(head.headers["content-length"]) > 0


def test_head_of_a_large_page_does_not_read_it(world: HttpWorld, monkeypatch: pytest.MonkeyPatch):
    read, stream = [], items.stream

    def counted(*arguments: Any) -> Iterator[Any]:
        for piece in stream(*arguments):
            read.append(piece)
            yield piece

    monkeypatch.setattr(items, "stream", counted)
    monkeypatch.setattr(pages, "ROWS_AT_ONCE", 3)
    url, turns = "/collections/points/items?limit=10000", world.app.state.turns
    whole = world.client.get(url)
    assert (len(whole.json()["features"]), len(read)) == (30, 11)
    read.clear()
    for _ in range(2 * turns.most):
        head = world.client.head(url)
        assert (head.status_code, headers_of(head)) == (200, headers_of(whole))
    assert len(read) == 3 * 2 * turns.most
    assert turns.free == turns.most, "each has given up its connection"


def test_every_path_tells_its_methods(world: HttpWorld):
    for route in world.routes():
        url = world.url(route)
        allowed = route.methods | {"OPTIONS"} | ({"HEAD"} if "GET" in route.methods else set())
        options = world.client.options(url)
        assert options.status_code == 204, url
        assert allowed <= set(options.headers["allow"].split(", ")), url
        other = world.client.request("PROPFIND", url)
        assert (other.status_code, other.headers["allow"]) == (405, options.headers["allow"]), url
        assert "PROPFIND" in other.json()["detail"]
    assert world.client.options("/nothing").status_code == 404


def test_a_slash_at_the_end_changes_nothing(world: HttpWorld):
    for route in world.routes():
        url = world.url(route)
        if url == "/":
            continue
        plain, slashed = (world.client.options(path) for path in (url, f"{url}/"))
        assert headers_of(plain) == headers_of(slashed)
        if "GET" in route.methods and route.path != "/map":
            plain, slashed = (world.client.get(path) for path in (url, f"{url}/"))
            assert slashed.status_code == plain.status_code, url
        for method in route.methods - {"GET", "HEAD", "OPTIONS"}:
            missing = re.sub(r"[0-9a-f]{8}-[0-9a-f-]+|calanques|export-block", "0" * 8, url)
            if missing != url:
                plain, slashed = (
                    world.client.request(method, path, content=b"{}")
                    for path in (missing, f"{missing}/")
                )
                assert slashed.status_code == plain.status_code >= 400, (method, url)
    body = {"filter": "saliency > 0", "limit": 2}
    for path in ("/collections/points/search", "/collections/points/search/"):
        assert world.client.post(path, json=body).json()["numberReturned"] == 2
    page = world.client.get("/map/?a=1")
    assert page.status_code in (307, 404)


SAFELISTED = {"cache-control", "content-language", "content-type", "expires", "last-modified", "pragma"}
OF_THE_CONNECTION = {"date", "server", "vary", "transfer-encoding", "connection", "set-cookie"}
OF_BROWSERS = ("access-control-", "cross-origin-")
POLICIES = {"content-security-policy", "referrer-policy", "x-content-type-options"}


def test_a_page_of_another_site_reads_every_header_that_is_sent(world: HttpWorld):
    origin = {"Origin": SITE}
    replies = [world.client.get(world.url(route), headers=origin) for route in world.routes()]
    replies += [
        world.client.get(f"/collections/points/items?f={name}&limit=2", headers=origin)
        for name in FORMATS
    ]
    (image, result), upload = world.files(), f"/uploads/{world.values['upload_id']}"
    replies += [
        world.client.get(image, headers=origin | {"Range": "bytes=0-1"}),
        world.client.get(result, headers=origin | {"If-None-Match": "*"}),
        world.client.options("/uploads", headers=origin),
        world.client.head(upload, headers=origin | TUS),
        world.client.put("/jobs", headers=origin),
        world.client.get("/jobs", headers=origin | {"Authorization": "Bearer x"}),
        world.client.post("/scenes?name=b.tif", content=TIFF, headers=origin),
        world.client.post("/collections/points/chips", json={"ids": [67108871]}, headers=origin),
    ]
    for reply in replies:
        assert reply.headers["access-control-allow-origin"] == SITE, reply.url
        assert "Origin" in reply.headers["vary"].split(", "), reply.url
        exposed = set(reply.headers["access-control-expose-headers"].lower().split(", "))
        sent = {
            name for name in reply.headers if not name.startswith(("access-control", "cross-origin"))
        }
        assert sent <= exposed | SAFELISTED | OF_THE_CONNECTION | POLICIES, reply.url
    assert {"content-range", "etag", "accept-ranges", "amers-next-token", "tus-extension"} <= exposed
    assert "Origin" in world.client.get("/").headers["vary"]


def test_a_page_of_another_site_may_ask_every_route_with_any_header(world: HttpWorld):
    wanted = "range, if-none-match, if-modified-since, if-range, if-match, upload-offset, authorization"
    for route in world.routes():
        for method in route.methods | {"HEAD"}:
            asked = {"Access-Control-Request-Method": method, "Access-Control-Request-Headers": wanted}
            reply = world.client.options(world.url(route), headers=asked | {"Origin": SITE})
            assert reply.status_code == 200, (method, route.path)
            assert reply.headers["access-control-allow-origin"] == SITE
            assert method in reply.headers["access-control-allow-methods"].split(", ")
            allowed = reply.headers["access-control-allow-headers"].lower()
            assert set(wanted.split(", ")) <= set(allowed.split(", "))
            other = world.client.options("/jobs", headers=asked | {"Origin": "https://evil.example"})
            assert "access-control-allow-origin" not in other.headers


def test_an_extension_of_tus_that_there_is_not_is_refused(world: HttpWorld):
    new = TUS | {"Upload-Length": "5", "Upload-Metadata": "filename YS50aWY="}
    later = {name: value for name, value in new.items() if name != "Upload-Length"}
    for headers in (
        new | {"Upload-Concat": "partial"},
        new | {"Upload-Concat": "final;/uploads/a /uploads/b"},
        later | {"Upload-Defer-Length": "1"},
    ):
        reply = world.client.post("/uploads", headers=headers)
        assert (reply.status_code, reply.headers["tus-resumable"]) == (400, "1.0.0")
        assert "extension" in reply.json()["detail"]
    assert world.client.post("/uploads", headers=later).status_code == 400
    assert world.client.post("/uploads", headers=new | {"Upload-Length": "-1"}).status_code == 400
    other = world.client.post("/uploads", headers=new | {"Tus-Resumable": "0.2.2"})
    assert (other.status_code, other.headers["tus-version"]) == (412, "1.0.0")
    for url in ("/uploads", f"/uploads/{world.values['upload_id']}"):
        told = world.client.options(url)
        assert (told.status_code, told.headers["tus-version"]) == (204, "1.0.0")
        assert "concatenation" not in told.headers["tus-extension"]
