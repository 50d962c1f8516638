"""Tokens of an OpenID Connect issuer that runs on this machine."""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from fastapi.testclient import TestClient

from app.db import engine
from app.main import create_app
from app.usecases.tokens import revoke_token

pytestmark = pytest.mark.security


class LocalIssuer:
    """An issuer with one key, and the requests it received."""

    def __init__(self) -> None:
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.asked: list[str] = []
        issuer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                issuer.asked.append(self.path)
                public = json.loads(jwt.algorithms.ECAlgorithm.to_jwk(issuer.key.public_key()))
                document = (
                    {"keys": [{**public, "kid": "one", "use": "sig"}]}
                    if self.path == "/keys"
                    else {"jwks_uri": f"{issuer.url}/keys"}
                )
                self.send_response(200)
                self.end_headers()
                self.wfile.write(json.dumps(document).encode())

            def log_message(self, *arguments: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def token(self, key=None, algorithm="ES256", kid="one", **claims) -> dict[str, str]:
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
        made = jwt.encode(chosen, key or self.key, algorithm, {"kid": kid})
        return {"Authorization": f"Bearer {made}"}


@pytest.fixture
def issuer():
    issuer = LocalIssuer()
    yield issuer
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


@pytest.mark.parametrize(
    "claims",
    [
        {"exp": 1_000_000_000},
        {"exp": None},
        {"aud": "somebody else"},
        {"iss": "https://elsewhere.example"},
        {"sub": None},
        {"kid": "two"},
    ],
)
def test_a_token_that_is_not_a_valid_one_for_us_is_refused(client, issuer, claims):
    assert client.get("/tokens/self", headers=issuer.token(**claims)).status_code == 401


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


def test_a_claim_that_maps_to_nothing_allows_nothing(client, issuer):
    assert client.get("/tokens/self", headers=issuer.token(scope="openid")).status_code == 403


def test_an_identity_is_revoked_here_whatever_its_issuer_says(client, issuer, dsn):
    mine = client.get("/tokens/self", headers=issuer.token()).json()
    with engine.connect(dsn) as connection:
        revoke_token(connection, mine["id"])
    assert client.get("/tokens/self", headers=issuer.token()).status_code == 401


def test_unknown_keys_do_not_cause_repeated_requests_to_the_issuer(client, issuer):
    for number in range(5):
        client.get("/tokens/self", headers=issuer.token(kid=f"unknown-{number}"))
    assert issuer.asked.count("/keys") == 1


def test_tokens_of_our_own_go_on_beside_those_of_the_issuer(client, bearer):
    assert client.get("/tokens/self", headers=bearer("read")).status_code == 200
