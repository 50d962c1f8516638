"""Bearers vouched for elsewhere: JSON Web Tokens of one OpenID Connect issuer.

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
"""Signatures by a private key. None that anybody could make who knows the public one."""
KEYS_LIVE_S = 600.0
LEAST_PAUSE_S = 10.0
"""Between two looks at the issuer's keys, whatever strangers send."""
TIMEOUT_S = 5.0
LEEWAY_S = 30.0

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Identity:
    """Who an issuer says it is.

    Attributes:
        subject: of the issuer and unique there.
        name: for people.
        scopes: of ours that its claim is mapped to; not empty.
    """

    subject: str
    name: str
    scopes: tuple[str, ...]


def looks_like_jwt(secret: str) -> bool:
    """Whether a bearer is a JSON Web Token; a secret of ours has no dots."""
    return secret.count(".") == 2


class Issuer:
    """One issuer, and its keys as last seen; safe to share between threads."""

    def __init__(self, settings: Settings) -> None:
        assert settings.oidc_issuer is not None
        self._issuer = settings.oidc_issuer
        self._audience = settings.oidc_audience
        self._keys_url = settings.oidc_keys_url
        self._claim = settings.oidc_claim
        self._scopes = settings.oidc_scopes
        self._keys: dict[str | None, jwt.PyJWK] = {}
        self._seen_at = float("-inf")
        self._lock = threading.Lock()

    def identify(self, token: str) -> Identity:
        """Who a token stands for.

        Raises:
            NotAllowed: it is not one of this issuer for us, it has expired, or it maps to no scope.
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
            raise NotAllowed("the token is not a valid one of the issuer", authenticated=False) from None
        given = claims.get(self._claim, ())
        held = set(given.split() if isinstance(given, str) else map(str, given or ()))
        scopes = tuple(own for theirs, own in self._scopes.items() if theirs in held)
        if not scopes:
            raise NotAllowed(f"the token's claim {self._claim} allows nothing here", authenticated=True)
        name = str(claims.get("preferred_username") or claims.get("name") or claims["sub"])
        return Identity(f"{self._issuer}|{claims['sub']}", name[:200], scopes)

    def _key(self, key_id: str | None) -> "jwt.PyJWK":
        """The key of that id; keys are fetched anew when they are old or an id is unknown."""
        import jwt

        with self._lock:
            age_s = time.monotonic() - self._seen_at
            if age_s > KEYS_LIVE_S or (key_id not in self._keys and age_s > LEAST_PAUSE_S):
                self._seen_at = time.monotonic()
                self._keys = self._fetch()
            if key_id not in self._keys:
                raise jwt.InvalidKeyError(f"no key {key_id!r:.80}")
            return self._keys[key_id]

    def _fetch(self) -> "dict[str | None, jwt.PyJWK]":
        import httpx
        import jwt

        url = self._keys_url
        if url is None:
            found = httpx.get(
                f"{self._issuer.rstrip('/')}/.well-known/openid-configuration", timeout=TIMEOUT_S
            )
            url = str(found.raise_for_status().json()["jwks_uri"])
        document = httpx.get(url, timeout=TIMEOUT_S).raise_for_status().json()
        return {key.key_id: key for key in jwt.PyJWKSet.from_dict(document).keys}
