"""The Python client while a service does not answer, as when it starts again."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import islice
from threading import Thread
from types import SimpleNamespace

import pytest

from amers.app.client import Client, Job, RequestRefused, ServiceFailure
from amers.app.client import client as client_module

JOB = {"jobID": "7", "processID": "register-scene", "status": "running", "progress": 50, "message": ""}
RUNNING = Job.of(JOB)
ENDED = {**JOB, "status": "successful", "progress": 100}
long_enough_s = 60.0


@pytest.fixture(autouse=True)
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Polls follow each other at once."""
    monkeypatch.setattr(client_module, "POLL_S", 0.0)


@contextmanager
def serving(replies: type[BaseHTTPRequestHandler]) -> Iterator[str]:
    """The address of a server of these replies."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), replies)
    thread = Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextmanager
def service(*statuses: int) -> Iterator[Client]:
    """A client of a service that replies to each request with the next status, then that the job ended.

    A status of 0 closes the connection without a reply.
    """
    left = list(statuses)

    class Replies(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            status = left.pop(0) if left else 200
            if status == 0:
                self.close_connection = True
                return
            body = json.dumps(ENDED if status == 200 else {"detail": "not now"}).encode()
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        log_message: Callable[..., None] = lambda *_: None

    with serving(Replies) as url, Client(url) as client:
        yield client
    assert left == []


def test_a_job_is_waited_for_through_an_outage():
    with service(0, 503, 500, 429, 408) as client:
        assert client.wait(RUNNING, timeout_s=long_enough_s).status == "successful"


@pytest.mark.parametrize("status", [401, 404])
def test_a_refusal_that_will_stay_ends_the_waiting_at_once(status):
    with service(status) as client, pytest.raises(RequestRefused):
        client.wait(RUNNING, timeout_s=long_enough_s)


@pytest.mark.parametrize(("answers", "ends"), [("-r-r-r-s", True), ("r--s", False), ("--s", False)])
def test_an_outage_that_lasts_from_the_last_answer_on_ends_the_waiting(monkeypatch, answers, ends):
    """Polls are as far apart as the longest outage: one without an answer is waited for, two are not."""
    now_s, client, left = [0.0], Client("http://amers.invalid"), iter(answers)

    def job(_id: str) -> Job:
        answer = next(left)
        if answer == "-":
            raise ServiceFailure("not now")
        return RUNNING if answer == "r" else Job.of(ENDED)

    def sleep(seconds: float) -> None:
        now_s[0] += seconds

    monkeypatch.setattr(client, "job", job)
    monkeypatch.setattr(client_module, "POLL_S", client_module.OUTAGE_S)
    monkeypatch.setattr(client_module, "time", SimpleNamespace(monotonic=lambda: now_s[0], sleep=sleep))
    with nullcontext() if ends else pytest.raises(ServiceFailure, match="not now"):
        assert client.wait(RUNNING).status == "successful"


@pytest.mark.parametrize("form", ["features", "csv"])
def test_pages_whose_links_form_a_ring_end_with_a_sentence(form: str):
    """A server that repeats a token would be read for ever."""

    class Ring(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            links = [{"rel": "next", "body": {"token": "again"}}]
            self.reply(json.dumps({"features": [{}], "links": links}).encode())

        def do_GET(self) -> None:
            self.reply(b"id\r\n1\r\n")

        def reply(self, body: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.send_header(client_module.NEXT_TOKEN, "again")
            self.end_headers()
            self.wfile.write(body)

        log_message: Callable[..., None] = lambda *_: None

    with serving(Ring) as url, Client(url) as client:
        pages = client.csv("points") if form == "csv" else client.features("points")
        with pytest.raises(ServiceFailure, match="already read"):
            list(islice(pages, 10))
