"""HTTP as clients use it, over all routes of the application: methods, slashes, conditions, paths."""

import re
from collections.abc import Iterator
from email import message_from_bytes
from typing import Any

import httpx
import pytest
from fastapi.routing import iter_route_contexts

from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.http_world import SITE, TIFF, TUS, HttpWorld, http_world

PER_REQUEST = {"date", "x-request-id"}
TILE = "/collections/points/tiles/WebMercatorQuad/5/11/16"
CHIP = "/collections/points/items/67108871/chips/0"
PIECE = "application/offset+octet-stream"
FORMATS = ("json", "html", "csv", "fgb", "parquet", "gpkg")


@pytest.fixture(scope="module")
def world(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[HttpWorld]:
    folder = tmp_path_factory.mktemp("http")
    with fresh_database(cluster, TEMPLATE) as dsn, http_world(dsn, folder) as world:
        yield world


def headers_of(reply: httpx.Response) -> dict[str, str]:
    return {name: value for name, value in reply.headers.items() if name not in PER_REQUEST}


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


def test_every_path_tells_its_methods(world: HttpWorld):
    for route in world.routes():
        url = world.url(route)
        allowed = {*route.methods, "OPTIONS", *({"HEAD"} & {"HEAD"} if "GET" in route.methods else ())}
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


def files(world: HttpWorld) -> list[str]:
    """Addresses of stored files: a scene image, a result, and the result of a raw job."""
    return [
        f"/scenes/{world.values['scene_id']}/files/a.tif",
        f"/jobs/{world.values['job_id']}/results/block.zip",
    ]


def tagged(world: HttpWorld) -> list[str]:
    """Addresses whose replies have a tag."""
    page = ["/map"] if world.client.get("/map").is_success else []
    return [
        *files(world),
        *page,
        TILE,
        CHIP,
        f"{CHIP}?f=npz",
        "/collections/points/items/67108871/chips",
    ]


def weak(tag: str) -> str:
    return f"W/{tag}"


def test_what_a_client_has_is_not_sent_again(world: HttpWorld):
    for url in tagged(world):
        whole = world.client.get(url)
        tag = whole.headers["etag"]
        for held in (tag, weak(tag), f'"a,b", {tag}', f'W/"x",{weak(tag)} , "y"', "*"):
            for method in ("GET", "HEAD"):
                reply = world.client.request(method, url, headers={"If-None-Match": held})
                assert (reply.status_code, reply.content) == (304, b""), (url, held)
                for name in ("etag", "cache-control", "vary", "last-modified", "expires"):
                    assert reply.headers.get(name) == whole.headers.get(name), (url, name)
                assert not {"content-length", "content-type"} & reply.headers.keys()
        for other in ('"other"', tag.strip('"'), f'{tag[:-1]}-x"', "", "W/*"):
            reply = world.client.get(url, headers={"If-None-Match": other})
            assert (reply.status_code, reply.content) == (200, whole.content), (url, other)


def test_a_date_decides_only_where_no_tag_does(world: HttpWorld):
    for url in files(world):
        whole = world.client.get(url)
        date, early = whole.headers["last-modified"], "Mon, 01 Jan 2001 00:00:00 GMT"

        def status(url: str = url, **conditions: str) -> int:
            named = {name.replace("_", "-"): value for name, value in conditions.items()}
            return world.client.get(url, headers=named).status_code

        assert status(If_Modified_Since=date) == 304
        assert status(If_Modified_Since="Fri, 01 Jan 2100 00:00:00 GMT") == 304
        for since in (early, "yesterday", "", "2020-01-01T00:00:00Z 99999999999"):
            assert status(If_Modified_Since=since) == 200, since
        assert status(If_Modified_Since=date, If_None_Match='"other"') == 200
        assert status(If_Modified_Since=early, If_None_Match=whole.headers["etag"]) == 304
        assert status(If_Unmodified_Since=date) == 200
        assert status(If_Unmodified_Since=early) == 412


def test_a_client_that_wants_another_content_gets_none(world: HttpWorld):
    for url in tagged(world):
        tag = world.client.get(url).headers["etag"]
        for wanted, status in (
            (tag, 200),
            ("*", 200),
            (f'"x", {tag}', 200),
            (weak(tag), 412),
            ('"x"', 412),
        ):
            reply = world.client.get(url, headers={"If-Match": wanted})
            assert reply.status_code == status, (url, wanted)
        refused = world.client.get(url, headers={"If-Match": '"x"'})
        assert tag in refused.json()["detail"]
    assert world.client.get("/conformance", headers={"If-Match": '"x"'}).status_code == 412
    assert world.client.get("/nothing", headers={"If-None-Match": "*"}).status_code == 404


def test_a_range_of_a_file_is_sent_alone(world: HttpWorld):
    for url in files(world):
        whole = world.client.get(url).content
        size = len(whole)
        for asked, start, end in (
            ("bytes=0-9", 0, 10),
            ("bytes=5-5", 5, 6),
            ("Bytes = 7-", 7, size),
            ("bytes=-4", size - 4, size),
            (f"bytes=-{size * 10}", 0, size),
            (f"bytes=3-{size * 10}", 3, size),
            ("bytes=1-2,3-4, 2-3", 1, 5),
            (f"bytes=2-3,{size}-", 2, 4),
        ):
            reply = world.client.get(url, headers={"Range": asked})
            assert (reply.status_code, reply.content) == (206, whole[start:end]), asked
            assert reply.headers["content-range"] == f"bytes {start}-{end - 1}/{size}"
            assert int(reply.headers["content-length"]) == end - start


def test_ranges_that_are_none_are_ignored(world: HttpWorld):
    for url in files(world):
        whole = world.client.get(url)
        asked = (
            "items=0-5",
            "bytes",
            "bytes=",
            "bytes=a-b",
            "bytes=9-2",
            "bytes=-",
            "bytes=1-2;3",
            "0-5",
        )
        for value in (*asked, f"bytes={'0-0,' * 101}", f"bytes={'9' * 5000}-"):
            reply = world.client.get(url, headers={"Range": value})
            assert (reply.status_code, reply.content) == (200, whole.content), value
        head = world.client.head(url, headers={"Range": "bytes=0-5"})
        assert (head.status_code, headers_of(head)) == (200, headers_of(whole))
        assert head.headers["accept-ranges"] == "bytes"


def test_a_range_beyond_the_end_tells_the_size(world: HttpWorld):
    for url in files(world):
        size = len(world.client.get(url).content)
        for asked in (f"bytes={size}-", "bytes=-0", f"bytes={size}-{size + 5},{size + 9}-"):
            reply = world.client.get(url, headers={"Range": asked})
            assert (reply.status_code, reply.headers["content-range"]) == (416, f"bytes */{size}")
            assert f"{size} bytes" in reply.json()["detail"]


def test_several_ranges_come_in_parts(world: HttpWorld):
    for url in files(world):
        whole = world.client.get(url).content
        reply = world.client.get(url, headers={"Range": "bytes=-3,0-1,9-12"})
        kind = reply.headers["content-type"]
        assert (reply.status_code, kind.partition(";")[0]) == (206, "multipart/byteranges")
        assert int(reply.headers["content-length"]) == len(reply.content)
        read = message_from_bytes(f"Content-Type: {kind}\r\n\r\n".encode() + reply.content)
        found = [(part["Content-Range"], part.get_payload(decode=True)) for part in read.get_payload()]
        size = len(whole)
        assert found == [
            (f"bytes {start}-{end - 1}/{size}", whole[start:end])
            for start, end in ((0, 2), (9, 13), (size - 3, size))
        ]


def test_a_range_is_sent_only_of_the_content_that_the_client_has(world: HttpWorld):
    for url in files(world):
        whole = world.client.get(url)
        tag, date = whole.headers["etag"], whole.headers["last-modified"]
        early = "Mon, 01 Jan 2001 00:00:00 GMT"
        for condition, status in ((tag, 206), (date, 206), (weak(tag), 200), ('"x"', 200), (early, 200)):
            headers = {"Range": "bytes=0-0", "If-Range": condition}
            assert world.client.get(url, headers=headers).status_code == status, condition
        both = {"Range": "bytes=0-0", "If-None-Match": tag}
        assert world.client.get(url, headers=both).status_code == 304


def test_a_side_file_is_replaced_only_on_conditions_that_hold(world: HttpWorld):
    url = f"/scenes/{world.values['scene_id']}/files/a.json"

    def put(content: bytes, **headers: str) -> int:
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        return world.client.put(url, content=content, headers=named).status_code

    assert put(b"{}", If_Match='"x"') == 412
    assert put(b"{}", If_None_Match="*") == 200
    tag = world.client.get(url).headers["etag"]
    assert put(b"[1]", If_None_Match="*") == put(b"[1]", If_Match='"x"') == 412
    assert world.client.get(url).content == b"{}"
    assert put(b"[1]", If_Match=tag) == 200
    assert world.client.get(url).content == b"[1]"
    assert world.client.get(url).headers["etag"] != tag


def test_a_cache_learns_what_decided_on_a_reply(world: HttpWorld):
    by_accept = world.client.get("/collections", headers={"Accept": "text/html"})
    assert {"Accept", "Origin"} <= set(by_accept.headers["vary"].split(", "))
    assert "Accept" not in world.client.get("/collections?f=html").headers["vary"].split(", ")


ODD_NAMES = (
    *("abc", "-1", "1.5", "1e400", "NaN", "%00", "a%00b", "%FF", "%20", "'", "ü", "%2E%2E", "9" * 400),
    *(str(number) for number in (2**31, 2**63, 2**64, 10**40)),
    *("%0A", "1;drop", "00000000-0000-0000-0000-00000000000g", "a@b@c", "%F0%9F%98%80"),
)
BODIES = {
    "/blocks/{reference}": {"priority": 1},
    "/processes/{process_id}/execution": {"inputs": {}},
    "/collections/{collection}/search": {},
    "/points/{point_id}/suspend": {"because": "a test"},
}


def about_nothing(world: HttpWorld) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Requests in whose address one thing is none; new files have new names."""
    for route in world.routes():
        places = [(name, method) for name in route.names for method in sorted(route.methods)]
        for name, method in places:
            if method == "OPTIONS" or (method, name) == ("PUT", "name"):
                continue
            more: dict[str, Any] = {}
            if route.path.startswith("/uploads"):
                more = {"headers": TUS | {"Upload-Offset": "0", "Content-Type": PIECE}}
            elif method in ("POST", "PATCH"):
                more = {"json": BODIES.get(route.path, {})}
            for value in ODD_NAMES:
                yield method, world.url(route, **{name: value}), more


def test_a_part_of_a_path_that_names_nothing_is_not_found(world: HttpWorld):
    requests = list(about_nothing(world))
    assert len(requests) > 1000
    replies = {
        (method, url): world.client.request(method, url, **more) for method, url, more in requests
    }
    others = {request: reply.text for request, reply in replies.items() if reply.status_code != 404}
    assert others == {}


def test_parameters_of_a_query_are_wrong_where_paths_are_unknown(world: HttpWorld):
    for url in ("items?limit=x", "items?bbox=1", "items?nothing=1", "items/67108871?nothing=1"):
        assert world.client.get(f"/collections/points/{url}").status_code == 400, url
    last = 2**24 - 1
    for place, status in ((f"24/{last}/{last}", 200), (f"24/{last + 1}/0", 404), ("25/0/0", 404)):
        reply = world.client.get(f"/collections/points/tiles/WebMercatorQuad/{place}")
        assert reply.status_code == status, place


def test_a_point_leads_to_its_page(world: HttpWorld):
    point = world.client.get("/collections/points/items/67108871").json()
    links = {link["rel"]: link for link in point["links"]}
    assert {"self", "alternate", "collection"} <= links.keys()
    page = world.client.get(links["alternate"]["href"])
    assert page.headers["content-type"].startswith(links["alternate"]["type"])


def json_routes(world: HttpWorld) -> Iterator[tuple[str, str]]:
    """Method and address of every route that takes JSON."""
    for context in iter_route_contexts(world.app.routes):
        if context.body_field is not None:
            (route,) = (route for route in world.routes() if route.path == context.path)
            for method in context.methods or ():
                yield method, world.url(route)


def test_a_body_that_is_not_sent_as_json_is_told_what_to_send(world: HttpWorld):
    routes = list(json_routes(world))
    assert len(routes) > 7
    form = "application/x-www-form-urlencoded"
    wrong = ("text/plain", "application/json; charset=latin-1", "multipart/form-data", "nonsense", "")
    for method, url in routes:
        for kind in (form, *wrong, None):
            headers = {} if kind is None else {"Content-Type": kind}
            reply = world.client.request(method, url, content=b"{}", headers=headers)
            assert reply.status_code == 415, (method, url, kind)
            assert "Content-Type: application/json" in reply.json()["detail"]
        json = {"Content-Type": "application/json"}
        for content, status, told in (
            (b"", 422, "the body is empty"),
            (b"{", 422, "JSON"),
            (b'{"a": "\xe9"}', 400, "not UTF-8 at byte 7"),
            ('{"a": 1}'.encode("utf-16"), 400, "not UTF-8"),
        ):
            reply = world.client.request(method, url, content=content, headers=json)
            assert reply.status_code == status, (method, url, content, reply.text)
            assert told in reply.json()["detail"], (method, url)


@pytest.mark.parametrize(
    "kind", ["application/json", "Application/JSON; charset=UTF-8", "application/geo+json"]
)
def test_json_is_taken_with_a_mark_of_its_order_of_bytes_too(world: HttpWorld, kind: str):
    for content in (b'{"limit": 1}', b'\xef\xbb\xbf{"limit": 1}'):
        url, headers = "/collections/points/search", {"Content-Type": kind}
        assert world.client.post(url, content=content, headers=headers).status_code == 200


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
    (image, result), upload = files(world), f"/uploads/{world.values['upload_id']}"
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
