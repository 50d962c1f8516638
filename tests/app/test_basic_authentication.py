"""The token as the password of HTTP Basic, for clients that can send no other credentials."""

import logging
from base64 import b64encode
from collections.abc import Callable, Iterator
from typing import Any
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient

from amers.app.api.credentials import Credentials
from amers.app.api.routes import _key
from amers.app.config import Settings
from amers.app.db.cluster.embedded import Cluster
from amers.app.main import create_app
from tests.app.conftest import TEMPLATE, fresh_database
from tests.statements import run_sql

pytestmark = pytest.mark.security

Headers = dict[str, str]
BEARER_CHALLENGE = 'Bearer realm="amers"'
BASIC_CHALLENGE = 'Basic realm="amers", charset="UTF-8"'
TUS = {"Tus-Resumable": "1.0.0", "Upload-Offset": "0", "Upload-Metadata": "filename YS50aWY="}
TIFF = b"II*\0" + bytes(1000)
HERE = "http://localhost"
"""The origin of the service."""
THERE = "https://elsewhere.example"
IMAGE = {"Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}
LINK = {"Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
FRAME = {"Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"}
FROM_OTHER_SITES = {
    "a form of another site": {"Sec-Fetch-Site": "cross-site", **LINK, "Origin": THERE},
    "a form of a sibling site": {"Sec-Fetch-Site": "same-site", **LINK},
    "a form of another site over HTTP": {"Origin": THERE},
    "a form of another port": {"Origin": f"{HERE}:8001"},
    "a form of a sandbox": {"Origin": "null"},
    "an origin that is none": {"Origin": "http://["},
    "two answers": {"Sec-Fetch-Site": "same-origin, cross-site"},
}
FROM_HERE = {
    "a program": {},
    "a page of the service": {"Sec-Fetch-Site": "same-origin", "Origin": HERE},
    "the address bar": {"Sec-Fetch-Site": "none"},
    "a page of the service over HTTP": {"Origin": HERE},
}


def basic(secret: str, user: str = "qgis") -> Headers:
    return {"Authorization": f"Basic {b64encode(f'{user}:{secret}'.encode()).decode()}"}


@pytest.fixture(scope="module")
def dsn(cluster: Cluster) -> Iterator[str]:
    with fresh_database(cluster, TEMPLATE) as dsn:
        yield dsn


@pytest.fixture(scope="module")
def settings(dsn: str, tmp_path_factory: pytest.TempPathFactory) -> Settings:
    return Settings(database_url=dsn, data_folder=tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def client(settings: Settings) -> Iterator[TestClient]:
    with TestClient(create_app(settings), base_url=HERE, raise_server_exceptions=False) as client:
        yield client


@pytest.mark.parametrize("user", ["qgis", "", "amers", "Ana María", "token"])
def test_the_token_is_accepted_as_the_password_of_any_user(
    client: TestClient, token: Callable[[str], str], user: str
):
    secret = token("read")
    by_bearer = client.get("/tokens/self", headers={"Authorization": f"Bearer {secret}"})
    by_basic = client.get("/tokens/self", headers=basic(secret, user))
    assert (by_basic.status_code, by_basic.json()) == (200, by_bearer.json())
    lower = basic(secret)["Authorization"].replace("Basic", "basic")
    assert client.get("/tokens/self", headers={"Authorization": lower}).status_code == 200


def test_scopes_and_owners_are_those_of_the_token(client: TestClient, token: Callable[[str], str]):
    me, stranger, reader = basic(token("register")), basic(token("register")), basic(token("read"))
    assert client.post("/scenes?name=a.tif", content=TIFF, headers=reader).status_code == 403
    sent = client.post("/scenes?name=a.tif", content=TIFF, headers=me)
    assert sent.status_code == 201
    here = f"/scenes/{sent.json()['id']}"
    assert client.get(here, headers=me).status_code == 200
    assert client.get(here, headers=stranger).status_code == 404


def test_revoked_and_expired_tokens_are_refused(
    client: TestClient, token: Callable[[str], str], connection
):
    for end in (
        "update token set revoked_at = now() where id = %s",
        "update token set expires_at = now() - interval '1 second' where id = %s",
    ):
        secret = token("read")
        run_sql(connection, end, [client.get("/tokens/self", headers=basic(secret)).json()["id"]])
        connection.commit()
        reply = client.get("/tokens/self", headers=basic(secret))
        assert reply.status_code == 401
        assert "unknown, expired or revoked" in reply.json()["detail"]


def encoded(content: bytes) -> str:
    return f"Basic {b64encode(content).decode()}"


@pytest.mark.parametrize(
    ("authorization", "what"),
    [
        ("Basic", "empty"),
        ("Basic ", "empty"),
        ("Basic !!!!", "Base64"),
        ("Basic YTp", "Base64"),
        ("Basic cWdpczp4 cWdpczp4", "Base64"),
        (b"Basic caf\xe9", "Base64"),
        (encoded(b"no colon"), "colon"),
        (encoded(b"the-token-as-user:"), "password"),
        (encoded(b"qgis: \t"), "password"),
        (encoded(b"qgis:\xff\xfe"), "UTF-8"),
        (encoded(b"qgis:wrong"), "unknown, expired or revoked"),
        (encoded(b"qgis:wr\0ng"), "unknown, expired or revoked"),
        (encoded(b"qgis:" + b"a" * 6000), "unknown, expired or revoked"),
        ("Digest username=qgis", "Basic"),
        ("Negotiate YII=", "Bearer"),
    ],
)
def test_malformed_credentials_are_refused_with_their_fault(
    client: TestClient, authorization: str | bytes, what: str, caplog: pytest.LogCaptureFixture
):
    caplog.set_level(logging.DEBUG)
    reply = client.get("/jobs", headers=[(b"authorization", as_bytes(authorization))])
    assert (reply.status_code, reply.headers["content-type"]) == (401, "application/problem+json")
    assert what in reply.json()["detail"]
    sent = as_bytes(authorization).partition(b" ")[2].decode("latin-1").strip()
    assert len(sent) < 4 or sent not in reply.text + caplog.text


def test_all_that_follows_the_first_colon_is_the_password(
    client: TestClient, token: Callable[[str], str]
):
    """Source: RFC 7617, section 2: the name of a user has no colon, a password may."""
    secret = token("read")
    assert client.get("/tokens/self", headers=basic(secret)).status_code == 200
    for password in (f"more:{secret}", f":{secret}", f"{secret}:more"):
        assert client.get("/tokens/self", headers=basic(password)).status_code == 401


def as_bytes(value: str | bytes) -> bytes:
    return value.encode() if isinstance(value, str) else value


def test_credentials_are_shown_without_their_secret() -> None:
    shown = repr(Credentials("bearer", "a-secret"))
    assert "bearer" in shown
    assert "a-secret" not in shown


def test_two_credentials_in_one_request_are_refused(client: TestClient, token: Callable[[str], str]):
    secret = token("read")
    both = [("Authorization", f"Bearer {secret}"), ("Authorization", basic(secret)["Authorization"])]
    reply = client.get("/tokens/self", headers=both)
    assert reply.status_code == 401
    assert "2 Authorization headers" in reply.json()["detail"]


def challenges(client: TestClient, headers: Headers) -> list[str]:
    reply = client.get("/collections/points/items", headers=headers)
    assert reply.status_code == 401
    return reply.headers.get_list("www-authenticate")


def test_who_sends_no_token_is_told_both_ways(client: TestClient):
    both = [BEARER_CHALLENGE, BASIC_CHALLENGE]
    assert challenges(client, {}) == both
    assert challenges(client, basic("wrong")) == both
    assert challenges(client, {"Sec-Fetch-Site": "none", **LINK}) == both


def test_a_web_token_is_refused_as_any_wrong_one_where_no_issuer_is_trusted(client: TestClient):
    for headers in (basic("a.b.c"), {"Authorization": "Bearer a.b.c"}):
        assert client.get("/tokens/self", headers=headers).status_code == 401


def test_no_challenge_makes_a_browser_ask_for_a_password_over_the_map(client: TestClient):
    """The page sends a bearer token, or none, by scripts; it has its own form to sign in."""
    script = {"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"}
    assert challenges(client, script) == [BEARER_CHALLENGE]
    assert challenges(client, {"Authorization": "Bearer wrong"}) == [BEARER_CHALLENGE]


@pytest.mark.parametrize("headers", FROM_OTHER_SITES.values(), ids=FROM_OTHER_SITES)
def test_no_other_site_changes_anything_with_the_password_that_a_browser_keeps(
    client: TestClient, token: Callable[[str], str], headers: Headers, connection
):
    secret, intruder = token("admin"), f"intruder {uuid4()}"
    ask = {"json": {"name": intruder, "scopes": ["admin"]}}
    reply = client.post("/tokens", headers=basic(secret) | headers, **ask)
    assert (reply.status_code, reply.headers["content-type"]) == (403, "application/problem+json")
    assert "Bearer" in reply.json()["detail"]
    count = "select count(*) as n from token where name = %s"
    assert run_sql(connection, count, [intruder]).fetchone() == {"n": 0}
    # No browser adds a bearer token by itself.
    bearer = {"Authorization": f"Bearer {secret}"}
    assert client.post("/tokens", headers=bearer | headers, **ask).status_code == 201


def test_every_method_that_changes_something_is_protected(
    client: TestClient, token: Callable[[str], str]
):
    me = basic(token("register"))
    scene = client.post("/scenes?name=a.tif", content=TIFF, headers=me).json()["id"]
    upload = client.post("/uploads", headers=me | TUS | {"Upload-Length": "8"}).headers["location"]
    model, piece = b"LINE_OFF: 1", TUS | {"Content-Type": "application/offset+octet-stream"}
    requests: list[dict[str, Any]] = [
        {"method": "PUT", "url": f"/scenes/{scene}/files/a_RPC.TXT", "content": model},
        {"method": "PATCH", "url": upload, "content": b"II*\0", "headers": piece},
        {"method": "POST", "url": upload, "headers": TUS | {"X-HTTP-Method-Override": "DELETE"}},
        {"method": "DELETE", "url": f"/scenes/{scene}"},
    ]
    for request in requests:
        headers = me | request.pop("headers", {})
        other = client.request(**request, headers=headers | {"Origin": THERE})
        assert other.status_code == 403, request
        own = client.request(**request, headers=headers | {"Origin": HERE})
        assert own.status_code in (200, 201, 204), (request, own.text)


@pytest.mark.parametrize("headers", FROM_HERE.values(), ids=FROM_HERE)
def test_programs_and_pages_of_the_service_change_what_their_token_may(
    client: TestClient, token: Callable[[str], str], headers: Headers
):
    reply = client.post("/scenes?name=a.tif", content=TIFF, headers=basic(token("register")) | headers)
    assert reply.status_code == 201


def test_the_host_decides_behind_a_proxy_with_tls(settings: Settings, token: Callable[[str], str]):
    """The proxy passes the name on; the service itself sees HTTP."""
    settings = settings.model_copy(update={"trusted_hosts": ("gcp.example.org",)})
    with TestClient(create_app(settings), base_url="http://gcp.example.org") as client:
        for origin, status in (
            ("https://gcp.example.org", 201),
            ("https://gcp.example.org.evil.example", 403),
            ("https://evil.example", 403),
        ):
            me = basic(token("register")) | {"Origin": origin}
            reply = client.post("/scenes?name=a.tif", content=TIFF, headers=me)
            assert reply.status_code == status, origin


def test_other_sites_may_link_to_a_page_and_show_nothing_of_it(
    client: TestClient, token: Callable[[str], str]
):
    me = basic(token("read")) | {"Sec-Fetch-Site": "cross-site"}
    items = "/collections/points/items?f=html"
    assert client.get(items, headers=me | LINK).status_code == 200
    neither = {"Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"}
    for embedded in (IMAGE, FRAME, neither, LINK | {"Sec-Fetch-Mode": "no-cors"}):
        assert client.get(items, headers=me | embedded).status_code == 403, embedded
    # Without TLS a browser states no site.
    del me["Sec-Fetch-Site"]
    policy = "cross-origin-resource-policy"
    assert client.get(items, headers=me).headers[policy] == "same-origin"
    assert policy not in client.get(items, headers={"Authorization": "Bearer x"}).headers


def test_the_origins_of_a_setting_send_bearer_tokens_only(
    settings: Settings, token: Callable[[str], str]
):
    settings = settings.model_copy(update={"cors_origins": (THERE,)})
    with TestClient(create_app(settings), base_url=HERE) as client:
        secret, origin = token("register"), {"Origin": THERE}
        sent = {"url": "/scenes?name=a.tif", "content": TIFF}
        assert client.post(headers=basic(secret) | origin, **sent).status_code == 403
        bearer = {"Authorization": f"Bearer {secret}"}
        assert client.post(headers=bearer | origin, **sent).status_code == 201


def test_the_log_and_the_audit_name_the_token_and_hold_no_secret(
    settings: Settings, dsn: str, client: TestClient, token: Callable[[str], str], caplog, connection
):
    secret = token("register")
    caplog.set_level(logging.DEBUG)
    headers = basic(secret, "user-7f3a91")
    holder = client.get("/tokens/self", headers=headers).json()
    assert client.post("/scenes?name=a.tif", content=TIFF, headers=headers).status_code == 201
    assert client.get("/jobs", headers=basic(f"{secret}x", "user-7f3a91")).status_code == 401
    changes = "select kind, actor_name from audit where actor = %s and action = 'created'"
    assert run_sql(connection, changes, [holder["id"]]).fetchall() == [
        {"kind": "scene", "actor_name": holder["name"]}
    ]
    everything = caplog.text + str(run_sql(connection, "select audit::text from audit").fetchall())
    for hidden in (secret, headers["Authorization"].split()[1], "user-7f3a91"):
        assert hidden not in everything


def test_both_ways_share_the_turns_of_the_token(
    client: TestClient, token: Callable[[str], str], app_keys
):
    secret = token("read")
    for headers in (basic(secret), {"Authorization": f"Bearer {secret}"}):
        assert client.get("/collections/points/items", headers=headers).status_code == 200
    assert len(app_keys) == 2
    assert app_keys[0] == app_keys[1] is not None


@pytest.fixture
def app_keys(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Whose turns the requests of this test take."""
    keys: list[object] = []

    def noted(*arguments):
        keys.append(_key(*arguments))
        return keys[-1]

    monkeypatch.setattr("amers.app.api.routes._key", noted)
    return keys


def test_the_description_of_the_api_names_both_ways(client: TestClient):
    document = client.get("/api").json()
    schemes = document["components"]["securitySchemes"]
    kinds = {name: (item["type"], item["scheme"]) for name, item in schemes.items()}
    assert kinds == {"bearer": ("http", "bearer"), "basic": ("http", "basic")}
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            by_scheme = {name: item[name] for item in operation["security"] for name in item}
            assert by_scheme.get("bearer") == by_scheme.get("basic"), (method, path)
