"""A bystander notices what an attack does, and not that the machine has become slower."""

import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from tests.app.bystander import LEAST_USUAL_S, MOST_SLOWDOWN, bystander

SLOW_S = 1.1 * MOST_SLOWDOWN * LEAST_USUAL_S


class _Server(ThreadingHTTPServer):
    takes_s = 0.0


class _Replies(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        assert isinstance(self.server, _Server)
        time.sleep(self.server.takes_s)
        self.send_response(200)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Nothing."""


@pytest.fixture
def server() -> Iterator[_Server]:
    with _Server(("127.0.0.1", 0), _Replies) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.mark.parametrize("after_s", [0.0, SLOW_S])
def test_only_what_ends_with_the_attack_is_its_doing(server: _Server, after_s: float) -> None:
    url = f"http://127.0.0.1:{server.server_address[1]}"
    with bystander(url, "/", {}, pause_s=0.05) as caller:
        server.takes_s = SLOW_S
        time.sleep(3.0 * SLOW_S)
    server.takes_s = after_s
    if after_s > 0.0:
        caller.check()
    else:
        with pytest.raises(AssertionError):
            caller.check()
