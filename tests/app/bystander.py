"""A caller who asks for one point once a second while others attack the service, and what he notices.

```
with bystander(served.url, path, served.authorization) as second_caller:
    attack()
second_caller.check()
```
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection, HTTPException
from statistics import median
from urllib.parse import urlsplit

PAUSE_S = 1.0
MOST_SLOWDOWN = 3.0
LEAST_USUAL_S = 0.05
"""On cores that other tests share, the usual latency is not measured better than this."""
TIMEOUT_S = 5.0
"""A reply that takes longer is an error."""
QUIET_REQUESTS = 15


class Bystander:
    """What one caller met, before and during an attack.

    Attributes:
        usual_s: median latency before the attack, each request on a connection of its own.
        latencies_s: of the requests during the attack.
        errors: of the requests during the attack: exceptions, and statuses other than 200.
    """

    def __init__(self, url: str, path: str, headers: dict[str, str]) -> None:
        self._address = urlsplit(url).netloc
        self._path = path
        self._headers = headers
        self.latencies_s: list[float] = []
        self.errors: list[str] = []
        self.usual_s = self._median_s()
        self.latencies_s.clear()

    def _median_s(self) -> float:
        """Median latency of requests one after another, while nobody attacks."""
        quiet_s = [self._ask() for _ in range(QUIET_REQUESTS)]
        assert self.errors == []
        return median(quiet_s)

    def _ask(self) -> float:
        started = time.perf_counter()
        connection = HTTPConnection(self._address, timeout=TIMEOUT_S)
        try:
            connection.request("GET", self._path, headers=self._headers)
            reply = connection.getresponse()
            body = reply.read()
            if reply.status != 200:
                self.errors.append(f"{reply.status} {body[:300]!r}")
        except (OSError, HTTPException) as error:
            self.errors.append(repr(error))
        finally:
            connection.close()
        latency_s = time.perf_counter() - started
        self.latencies_s.append(latency_s)
        return latency_s

    def ask_until(self, stop: threading.Event, pause_s: float) -> None:
        """Ask again and again, at least once."""
        self._ask()
        while not stop.wait(pause_s):
            self._ask()

    def check(self) -> None:
        """Compare what the caller met during the attack with what he is used to, before it and after.

        A machine whose cores others use may have become slower meanwhile: then it still is.

        Raises:
            AssertionError: a request failed, or the median latency is more than three times the usual.
        """
        assert self.errors == []
        met_s, usual_s = list(self.latencies_s), max(self.usual_s, LEAST_USUAL_S)
        if median(met_s) > MOST_SLOWDOWN * usual_s:
            usual_s = max(usual_s, self._median_s())
        assert median(met_s) <= MOST_SLOWDOWN * usual_s, (self.usual_s, usual_s, met_s)


@contextmanager
def bystander(
    url: str, path: str, headers: dict[str, str], pause_s: float = PAUSE_S
) -> Iterator[Bystander]:
    """A second caller of a running service, who asks until the end of the context.

    Args:
        url: of the service, `http://HOST:PORT`.
        path: what he asks for, with a short reply.
        pause_s: between his requests; tests of a few seconds need it shorter.
    """
    caller = Bystander(url, path, headers)
    stop = threading.Event()
    asking = threading.Thread(target=caller.ask_until, args=(stop, pause_s), name="bystander")
    asking.start()
    try:
        yield caller
    finally:
        stop.set()
        asking.join()
