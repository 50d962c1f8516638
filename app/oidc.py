"""Authentication by JSON Web Tokens of one OpenID Connect issuer.

Source: RFC 7519, JSON Web Token; RFC 7517, JSON Web Key; OpenID Connect Discovery 1.0.
"""

import logging
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from app.config import Settings
from app.errors import NotAllowed

if TYPE_CHECKING:
    import jwt

ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "EdDSA")
"""Asymmetric signatures only: nobody can make one from the public key."""
KEYS_LIVE_S = 600.0
LEAST_PAUSE_S = 10.0
"""Shortest time between two requests for the keys of the issuer."""
TIMEOUT_S = 5.0
LEEWAY_S = 30.0

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Identity:
    """The bearer of a token as its issuer identifies it.

    Attributes:
        subject: issuer and identifier, unique together.
        name: for people.
        scopes: scopes of this service that the claim maps to; not empty.
    """

    subject: str
    name: str
    scopes: tuple[str, ...]


def looks_like_jwt(secret: str) -> bool:
    """Whether a bearer token is a JSON Web Token; secrets of this service have no dots."""
    return secret.count(".") == 2


class Issuer:
    """One issuer and its keys; safe to share between threads."""

    def __init__(self, settings: Settings) -> None:
        assert settings.oidc_issuer is not None
        self._issuer = settings.oidc_issuer
        self._audience = settings.oidc_audience
        self._keys_url = settings.oidc_keys_url
        self._claim = settings.oidc_claim
        self._scopes = settings.oidc_scopes
        self._keys: dict[str | None, jwt.PyJWK] = {}
        self._fetched_at = float("-inf")
        self._lock = threading.Lock()

    def identify(self, token: str) -> Identity:
        """The identity of the bearer of a token.

        Raises:
            NotAllowed: the token is not valid for this issuer and audience, or it maps to no scope.
        """
        # Only a service with an issuer needs these libraries, which take a sixth of a second to import.
        import httpx
        import jwt

        try:
            key = self._key(jwt.get_unverified_header(token).get("kid"))
            claims: dict[str, Any] = jwt.decode(
                token,
                key=key,
                algorithms=ALGORITHMS,
                audience=self._audience,
                issuer=self._issuer,
                leeway=LEEWAY_S,
                options={"require": ["exp", "iss", "aud", "sub"]},
            )
        except (jwt.PyJWTError, httpx.HTTPError, ValueError) as error:
            log.info("a token of %s was refused: %s", self._issuer, error)
            raise NotAllowed(
                "the token is not a valid token of the issuer", authenticated=False
            ) from None
        claim = claims.get(self._claim, ())
        values = set(claim.split() if isinstance(claim, str) else map(str, claim or ()))
        scopes = tuple(scope for value, scope in self._scopes.items() if value in values)
        if not scopes:
            raise NotAllowed(f"the token's claim {self._claim} allows nothing here", authenticated=True)
        name = str(claims.get("preferred_username") or claims.get("name") or claims["sub"])
        return Identity(f"{self._issuer}|{claims['sub']}", name[:200], scopes)

    def _key(self, key_id: str | None) -> "jwt.PyJWK":
        """The key with an id; keys are fetched again when they are old or the id is unknown."""
        import jwt

        with self._lock:
            age_s = time.monotonic() - self._fetched_at
            if age_s > KEYS_LIVE_S or (key_id not in self._keys and age_s > LEAST_PAUSE_S):
                self._fetched_at = time.monotonic()
                self._keys = self._fetch()
            if key_id not in self._keys:
                raise jwt.InvalidKeyError(f"no key {key_id!r:.80}")
            return self._keys[key_id]

    def _fetch(self) -> "dict[str | None, jwt.PyJWK]":
        import httpx
        import jwt

        url = self._keys_url
        if url is None:
            reply = httpx.get(
                f"{self._issuer.rstrip('/')}/.well-known/openid-configuration", timeout=TIMEOUT_S
            )
            url = str(reply.raise_for_status().json()["jwks_uri"])
        document = httpx.get(url, timeout=TIMEOUT_S).raise_for_status().json()
        return {key.key_id: key for key in jwt.PyJWKSet.from_dict(document).keys}
