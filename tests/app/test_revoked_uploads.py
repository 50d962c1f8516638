"""A token that is revoked while its owner sends a file: the upload ends, and nothing is acknowledged."""

from base64 import b64encode
from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi import Request
from fastapi.testclient import TestClient

from amers.app.api import sent_body
from amers.app.api.body import body_chunks
from amers.app.storage import Storage
from tests.app.callers import Bearer
from tests.app.conftest import stored_files
from tests.statements import run_sql

pytestmark = pytest.mark.security

TIFF = b"II*\0" + bytes(1000)
TUS = {"Tus-Resumable": "1.0.0"}


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
    client: TestClient,
    bearer: Bearer,
    storage: Storage,
    ending: list[int],
    monkeypatch: pytest.MonkeyPatch,
    check_s: float,
) -> None:
    monkeypatch.setattr(sent_body, "CHECK_S", check_s)
    reply = client.post("/scenes?name=a.tif", content=TIFF, headers=bearer("register"))
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
    me = bearer("register") | TUS
    name = b64encode(b"a.tif").decode()
    announced = {"Upload-Length": str(len(TIFF)), "Upload-Metadata": f"filename {name}"}
    place = Path(client.post("/uploads", headers=me | announced).headers["location"]).name
    piece = {"Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    reply = client.patch(f"/uploads/{place}", content=TIFF, headers=me | piece)
    assert reply.status_code == 401
    (row,) = run_sql(connection, "select finished_at from upload").fetchall()
    assert row["finished_at"] is None
