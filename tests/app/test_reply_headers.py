"""Headers of replies, names of the service in `Host`, and what tus demands of every reply."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from amers.app.config import Settings
from amers.app.main import create_app
from tests.app.callers import Bearer, Caller
from tests.app.sending import PIECE, TUS, begun

pytestmark = pytest.mark.security

TIFF = b"II*\0" + bytes(100)


def operations(client: TestClient) -> Iterator[tuple[str, str]]:
    """Method and path of every operation of the API description, parameters replaced by a number."""
    for path, methods in client.get("/api").json()["paths"].items():
        for method in methods:
            if method in ("get", "head", "post", "put", "patch", "delete", "options"):
                filled = "/".join("1" if part.startswith("{") else part for part in path.split("/"))
                yield method.upper(), filled


def test_every_reply_forbids_guesses_of_its_type_and_storing(client: TestClient, bearer: Bearer):
    number = 0
    for headers in ({}, bearer("admin")):
        for method, path in operations(client):
            reply = client.request(method, path, headers=headers)
            number += 1
            assert reply.headers["x-content-type-options"] == "nosniff", (method, path)
            caching = reply.headers["cache-control"]
            assert caching == "no-store" or (reply.is_success and "public" not in caching), (
                method,
                path,
            )
    assert number > 100
    for path in ("/nothing", "/map/nothing"):
        assert client.get(path).headers["cache-control"] == "no-store"


def test_files_are_not_stored_and_not_guessed(me: Caller):
    scene = me.post("/scenes?name=a.tif", content=TIFF).json()["id"]
    reply = me.get(f"/scenes/{scene}/files/a.tif")
    assert reply.content == TIFF
    assert reply.headers["cache-control"] == "no-store"
    assert reply.headers["x-content-type-options"] == "nosniff"
    parts = (part.strip().partition(" ") for part in reply.headers["content-security-policy"].split(";"))
    policy = {name: sources for name, _, sources in parts}
    assert (policy["default-src"], policy["sandbox"]) == ("'none'", ""), "a page among them runs nothing"
    assert not policy.keys() & {"script-src", "script-src-elem", "connect-src", "form-action"}


def test_the_reply_to_an_unexpected_error_has_the_headers_too(settings: Settings):
    app = create_app(settings)

    @app.get("/broken")
    def broken() -> None:
        raise RuntimeError

    with TestClient(app, raise_server_exceptions=False) as client:
        reply = client.get("/broken")
    assert reply.status_code == 500
    assert reply.headers["cache-control"] == "no-store"
    assert reply.headers["x-content-type-options"] == "nosniff"


def test_tiles_and_the_map_keep_their_own_caching(client: TestClient, bearer: Bearer):
    tile = bearer("read").get("/collections/points/tiles/WebMercatorQuad/0/0/0")
    assert (tile.status_code, tile.headers["cache-control"]) == (200, "private, no-cache")
    headers = bearer("read") | {"If-None-Match": tile.headers["etag"]}
    again = client.get("/collections/points/tiles/WebMercatorQuad/0/0/0", headers=headers)
    assert again.status_code == 304


def test_a_host_that_is_no_name_of_the_service_is_refused(client: TestClient):
    for host in [
        "evil.example",
        "evil.example:8000",
        "localhost.evil.example",
        "169.254.169.254",
        "[::2]",
        "",
    ]:
        reply = client.get("/", headers={"Host": host})
        assert reply.status_code == 400, host
        assert reply.headers["content-type"] == "application/problem+json", host
        assert "AMERS_TRUSTED_HOSTS" in reply.json()["detail"], host
        assert reply.headers["cache-control"] == "no-store", host


def test_the_own_names_of_a_service_are_accepted(client: TestClient):
    """`testserver` is the address at which the client of the tests arrives."""
    for host in ["localhost", "LOCALHOST:80", "127.0.0.1:8000", "[::1]:8000", "testserver"]:
        assert client.get("/", headers={"Host": host}).status_code == 200, host


@pytest.mark.parametrize(
    ("trusted", "host", "status"),
    [
        ("gcp.example.org", "gcp.example.org", 200),
        ("gcp.example.org", "www.gcp.example.org", 400),
        ("gcp.example.org", "agcp.example.org", 400),
        ("gcp.example.org", "gcp.example.org.evil.example", 400),
        ("*.example.org, other.example", "gcp.example.org:443", 200),
        ("*.example.org, other.example", "other.example", 200),
        ("*.example.org", "example.org", 400),
        ("*.example.org", "badexample.org", 400),
        ("*.example.org", "a.gcp.example.org", 200),
        ("*", "anything.example", 200),
    ],
)
def test_a_public_name_is_accepted_where_the_settings_name_it(
    dsn: str, tmp_path: Path, trusted: str, host: str, status: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("AMERS_TRUSTED_HOSTS", trusted)
    settings = Settings(database_url=dsn, data_folder=tmp_path / "data")
    with TestClient(create_app(settings)) as client:
        reply = client.get("/", headers={"Host": host})
    assert reply.status_code == status
    if status == 200:
        assert f"http://{host}/" in reply.text, "links have the name that the caller uses"


def test_replies_to_uploads_name_the_version_of_tus_whatever_they_say(client: TestClient, me: Caller):
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    offset = {"Upload-Offset": "5"}
    replies = {
        400: client.patch(
            url, headers=me | TUS | PIECE | {"Upload-Offset": "0", "Upload-Checksum": "md5 x"}
        ),
        401: client.head(url, headers=TUS),
        404: client.head("/uploads/no-id", headers=me | TUS),
        405: client.put(url, headers=me | TUS),
        409: client.patch(url, content=b"x", headers=me | TUS | PIECE | offset),
        412: me.head(url),
        413: client.patch(url, content=TIFF * 2, headers=me | TUS | PIECE | {"Upload-Offset": "0"}),
        415: client.patch(url, content=b"x", headers=me | TUS | offset),
    }
    for status, reply in replies.items():
        assert (reply.status_code, reply.headers.get("tus-resumable")) == (status, "1.0.0"), reply.text


def test_a_post_stands_for_the_method_that_its_header_names(client: TestClient, me: Caller):
    me = me | TUS
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]

    def override(method: str, **more: str) -> dict[str, str]:
        return me | {"X-HTTP-Method-Override": method} | more

    half = client.post(
        url, content=TIFF[:50], headers=override("PATCH", **{"Upload-Offset": "0"}) | PIECE
    )
    assert (half.status_code, half.headers["upload-offset"]) == (204, "50")
    assert client.post(url, headers=override("HEAD")).headers["upload-offset"] == "50"
    assert client.post(url, headers=override("DELETE")).status_code == 204
    assert client.head(url, headers=me).status_code == 404
    wrong = client.post(url, headers=override("PUT"))
    assert (wrong.status_code, wrong.headers["tus-resumable"]) == (400, "1.0.0")
    assert "PATCH" in wrong.json()["detail"]


def test_no_other_path_and_no_other_method_is_overridden(me: Caller):
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    overriding = me | {"X-HTTP-Method-Override": "DELETE"}
    scene = overriding.scene(TIFF, "name=a.tif")
    assert overriding.post(f"/scenes/{scene}").status_code == 405
    assert overriding.get(url).json()["state"] == "arriving"
    assert overriding.get(f"/scenes/{scene}").status_code == 200
