"""The session of a browser, which opens the HTML pages."""

import time
from collections.abc import Callable
from uuid import uuid4

import anyio
import pytest
from fastapi.testclient import TestClient

from amers.app.api import session_cookie
from amers.app.api.session_cookie import COOKIE, LIFETIME_S, format_session
from amers.app.main import create_app
from amers.app.usecases.features.items import page_secret
from tests.statements import run_sql

pytestmark = pytest.mark.security

PAGE = "/collections/points/items?f=html"
MINE = "/tokens/self"
THERE = "https://elsewhere.example"


@pytest.fixture
def signed_in(client: TestClient, token: Callable[[str], str]) -> TestClient:
    """A browser that has signed in with scope `admin`."""
    assert client.post("/sign-in", data={"token": token("admin")}).status_code == 200
    return client


def test_a_session_shows_the_pages_that_the_token_may_read(client, token):
    assert client.get(PAGE).status_code == 401
    reply = client.post("/sign-in", data={"token": f" {token('read')} "}, follow_redirects=False)
    assert (reply.status_code, reply.headers["location"]) == (303, "http://testserver/")
    assert client.get(PAGE).status_code == 200
    assert client.get(MINE).json()["name"] == "a token to read"
    assert client.get("/tokens").status_code == 403, "the scopes are those of the token"


def test_the_cookie_is_short_lived_and_out_of_reach_of_scripts_and_other_sites(client, token):
    secret = token("read")
    for base, is_secure in (("http://testserver", False), ("https://testserver", True)):
        reply = client.post(f"{base}/sign-in", data={"token": secret}, follow_redirects=False)
        cookie = reply.headers["set-cookie"]
        words = {word.strip().lower() for word in cookie.split(";")}
        assert {"httponly", "samesite=lax", "path=/", f"max-age={LIFETIME_S}"} <= words
        assert ("secure" in words) == is_secure
        assert secret not in cookie


def test_behind_a_proxy_the_cookie_is_sent_to_this_service_and_to_no_other_of_its_host(settings, token):
    with TestClient(create_app(settings), root_path="/points") as client:
        made = client.post("/sign-in", data={"token": token("read")}, follow_redirects=False)
        ended = client.post("/sign-out", follow_redirects=False)
    for reply in (made, ended):
        words = {word.strip().lower() for word in reply.headers["set-cookie"].split(";")}
        assert "path=/points/" in words
        assert reply.headers["location"] == "http://testserver/points/"


def test_a_session_changes_nothing(signed_in, connection):
    body = {"name": "forged", "scopes": ["admin"]}
    for headers in ({}, {"Sec-Fetch-Site": "same-origin"}, {"Origin": THERE}):
        assert signed_in.post("/tokens", json=body, headers=headers).status_code == 401
    mine = signed_in.get(MINE).json()["id"]
    assert signed_in.delete(f"/tokens/{mine}").status_code == 401
    names = run_sql(connection, "select name from token where revoked_at is null").fetchall()
    assert names == [{"name": "a token to admin"}]


