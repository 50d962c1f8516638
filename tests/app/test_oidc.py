"""Tokens of an OpenID Connect issuer that runs on this machine."""

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from fastapi.testclient import TestClient

from amers.app import oidc
from amers.app.config import Settings
from amers.app.db import engine
from amers.app.errors import NotAllowed
from amers.app.main import create_app
from amers.app.oidc import Identity, Issuer
from amers.app.usecases.tokens import revoke_token

pytestmark = pytest.mark.security


class LocalIssuer:
    """An issuer with one key, and the requests it received.

    Attributes:
        more: further members of its key.
        answering: while it is not set, a request for the keys waits.
    """

    def __init__(self) -> None:
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.asked: list[str] = []
        self.more: dict[str, object] = {"use": "sig"}
        self.answering = threading.Event()
        self.answering.set()
        issuer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                issuer.asked.append(self.path)
                issuer.answering.wait(20.0)
                public = json.loads(jwt.algorithms.ECAlgorithm.to_jwk(issuer.key.public_key()))
                document = (
                    {"keys": [{"kty": "oct"}, 1, {**public, "kid": "one", **issuer.more}]}
                    if self.path == "/keys"
                    else {"issuer": issuer.url, "jwks_uri": f"{issuer.url}/keys"}
                )
                self.send_response(200)
                self.end_headers()
                self.wfile.write(json.dumps(document).encode())

            def log_message(self, *arguments: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()

    def token(self, key=None, algorithm="ES256", kid="one", header=(), **claims) -> dict[str, str]:
        """Headers with a token; `claims` replace the default ones, and None leaves one out."""
        usual = {
            "iss": self.url,
            "aud": "amers",
            "sub": "u-1",
            "name": "Survey office",
            "exp": time.time() + 300,
            "scope": "openid amers:register",
        }
        chosen = {name: value for name, value in {**usual, **claims}.items() if value is not None}
        made = jwt.encode(chosen, key or self.key, algorithm, {"kid": kid, **dict(header)})
        return {"Authorization": f"Bearer {made}"}


@pytest.fixture
def issuer():
    issuer = LocalIssuer()
    yield issuer
    issuer.answering.set()
    issuer.server.shutdown()
    issuer.server.server_close()


@pytest.fixture
def client(settings, issuer):
    with TestClient(create_app(settings.model_copy(update={"oidc_issuer": issuer.url}))) as client:
        yield client


def test_a_token_of_the_issuer_opens_what_its_claim_is_mapped_to(client, issuer):
    mine = client.get("/tokens/self", headers=issuer.token()).json()
    assert (mine["name"], mine["scopes"]) == ("Survey office", ["register"])
    assert client.get("/scenes", headers=issuer.token()).status_code == 200
    assert client.get("/tokens", headers=issuer.token()).status_code == 403
    admin = issuer.token(scope=["amers:admin"])
    assert client.get("/tokens", headers=admin).status_code == 200
    again = client.get("/tokens/self", headers=issuer.token(scope="amers:read")).json()
    assert (again["id"], again["scopes"]) == (mine["id"], ["read"])
    assert issuer.asked.count("/keys") == 1


INVALID_CLAIMS: tuple[dict[str, Any], ...] = (
    {"exp": 1_000_000_000},
    {"exp": None},
    {"aud": "somebody else"},
    {"iss": "https://elsewhere.example"},
    {"sub": None},
    {"kid": "two"},
    {"header": {"typ": "logout+jwt"}},
    {"header": {"typ": "dpop+jwt"}},
    {"header": {"typ": "ID"}},
    {"header": {"crit": ["exp"]}},
    {"at_hash": "x"},
    {"nonce": "of an ID token"},
    {"sub": ""},
    {"sub": " "},
    {"sub": "u" * 256},
    {"sub": "a\0b"},
    {"sub": "\ud800"},
    {"scope": 7},
    {"scope": float("nan")},
    {"scope": True},
    {"scope": {"amers:admin": True}},
    {"scope": [["amers:admin"]]},
    {"scope": ["amers:admin", 1]},
    {"exp": float("inf")},
    {"exp": [1]},
    {"nbf": float("inf")},
    {"iat": float("inf")},
)


def test_a_token_that_is_not_a_valid_one_for_us_is_refused(client, issuer):
    for claims in INVALID_CLAIMS:
        reply = client.get("/tokens/self", headers=issuer.token(**claims))
        assert reply.status_code == 401, claims


def test_a_token_signed_by_somebody_else_or_by_nobody_is_refused(client, issuer):
    other = ec.generate_private_key(ec.SECP256R1())
    wide = rsa.generate_private_key(65537, 2048)
    forged = (
        issuer.token(key=other),
        issuer.token(key=wide, algorithm="RS256"),
        issuer.token(key="x" * 32, algorithm="HS256"),
        {"Authorization": "Bearer a.b.c"},
    )
    for headers in forged:
        assert client.get("/tokens/self", headers=headers).status_code == 401


def test_clocks_of_issuer_and_service_may_differ_by_seconds_and_not_by_minutes(client, issuer):
    for ago_s, status in ((5.0, 200), (120.0, 401)):
        headers = issuer.token(exp=time.time() - ago_s)
        assert client.get("/tokens/self", headers=headers).status_code == status


def test_a_claim_that_maps_to_nothing_allows_nothing(client, issuer):
    for scope in ("openid", "xamers:admin", "amers:admin.not", ["amers:admin openid"]):
        assert client.get("/tokens/self", headers=issuer.token(scope=scope)).status_code == 403


def test_an_identity_is_revoked_here_whatever_its_issuer_says(client, issuer, dsn):
    mine = client.get("/tokens/self", headers=issuer.token()).json()
    with engine.connect(dsn) as connection:
        revoke_token(connection, mine["id"])
    assert client.get("/tokens/self", headers=issuer.token()).status_code == 401


def test_unknown_keys_do_not_cause_repeated_requests_to_the_issuer(client, issuer):
    assert oidc.LEAST_PAUSE_S >= 60.0
    for number in range(5):
        client.get("/tokens/self", headers=issuer.token(kid=f"unknown-{number}"))
    assert issuer.asked.count("/keys") == 1


def test_access_tokens_of_rfc_9068_are_accepted(client, issuer):
    for kind in ("at+jwt", "application/at+jwt", "JWT"):
        reply = client.get("/tokens/self", headers=issuer.token(header={"typ": kind}))
        assert reply.status_code == 200, kind
    nonce = issuer.token(header={"typ": "at+jwt"}, nonce="some issuers copy it")
    assert client.get("/tokens/self", headers=nonce).status_code == 200


def test_a_name_that_no_row_can_have_is_replaced_by_the_subject(client, issuer):
    for name in ("\ud800", "a\0b", 7, {}, " "):
        mine = client.get("/tokens/self", headers=issuer.token(sub=f"u-{name!r}", name=name))
        assert (mine.status_code, mine.json()["name"]) == (200, f"u-{name!r}")


def is_accepted(settings: Settings, issuer: LocalIssuer, **changes: object) -> bool:
    """Whether a service that knows nothing of an issuer yet accepts a token of it.

    Args:
        settings: of the service.
        issuer: that signs.
        changes: of the settings; by default the issuer is that which signs.
    """
    url = changes.get("oidc_issuer", issuer.url)
    one = Issuer(settings.model_copy(update={"oidc_issuer": url, **changes}))
    try:
        return one.identify(token_of(issuer, iss=url)).name == "Survey office"
    except NotAllowed:
        return False


def test_a_key_that_is_not_for_these_signatures_verifies_none(settings, issuer):
    for more in (
        {"use": "enc"},
        {"key_ops": ["encrypt"]},
        {"alg": "ES384"},
        {"alg": "ECDH-ES"},
        {"kid": 7},
    ):
        issuer.more = more
        assert not is_accepted(settings, issuer), more
    issuer.more = {"key_ops": ["verify"], "alg": "ES256"}
    assert is_accepted(settings, issuer)


@pytest.mark.thorough
def test_a_slow_issuer_delays_only_who_waits_for_its_answer(client, issuer, monkeypatch):
    assert client.get("/tokens/self", headers=issuer.token()).status_code == 200
    # The keys are old, and the issuer does not answer.
    monkeypatch.setattr(oidc, "KEYS_LIVE_S", 0.0)
    monkeypatch.setattr(oidc, "LEAST_PAUSE_S", 0.0)
    issuer.answering.clear()
    with ThreadPoolExecutor(30) as callers:
        unknown = [
            callers.submit(client.get, "/tokens/self", headers=issuer.token(kid=f"no-{number}"))
            for number in range(10)
        ]
        started = time.monotonic()
        known = [callers.submit(client.get, "/tokens/self", headers=issuer.token()) for _ in range(10)]
        assert [one.result().status_code for one in known] == [200] * 10
        assert time.monotonic() - started < oidc.TIMEOUT_S, "nobody waited for the issuer"
        issuer.answering.set()
        assert [one.result().status_code for one in unknown] == [401] * 10


def test_keys_of_an_issuer_that_no_longer_answers_die(client, issuer, monkeypatch):
    assert client.get("/tokens/self", headers=issuer.token()).status_code == 200
    issuer.server.shutdown()
    issuer.server.server_close()
    assert client.get("/tokens/self", headers=issuer.token()).status_code == 200
    monkeypatch.setattr(oidc, "KEYS_DIE_S", 0.0)
    assert client.get("/tokens/self", headers=issuer.token()).status_code == 401


def test_a_document_of_another_issuer_is_not_used(settings, issuer):
    assert is_accepted(settings, issuer)
    assert not is_accepted(settings, issuer, oidc_issuer=f"{issuer.url}/")


def token_of(issuer: LocalIssuer, **claims: object) -> str:
    """A token of an issuer, without the header around it."""
    return issuer.token(**claims)["Authorization"].split()[1]


def test_keys_are_read_from_a_document_of_limited_size(settings, issuer):
    for size_bytes, is_read in ((1 << 10, True), (2 << 20, False)):
        issuer.more["x5c_of_somebody"] = "x" * size_bytes
        assert is_accepted(settings, issuer) is is_read


@dataclass
class Clock:
    """The clock of a service, which a test moves.

    Attributes:
        ahead_s: of the real one.
    """

    ahead_s: float = 0.0

    def monotonic(self) -> float:
        """Seconds, as of `time.monotonic`."""
        return time.monotonic() + self.ahead_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock by which an issuer's keys grow old."""
    clock = Clock()
    monkeypatch.setattr(oidc, "time", clock)
    return clock


def end_of_requests_for_keys() -> None:
    """Wait until no keys are being fetched."""
    for thread in threading.enumerate():
        if thread.name == "oidc":
            thread.join(20.0)


def test_keys_are_fetched_again_every_ten_minutes_so_that_new_ones_serve(settings, issuer, clock):
    one = Issuer(settings.model_copy(update={"oidc_issuer": issuer.url}))
    by_former_key = token_of(issuer)
    one.identify(by_former_key)
    issuer.key = ec.generate_private_key(ec.SECP256R1())
    for clock.ahead_s in (0.0, 300.0, 590.0):
        one.identify(by_former_key)
        end_of_requests_for_keys()
    assert issuer.asked.count("/keys") == 1
    clock.ahead_s = 610.0
    one.identify(by_former_key)
    end_of_requests_for_keys()
    assert issuer.asked.count("/keys") == 2
    assert one.identify(token_of(issuer)).name == "Survey office"
    with pytest.raises(NotAllowed):
        one.identify(by_former_key)


def test_keys_serve_for_an_hour_while_their_issuer_does_not_answer(settings, issuer, clock):
    one = Issuer(settings.model_copy(update={"oidc_issuer": issuer.url}))
    one.identify(token_of(issuer))
    issuer.server.shutdown()
    issuer.server.server_close()
    for clock.ahead_s in (700.0, 1400.0, 3500.0):
        one.identify(token_of(issuer))
        end_of_requests_for_keys()
        one.identify(token_of(issuer))
    clock.ahead_s = 3700.0
    with pytest.raises(NotAllowed):
        one.identify(token_of(issuer))


def test_few_callers_wait_for_keys_that_do_not_arrive_and_the_others_are_refused_at_once(
    settings, issuer
):
    """Each of them occupies a thread of the service."""
    one = Issuer(settings.model_copy(update={"oidc_issuer": issuer.url}))
    issuer.answering.clear()
    release = threading.Timer(0.9 * oidc.TIMEOUT_S, issuer.answering.set)
    with ThreadPoolExecutor(oidc.MOST_WAITING) as callers:
        waiting = [callers.submit(one.identify, token_of(issuer)) for _ in range(oidc.MOST_WAITING)]
        while not issuer.asked:
            time.sleep(0.01)
        time.sleep(0.5)
        assert not any(caller.done() for caller in waiting)
        release.start()
        with pytest.raises(NotAllowed):
            one.identify(token_of(issuer))
        assert not issuer.answering.is_set()
        issuer.answering.set()
        assert {caller.result().name for caller in waiting} == {"Survey office"}
    release.cancel()


def test_one_subject_of_two_issuers_is_two_identities(settings, issuer):
    def identity(of: LocalIssuer) -> Identity:
        one = Issuer(settings.model_copy(update={"oidc_issuer": of.url}))
        return one.identify(token_of(of))

    other = LocalIssuer()
    try:
        assert identity(issuer) == identity(issuer)
        assert identity(issuer).subject != identity(other).subject
    finally:
        other.server.shutdown()
        other.server.server_close()


@pytest.mark.parametrize(("keys_url", "fetched"), [("https://keys.example", True), ("http:", False)])
def test_an_issuer_with_https_has_its_keys_fetched_with_https_alone(
    settings, issuer, monkeypatch, keys_url, fetched
):
    """The documents are those of the issuer on this machine, at other addresses."""
    url, document = "https://issuer.example", oidc._document

    def answered(address: str) -> dict[str, object]:
        if address == f"{url}/.well-known/openid-configuration":
            return {"issuer": url, "jwks_uri": f"{keys_url}/keys"}
        return document(f"{issuer.url}/keys")

    monkeypatch.setattr(oidc, "_document", answered)
    assert is_accepted(settings, issuer, oidc_issuer=url) is fetched


def test_tokens_of_our_own_go_on_beside_those_of_the_issuer(bearer):
    assert bearer("read").get("/tokens/self").status_code == 200
