"""Behind a proxy with a sub-path: every link of every reply leads to the public address.

`tests/journeys/test_behind_proxies.py` has clients that people have, behind nginx and Caddy.
"""

import json
import logging
import re
import shutil
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient

from amers.app.api.session_cookie import COOKIE
from amers.app.cli.api_process import log_public_address
from amers.app.config import Settings, read_settings
from amers.app.db import engine
from amers.app.errors import InputError
from amers.app.main import ROUTERS, create_app
from amers.app.public_url import FOLDERS, LEAVES, normal_public_url
from amers.app.storage import Storage
from amers.app.web import page
from tests.app.callers import Bearer
from tests.app.ledger import job_runner
from tests.app.served import serve_block
from tests.factories import make_block
from tests.links import POST_ALONE, kind_of, urls_of

ROOT = Path(__file__).parents[2]
PUBLIC = "https://gcp.example.org/amers/"
TIFF = b"II*\0" + bytes(100)
TUS = {"Tus-Resumable": "1.0.0", "Upload-Length": "10", "Upload-Metadata": "filename YS50aWY="}
BOX = [5.2, 43.2, 5.3, 43.3]
most_replies = 1000


@pytest.fixture
def settings(settings: Settings) -> Settings:
    return settings.model_copy(update={"public_url": PUBLIC})


