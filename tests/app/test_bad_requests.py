"""Wrong and hostile requests: each is refused with a clear 4xx, changes nothing and reveals nothing."""

import json
from base64 import b64encode
from collections.abc import Iterator

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.app.bad_deliveries import DELIVERIES
from tests.app.bad_requests import BAD_REQUESTS, JSON, Bad
from tests.app.conftest import TEMPLATE, fresh_database
from tests.app.flat_world import make_flat_world
from tests.app.hostile_installation import CANARY, Installation, hostile_installation, told

pytestmark = pytest.mark.security

CASES = [*BAD_REQUESTS, *DELIVERIES]


@pytest.fixture(scope="module")
def store(cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installation]:
    """One installation for all cases: they change nothing."""
    folder = tmp_path_factory.mktemp("hostile_installation")
    with (
        fresh_database(cluster, TEMPLATE) as dsn,
        hostile_installation(dsn, folder, make_flat_world(folder / "world", size=600)) as store,
    ):
        yield store


def reply_to(store: Installation, case: Bad) -> httpx.Response:
    """The reply to a case, whose placeholders are replaced by ids of the installation."""
    headers = {name: store.filled(value).encode("latin-1") for name, value in case.headers.items()}
    if case.metadata:
        pairs = (
            f"{name} {b64encode(store.filled(value).encode()).decode()}"
            for name, value in case.metadata.items()
        )
        headers["Upload-Metadata"] = ",".join(pairs).encode()
    content = case.content
    if case.json is not None:
        content = store.filled(json.dumps(case.json)).encode()
        headers |= {name: value.encode() for name, value in JSON.items()}
    elif content is not None and len(content) < 1000:
        content = store.filled(content.decode("latin-1")).encode("latin-1")
    return store.client.request(
        case.method,
        store.filled(case.path),
        content=content,
        headers={**store.headers[case.who], **headers},
    )


@pytest.fixture
def untouched(store: Installation) -> Iterator[None]:
    """Checks that a test changes no row and no file."""
    before = store.known_digest()
    yield
    assert store.digest() == before


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_bad_request_is_refused_clearly_and_changes_nothing(store: Installation, untouched, case: Bad):
    reply = reply_to(store, case)
    assert 400 <= reply.status_code < 500, f"{reply.status_code} {reply.text[:500]}"
    assert case.status in (None, reply.status_code), f"{reply.status_code} {reply.text[:500]}"
    assert reply.headers["content-type"] == "application/problem+json"
    refusal = reply.json()
    assert case.says in refusal["detail"], refusal
    assert len(refusal["detail"]) > 5, refusal
    assert CANARY not in told(reply)
    assert "Traceback" not in told(reply)
    assert str(store.settings.data_folder) not in told(reply)


FUZZED = (
    ("POST", "/collections/points/search", "read"),
    ("POST", "/processes/register-scene/execution", "register"),
    ("POST", "/blocks", "admin"),
    ("POST", "/tokens", "admin"),
    ("POST", "/scenes/reference", "register"),
    ("PATCH", "/blocks/flat", "admin"),
)


@pytest.mark.thorough
@given(
    target=st.sampled_from(FUZZED),
    content=st.one_of(
        st.binary(max_size=200),
        st.recursive(
            st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=20),
            lambda inner: (
                st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=12), inner, max_size=4)
            ),
        ).map(lambda value: json.dumps(value).encode()),
    ),
)
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_body_of_any_bytes_or_any_json_is_refused(
    store: Installation, untouched, target, content: bytes
):
    method, path, who = target
    reply = store.client.request(method, path, content=content, headers={**store.headers[who], **JSON})
    assert 400 <= reply.status_code < 500 or (path.endswith("search") and reply.status_code == 200)


@given(text=st.text(max_size=60) | st.text("saliency<>=() 'and or not%_0123456789.e-+*/", max_size=60))
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_filter_of_any_text_is_answered_or_refused_and_nothing_else(
    store: Installation, untouched, text: str
):
    body = {"filter": text, "filter-lang": "cql2-text", "limit": 1}
    reply = store.client.post("/collections/points/search", json=body, headers=store.headers["read"])
    assert reply.status_code in (200, 400, 422), reply.text


def test_there_are_at_least_200_different_bad_requests():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names) >= 200