def test_pages_of_other_sites_get_nothing_with_a_session(signed_in):
    other = {"Sec-Fetch-Site": "cross-site"}
    image = {"Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}
    link = {"Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}
    assert signed_in.get(PAGE, headers=other | image).status_code == 403
    assert signed_in.get(PAGE, headers=other | link).status_code == 200
    assert signed_in.get(PAGE).headers["cross-origin-resource-policy"] == "same-origin"


@pytest.mark.parametrize("headers", [{"Sec-Fetch-Site": "cross-site"}, {"Origin": THERE}])
def test_no_other_site_signs_a_browser_in_or_out(client, token, headers):
    data = {"token": token("read")}
    assert client.post("/sign-in", data=data, headers=headers).status_code == 403
    assert COOKIE not in client.cookies
    assert client.post("/sign-in", data=data).status_code == 200
    assert client.post("/sign-out", headers=headers).status_code == 403
    assert client.get(PAGE).status_code == 200


def test_a_browser_signs_out(signed_in):
    assert "Sign out" in signed_in.get("/?f=html").text
    signed_in.post("/sign-out")
    assert COOKIE not in signed_in.cookies
    assert "Sign in" in signed_in.get("/?f=html").text
    assert signed_in.get(PAGE).status_code == 401


def test_signing_out_ends_the_session_itself_and_no_other(client, token, connection):
    """A copy of the cookie opens nothing any more; the same token in another browser does."""
    secret = token("read")
    cookies = []
    for _ in range(2):
        client.cookies.clear()
        client.post("/sign-in", data={"token": secret})
        cookies.append(client.cookies[COOKIE])
    other, mine = cookies
    client.post("/sign-out")
    client.cookies.clear()

    def status(cookie: str) -> int:
        return client.get(MINE, headers={"Cookie": f"{COOKIE}={cookie}"}).status_code

    assert (status(mine), status(other)) == (401, 200)
    assert client.post("/sign-out", headers={"Cookie": f"{COOKIE}={mine}"}).status_code == 200
    assert client.post("/sign-out", headers={"Cookie": f"{COOKIE}=forged"}).status_code == 200
    assert len(run_sql(connection, "select id from ended_session").fetchall()) == 1


def test_a_session_that_was_signed_out_is_forgotten_with_its_hour(client, token, connection):
    for _ in range(2):
        client.post("/sign-in", data={"token": token("read")})
        client.post("/sign-out")
        run_sql(connection, "update ended_session set ends_at = now() - interval '1 second'")
        connection.commit()
    assert len(run_sql(connection, "select id from ended_session").fetchall()) == 1


@pytest.mark.parametrize("path", ["/sign-in", "/scenes?name=a.tif", "/collections/points/search"])
def test_a_caller_who_leaves_in_the_middle_of_a_request_is_no_error_of_the_service(
    settings, bearer, caplog, path
):
    sent = []

    async def leave() -> None:
        path_, _, query = path.partition("?")
        headers = {"host": "localhost", "content-length": "100", **bearer("register")}
        scope = {
            "type": "http",
            "asgi": {"version": "3.0", "spec_version": "2.3"},
            "http_version": "1.1",
            "method": "POST",
            "scheme": "http",
            "path": path_,
            "raw_path": path_.encode(),
            "root_path": "",
            "query_string": query.encode(),
            "headers": [(key.lower().encode(), value.encode()) for key, value in headers.items()],
            "client": ("127.0.0.1", 50000),
            "server": ("localhost", 8000),
        }
        messages = iter([{"type": "http.request", "body": b"token=", "more_body": True}])

        async def receive():
            return next(messages, {"type": "http.disconnect"})

        async def send(message):
            sent.append(message)

        application = create_app(settings)
        async with application.router.lifespan_context(application):
            await application(scope, receive, send)

    with caplog.at_level("INFO"):
        anyio.run(leave)
    assert [record for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")] == []
    assert [m["status"] for m in sent if m["type"] == "http.response.start" and m["status"] >= 500] == []
    (line,) = [record for record in caplog.records if record.name == "amers.requests"]
    assert line.status < 500


def test_beside_a_token_in_the_header_a_session_neither_helps_nor_hinders(signed_in, bearer):
    """A script of another site may send its own token, whatever cookies the browser adds."""
    script = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "cors", "Sec-Fetch-Dest": "empty"}
    assert signed_in.get(MINE, headers=script).status_code == 403
    reply = signed_in.get(MINE, headers=script | bearer("read"))
    assert (reply.status_code, reply.json()["name"]) == (200, "a token to read")
    wrong = {"Authorization": "Bearer wrong"}
    assert signed_in.get(MINE, headers=wrong).status_code == 401
    assert signed_in.get(MINE, headers=script | wrong).status_code == 401


def test_a_wrong_token_opens_no_session(client):
    for body in ("token=wrong", "token=%00%ff", "token=", "", "a=b"):
        headers = {"Content-Type": "application/x-www-form-urlencoded"}
        reply = client.post("/sign-in", content=body, headers=headers)
        assert (reply.status_code, reply.headers["content-type"][:9]) == (403, "text/html")
        assert "unknown, expired or revoked" in reply.text
        assert COOKIE not in client.cookies


def test_a_session_ends_with_its_hour_and_with_its_token(client, token, connection):
    client.post("/sign-in", data={"token": token("read")})
    mine = client.get(MINE).json()["id"]
    secret = page_secret(connection)
    client.cookies.clear()

    def status(cookie: str) -> int:
        return client.get(MINE, headers={"Cookie": f"{COOKIE}={cookie}"}).status_code

    assert status(format_session(mine, time.time() - LIFETIME_S + 60.0, secret)) == 200
    assert status(format_session(mine, time.time() - LIFETIME_S - 1.0, secret)) == 401
    run_sql(connection, "update token set revoked_at = now()")
    connection.commit()
    assert status(format_session(mine, time.time(), secret)) == 401


def test_a_forged_session_is_refused(client, token, connection):
    client.post("/sign-in", data={"token": token("read")})
    value = client.cookies[COOKIE]
    client.cookies.clear()
    token_id, session_id, end_s, seal = value.split(".")
    forged = (
        f"{token_id}.{session_id}.{int(end_s) + 1}.{seal}",
        f"{token_id}.{uuid4()}.{end_s}.{seal}",
        f"{uuid4()}.{session_id}.{end_s}.{seal}",
        f"{token_id}.{session_id}.{end_s}.",
        f"{token_id}.{end_s}.{seal}",
        format_session(token_id, time.time(), b"another installation"),
        "x",
        "..",
        "\xe9.\xe9.\xe9",
    )
    for cookie in forged:
        header = f"{COOKIE}={cookie}".encode("latin-1")
        assert client.get(MINE, headers=[(b"cookie", header)]).status_code == 401, cookie
    assert client.get(MINE, headers={"Cookie": f"{COOKIE}={value}"}).status_code == 200


def test_with_a_session_that_has_ended_a_browser_sees_what_is_public(
    client, settings, token, connection
):
    """The reply removes the cookie, so that the next request comes without it."""
    client.app.state.settings = settings.model_copy(update={"public_points": True})
    assert client.post("/sign-in", data={"token": token("read")}).status_code == 200
    value = client.cookies[COOKIE]
    run_sql(connection, "update token set revoked_at = now()")
    connection.commit()
    ended = (value, format_session(uuid4(), time.time(), b"another installation"), "x")
    for cookie in ended:
        client.cookies.clear()
        client.cookies.set(COOKIE, cookie, domain="testserver.local", path="/")
        reply = client.get(PAGE)
        assert reply.status_code == 200, cookie
        assert COOKIE not in client.cookies
        client.cookies.set(COOKIE, cookie, domain="testserver.local", path="/")
        assert client.get("/tokens").status_code == 401
        assert COOKIE not in client.cookies


def test_a_session_that_lasts_keeps_its_cookie(signed_in):
    assert "set-cookie" not in signed_in.get(PAGE).headers
    assert COOKIE in signed_in.cookies


def test_a_token_in_the_header_comes_before_the_session(signed_in, bearer):
    assert signed_in.get(MINE, headers=bearer("read")).json()["name"] == "a token to read"
    assert session_cookie.COOKIE in signed_in.cookies