@pytest.fixture
def client(settings: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """The service as a proxy calls it, which removes the public path and passes no name on."""
    monkeypatch.setattr(page, "BUILT", tmp_path)
    shutil.copy(ROOT / "web" / "source" / "index.html", tmp_path)
    for name in ("page.js", "page.css"):
        (tmp_path / name).write_text("")
    app = create_app(settings)
    with TestClient(app, base_url="http://127.0.0.1:8000", follow_redirects=False) as client:
        # Compressed files of the page are made when it is built.
        client.headers["Accept-Encoding"] = "identity"
        yield client


@pytest.fixture
def filled(
    client: TestClient, dsn: str, storage: Storage, database, settings, tmp_path: Path, bearer: Bearer
) -> dict[str, str]:
    """An installation with rows of all kinds; headers of its administrator."""
    made = make_block(tmp_path / "block", count=3)
    with engine.connect(dsn) as connection:
        serve_block(connection, storage, made.folder)
    me = bearer("admin")
    scenes = [me.post(f"/scenes?name={name}", content=TIFF).json()["id"] for name in ("a.tif", "b.tif")]
    me.put(f"/scenes/{scenes[0]}/files/a_RPC.TXT", content=b"LINE_OFF: 1")
    assert client.post("/uploads", headers=me | TUS).status_code == 201
    assert job_runner(client, database, settings, me)("export-block", bbox=BOX)["status"] == "successful"
    asked = {"inputs": {"scene": scenes[0]}}
    assert me.post("/processes/register-scene/execution", json=asked).status_code == 201
    return me


@pytest.mark.parametrize("passes_path_on", [False, True], ids=["path removed", "path passed on"])
def test_every_link_of_every_reply_leads_to_the_public_address_and_answers(
    client: TestClient, filled: dict[str, str], passes_path_on: bool
):
    waiting, seen, kinds = deque([PUBLIC, f"{PUBLIC}?f=html"]), {PUBLIC}, set()
    while waiting:
        url = waiting.popleft()
        path = url.removeprefix(PUBLIC if not passes_path_on else "https://gcp.example.org/")
        reply = client.get(f"/{path}", headers=filled | {"Host": "127.0.0.1:8000"})
        assert reply.status_code < 400, (url, reply.text)
        for named in urls_of(reply, url):
            assert f"{named}/".startswith(PUBLIC), (url, named)
            kind = kind_of(named)
            if kind not in seen and not named.endswith(POST_ALONE):
                seen.add(kind)
                kinds.add(kind.partition("?")[0])
                waiting.append(PUBLIC if f"{named}/" == PUBLIC else named)
        assert len(seen) < most_replies
    for part in ("jobs/N/results", "collections/scenes/items/N", "map/page.js", "connect", "search"):
        assert f"{PUBLIC}{part}" in kinds, sorted(kinds)
    assert len(kinds) > 60


def test_pages_lead_on_below_the_public_address(client: TestClient, filled: dict[str, str]):
    for path in (
        "/collections/points/items?limit=1",
        "/collections/scenes/items?limit=1",
        "/search?limit=1",
        "/jobs?limit=1",
        "/audit?limit=1",
        "/processes?limit=1",
    ):
        reply = client.get(path, headers=filled)
        (following,) = [link["href"] for link in reply.json()["links"] if link["rel"] == "next"]
        assert following.startswith(f"{PUBLIC}{path[1:].partition('?')[0]}?"), path
        assert client.get(following.removeprefix(PUBLIC[:-1]), headers=filled).status_code == 200
    for path in ("/collections/points/search", "/search"):
        reply = client.post(path, json={"limit": 1}, headers=filled)
        (following,) = [link for link in reply.json()["links"] if link["rel"] == "next"]
        assert following["href"] == f"{PUBLIC}{path[1:]}"


def test_what_is_made_has_its_location_below_the_public_address(
    client: TestClient, filled: dict[str, str]
):
    scene = client.post("/scenes?name=c.tif", content=TIFF, headers=filled)
    upload = client.post("/uploads", headers=filled | TUS)
    token = client.post("/tokens", json={"name": "t", "scopes": ["read"]}, headers=filled)
    box = {"inputs": {"bbox": BOX}}
    job = client.post("/processes/export-block/execution", json=box, headers=filled)
    ingest = client.post("/amers/processes/export-block/execution", json=box, headers=filled)
    for reply, folder in (
        (scene, "scenes"),
        (upload, "uploads"),
        (token, "tokens"),
        (job, "jobs"),
        (ingest, "jobs"),
    ):
        assert reply.status_code == 201, reply.text
        assert re.fullmatch(rf"{PUBLIC}{folder}/[0-9a-f-]{{36}}", reply.headers["location"])
    place = upload.headers["location"].removeprefix("https://gcp.example.org")
    head = client.head(place, headers=filled | TUS)
    assert (head.status_code, head.headers["tus-resumable"]) == (200, "1.0.0")


def test_a_link_to_a_scene_is_an_input_of_a_process(client: TestClient, filled: dict[str, str]):
    scene = client.post("/scenes?name=c.tif", content=TIFF, headers=filled).json()["id"]
    asked = {"inputs": {"scene": {"href": f"{PUBLIC}scenes/{scene}"}}}
    reply = client.post("/processes/register-scene/execution", json=asked, headers=filled)
    assert reply.status_code == 201, reply.text


@pytest.mark.parametrize("path", ["/amers", "/amers/", "/"])
def test_the_public_address_itself_is_the_landing_page(client: TestClient, path: str):
    reply = client.get(path)
    assert reply.status_code == 200
    assert reply.json()["links"][0]["href"] == PUBLIC


@pytest.mark.parametrize("path", ["/amers/collections/", "/map/"])
def test_a_slash_too_many_does_not_lead_away(path: str, bearer: Bearer):
    reply = bearer("read").get(path)
    below = path.removeprefix("/amers").strip("/")
    assert reply.status_code == 200 or reply.headers["location"] == f"{PUBLIC}{below}"


@pytest.mark.parametrize("path", ["/amersfoot", "/amers2/collections", "/Amers/collections"])
def test_a_path_that_only_begins_alike_is_not_the_public_one(client: TestClient, path: str):
    assert client.get(path).status_code == 404


def test_no_header_of_a_caller_changes_the_links(client: TestClient):
    forged = {
        "Host": "localhost",
        "X-Forwarded-Host": "evil.example",
        "X-Forwarded-Proto": "http",
        "X-Forwarded-Prefix": "/evil",
        "Forwarded": "host=evil.example;proto=http",
    }
    assert client.get("/", headers=forged).json() == client.get("/").json()


def test_the_public_name_is_trusted_and_others_are_not(client: TestClient):
    assert client.get("/", headers={"Host": "gcp.example.org"}).status_code == 200
    assert client.get("/", headers={"Host": "evil.example"}).status_code == 400


def test_a_session_is_kept_below_the_public_path_and_for_tls_alone(client: TestClient, token):
    for prefix in ("", "/amers"):
        data = {"token": token("read")}
        made = client.post(f"{prefix}/sign-in", data=data, headers={"Origin": PUBLIC[:23]})
        ended = client.post(f"{prefix}/sign-out")
        for reply in (made, ended):
            assert (reply.status_code, reply.headers["location"]) == (303, PUBLIC)
            assert "path=/amers/;" in f"{reply.headers['set-cookie'].lower()};"
        assert "secure" in made.headers["set-cookie"].lower()
    elsewhere = client.post("/sign-in", data=data, headers={"Origin": "http://127.0.0.1:8000"})
    assert elsewhere.status_code == 403, (
        "a form of another address would set a cookie that never returns"
    )
    stale = client.get("/amers/collections?f=html", headers={"Cookie": f"{COOKIE}=a.1.b"})
    assert "Path=/amers/" in stale.headers["set-cookie"]


def test_browsers_are_told_to_use_tls_where_the_public_address_does(client: TestClient, settings):
    assert client.get("/").headers["strict-transport-security"] == "max-age=31536000"
    for url in (None, "http://gcp.example.org/"):
        with TestClient(create_app(settings.model_copy(update={"public_url": url}))) as other:
            assert "strict-transport-security" not in other.get("/").headers


def test_the_description_names_the_server(client: TestClient, settings: Settings):
    assert client.get("/api").json()["servers"] == [{"url": PUBLIC.rstrip("/")}]
    with TestClient(create_app(settings.model_copy(update={"public_url": None}))) as other:
        assert other.get("/api").json()["servers"] == [{"url": "http://testserver"}]


# What is wrong is told


def address_part(client: TestClient, **headers: str) -> dict[str, str]:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    part: dict[str, str] = client.get("/readyz", headers=named).json()["parts"]["address"]
    return part


def test_a_deployment_whose_links_lead_elsewhere_says_so_to_whom_it_is_about(
    client: TestClient, settings: Settings
):
    right = {"X_Forwarded_Proto": "https", "X_Forwarded_Host": "gcp.example.org:443"}
    for stated in ({}, right, right | {"X_Forwarded_Prefix": "/amers/"}):
        assert address_part(client, **stated) == {"status": "ok"}
    for stated in (
        {"X_Forwarded_Proto": "http"},
        {"X_Forwarded_Host": "gcp.example.com"},
        {"X_Forwarded_Prefix": "/gcp"},
    ):
        part = address_part(client, **stated)
        assert part["status"] == "degraded"
        assert PUBLIC in part["reason"], stated
        assert "AMERS_PUBLIC_URL" in part["reason"]
    assert address_part(client) == {"status": "ok"}, "nobody else is told of a forged header"
    with TestClient(create_app(settings.model_copy(update={"public_url": None}))) as other:
        assert address_part(other) == {"status": "ok"}
        for stated in (right, {"X_Forwarded_Prefix": "/amers"}):
            assert "set AMERS_PUBLIC_URL" in address_part(other, **stated)["reason"]


def test_a_proxy_that_is_not_named_is_told_to_whom_asks_through_it(client: TestClient):
    part = address_part(client, X_Forwarded_For="192.0.2.7")
    assert (part["status"], "AMERS_TRUSTED_PROXIES" in part["reason"]) == ("degraded", True)


def test_a_wrong_address_is_logged_once_for_whoever_reads_no_readiness(
    client: TestClient, caplog: pytest.LogCaptureFixture
):
    assert client.get("/").status_code == 200
    for _ in range(3):
        client.get("/", headers={"X-Forwarded-Prefix": "/gcp\x1b[2J"})
    (line,) = [record.getMessage() for record in caplog.records if "PUBLIC_URL" in record.getMessage()]
    assert "/gcp" in line
    assert line.isprintable()


@pytest.mark.parametrize(
    ("url", "proxies", "warns"),
    [(PUBLIC, (), True), (PUBLIC, ("127.0.0.1/32",), False), ("http://gcp.example.org/", (), False)],
)
def test_tls_without_a_named_proxy_is_told_at_the_start(settings, caplog, url, proxies, warns):
    caplog.set_level(logging.INFO)
    log_public_address(settings.model_copy(update={"public_url": url, "trusted_proxies": proxies}))
    assert f"callers use {url}" in caplog.text
    assert ("AMERS_TRUSTED_PROXIES names none" in caplog.text) == warns


def test_a_path_that_is_not_there_names_where_paths_begin(client: TestClient):
    reply = client.get("/gcp/collections")
    assert reply.status_code == 404
    assert f"paths of this service begin with {PUBLIC}" in reply.json()["detail"]


# The setting


@pytest.mark.parametrize(
    ("text", "url"),
    [
        ("https://gcp.example.org", "https://gcp.example.org/"),
        ("HTTPS://GCP.Example.org:443/Amers/", "https://gcp.example.org/Amers/"),
        ("http://127.0.0.1:8000", "http://127.0.0.1:8000/"),
        ("https://[::1]:8443/a/b-c/", "https://[::1]:8443/a/b-c/"),
        ("https://gcp.example.org/api/amers", "https://gcp.example.org/api/amers/"),
    ],
)
def test_a_public_address_has_one_form(text: str, url: str):
    assert normal_public_url(text) == normal_public_url(url) == url
    assert Settings(public_url=text).public_url == url


@pytest.mark.parametrize(
    "text",
    [
        "/amers",
        "gcp.example.org/amers",
        "ftp://gcp.example.org",
        "https://",
        "https:///amers",
        "https://gcp.example.org?x=1",
        "https://gcp.example.org/#a",
        "https://gcp.example.org/a//b",
        "https://gcp.example.org/../b",
        "https://gcp.example.org/a%2Fb",
        "https://gcp.example.org/a b",
        "https://gcp.example.org:99999",
        "https://gcp.example.org:0",
        "https://[::zz]",
        "https://gcp.example.org/api",
        "https://gcp.example.org/collections/amers",
    ],
)
def test_what_is_no_public_address_is_refused_by_the_name_of_the_setting(monkeypatch, text: str):
    monkeypatch.setenv("AMERS_PUBLIC_URL", text)
    with pytest.raises(InputError, match="AMERS_PUBLIC_URL"):
        read_settings()


def test_an_empty_public_address_is_none(monkeypatch):
    monkeypatch.setenv("AMERS_PUBLIC_URL", " ")
    assert read_settings().public_url is None


def test_a_refused_address_shows_no_part_of_a_secret(monkeypatch):
    for text in ("https://ada:se@cret@gcp.example.org/", "https://gcp.example.org/?token=secret"):
        monkeypatch.setenv("AMERS_PUBLIC_URL", text)
        with pytest.raises(InputError) as refused:
            read_settings()
        assert not {"ada", "se@", "cret"} & set(re.findall(r"ada|se@|cret", str(refused.value)))
        assert "gcp.example.org" in str(refused.value)


def test_no_public_path_can_be_taken_for_one_of_the_service():
    paths = [
        route.path.strip("/").split("/")
        for router in ROUTERS
        for route in router.routes
        if isinstance(route, APIRoute)
    ]
    assert {path[0] for path in paths if len(path) > 1} - {"{collection}"} == FOLDERS
    assert {path[0] for path in paths if path[0]} - FOLDERS == LEAVES


def test_links_without_a_public_address_follow_the_header_host(settings: Settings):
    with TestClient(create_app(settings.model_copy(update={"public_url": None}))) as client:
        reply = client.get("/", headers={"Host": "localhost:8123"})
    assert reply.json()["links"][0]["href"] == "http://localhost:8123/"
    assert json.dumps(reply.json()).count("gcp.example.org") == 0
