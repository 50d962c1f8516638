"""Filters that ended or froze the service, sent to a running one while a second caller asks on."""

import statistics
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from amers.app.db.cluster.embedded import Cluster
from tests.app.filter_attacks import NAMED
from tests.app.running_service import Served, service_with_a_block
from tests.app.worker_processes import children

pytestmark = [pytest.mark.security, pytest.mark.long]

SEARCH = "/collections/points/search"
LONGEST_REFUSAL_S = 10.0
"""A refusal takes milliseconds; this is for a machine that does much else."""
SLOWER = 3.0
NOTICEABLE_S = 0.05
"""A usual latency below this counts as this: differences of milliseconds are the machine's."""
ASKED = 30

LARGEST = {
    "conditions": "saliency>1 and " * 265 + "saliency>1",
    "a list": "n_views in (" + "1," * 989 + "1)",
    "a sum": "saliency = " + "1+" * 31 + "1",
    "minus signs": "saliency = " + "-" * 31 + "1",
    "not": "not " * 31 + "saliency = 1",
    "parentheses": "(" * 16 + "saliency > 1" + ")" * 16,
    "positions": "s_intersects(geometry, GEOMETRYCOLLECTION(" + ",".join(["POINT(1 2)"] * 355) + "))",
    "functions": "casei(" * 16 + "typology" + ")" * 16 + " = 'a'",
}
"""The largest filters that are accepted."""


@pytest.fixture(scope="module")
def served(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with service_with_a_block(cluster, tmp_path_factory.mktemp("filters"), "read") as served:
        yield served


def search(served: Served, text: str) -> httpx.Response:
    content = {"filter": text, "filter-lang": "cql2-text", "limit": 1}
    return httpx.post(served.url + SEARCH, json=content, headers=served.authorization, timeout=60)


def test_named_attacks_are_refused_and_a_second_caller_notices_nothing(served: Served) -> None:
    usual_s = [ask(served) for _ in range(ASKED)]
    processes = children(served.pid)
    stop, waits_s, errors = threading.Event(), [], []

    def ask_on() -> None:
        while not stop.is_set():
            try:
                waits_s.append(ask(served))
            except (httpx.HTTPError, AssertionError) as error:
                errors.append(error)
            time.sleep(0.02)

    second = threading.Thread(target=ask_on)
    second.start()
    try:
        for name, text in NAMED.items():
            if "\ud800" in text:
                continue  # Bodies with it are refused as a whole.
            begin = time.monotonic()
            reply = search(served, text)
            assert reply.status_code == 400, f"{name}: {reply.status_code} {reply.text[:300]}"
            assert "filter" in reply.json()["detail"], name
            assert time.monotonic() - begin < LONGEST_REFUSAL_S, name
    finally:
        stop.set()
        second.join()
    assert not errors
    assert statistics.median(waits_s) <= SLOWER * max(statistics.median(usual_s), NOTICEABLE_S)
    assert set(processes) <= set(children(served.pid)), "no process was lost"
    assert Path(f"/proc/{served.pid}").exists(), "the API has not been restarted"


@pytest.mark.parametrize("text", LARGEST.values(), ids=LARGEST.keys())
def test_the_largest_filters_are_answered(served: Served, text: str) -> None:
    reply = search(served, text)
    assert reply.status_code == 200, reply.text[:300]


def ask(served: Served) -> float:
    """How long a small request with a filter takes; an error unless it is answered, in seconds."""
    begin = time.monotonic()
    reply = httpx.get(
        f"{served.url}/collections/points/items",
        params={"filter": "saliency > 0", "limit": 1},
        headers=served.authorization,
        timeout=60,
    )
    assert reply.status_code == 200, reply.text[:300]
    return time.monotonic() - begin
