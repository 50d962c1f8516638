"""A token that is revoked while its owner sends a file: the upload ends, and nothing is acknowledged."""

from collections.abc import Iterator

import pytest
from fastapi import Request
from fastapi.testclient import TestClient

from amers.app.api import sent_body
from amers.app.api.body import body_chunks
from amers.app.storage import Storage
from tests.app.callers import Bearer
from tests.app.conftest import stored_files
from tests.app.sending import begun, piece
from tests.statements import run_sql

pytestmark = pytest.mark.security

TIFF = b"II*\0" + bytes(1000)


@pytest.fixture(params=["revoked_at = now()", "expires_at = now() - interval '1 second'"])
def ending(request: pytest.FixtureRequest, connection, monkeypatch) -> list[int]:
    """Tokens end after the first chunk of a body; the sizes of the chunks that were read after that."""
    read: list[int] = []

    def chunks(sent: Request) -> Iterator[bytes]:
        for body in body_chunks(sent):
            run_sql(connection, f"update token set {request.param}")
            connection.commit()
            yield body[:100]
            for first in range(100, len(body), 100):
                read.append(len(body[first : first + 100]))
                yield body[first : first + 100]

    monkeypatch.setattr(sent_body, "body_chunks", chunks)
    return read


@pytest.mark.parametrize("check_s", [0.0, 3600.0], ids=["while it arrives", "when all has arrived"])
def test_an_upload_ends_with_the_token(
    bearer: Bearer,
    storage: Storage,
    ending: list[int],
    monkeypatch: pytest.MonkeyPatch,
    check_s: float,
) -> None:
    monkeypatch.setattr(sent_body, "CHECK_S", check_s)
    reply = bearer("register").post("/scenes?name=a.tif", content=TIFF)
    assert reply.status_code == 401
    assert (len(ending) > 1) == (check_s > 0.0)
    assert [path for path in stored_files(storage) if path.suffix == ".tif"] == []


@pytest.mark.parametrize("check_s", [0.0, 3600.0], ids=["while it arrives", "when all has arrived"])
def test_a_resumable_upload_ends_with_the_token(
    client: TestClient,
    bearer: Bearer,
    connection,
    ending: list[int],
    monkeypatch: pytest.MonkeyPatch,
    check_s: float,
) -> None:
    monkeypatch.setattr(sent_body, "CHECK_S", check_s)
    me = bearer("register")
    url = begun(me, len(TIFF), filename="a.tif").headers["location"]
    assert piece(me, url, 0, TIFF).status_code == 401
    (row,) = run_sql(connection, "select finished_at from upload").fetchall()
    assert row["finished_at"] is None
