"""Paths that name nothing and bodies that are no JSON, over all routes of the application."""

from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.routing import iter_route_contexts

from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.http_world import TUS, HttpWorld, http_world

PIECE = "application/offset+octet-stream"


@pytest.fixture(scope="module")
def world(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[HttpWorld]:
    folder = tmp_path_factory.mktemp("http")
    with fresh_database(cluster, TEMPLATE) as dsn, http_world(dsn, folder) as world:
        yield world


QUICK_NAMES = ("abc", "-1", "a%00b", str(2**63))
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


def about_nothing(
    world: HttpWorld, values: tuple[str, ...]
) -> Iterator[tuple[str, str, dict[str, Any]]]:
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
            for value in values:
                yield method, world.url(route, **{name: value}), more


@pytest.mark.parametrize(
    "values", [QUICK_NAMES, pytest.param(ODD_NAMES, marks=pytest.mark.thorough)], ids=["few", "many"]
)
def test_a_part_of_a_path_that_names_nothing_is_not_found(world: HttpWorld, values: tuple[str, ...]):
    requests = list(about_nothing(world, values))
    assert len(requests) > 50 * len(values)
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
