"""Authentication by JSON Web Tokens of one OpenID Connect issuer.

Source: RFC 7519, JSON Web Token; RFC 7517, JSON Web Key; RFC 8725, best practices; RFC 9068, access
tokens; OpenID Connect Discovery 1.0.
"""

import json
import logging
import threading
import time
from dataclasses import dataclass
from typing import Any

from amers.app.config import Settings
from amers.app.errors import NotAllowed

ALGORITHMS_OF_KEY_TYPE = {
    "RSA": ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512"),
    "EC": ("ES256", "ES384", "ES512"),
    "OKP": ("EdDSA",),
}
"""Asymmetric signatures only: nobody can make one from the public key."""
TOKEN_TYPES = ("at+jwt", "application/at+jwt", "jwt", "application/jwt")
"""Media types of access tokens (RFC 9068), and the general ones that many issuers use instead."""
ID_TOKEN_CLAIMS = frozenset({"nonce", "at_hash", "c_hash", "s_hash", "events"})
"""Claims of ID tokens and logout tokens, which are for the application that asked for them."""
KEYS_LIVE_S = 600.0
"""Older keys are fetched again; they are used until the new ones have arrived."""
KEYS_DIE_S = 3600.0
"""Older keys are not used: the issuer may have withdrawn them."""
LEAST_PAUSE_S = 60.0
"""Shortest time between two requests for the keys of the issuer."""
TIMEOUT_S = 5.0
MOST_WAITING = 4
"""Callers who may wait at once for keys that are being fetched; each occupies a thread."""
MOST_BYTES = 1 << 20
LONGEST_SUBJECT = 255
"""OpenID Connect Core 1.0, section 2."""
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


@dataclass(frozen=True)
class SigningKey:
    """A key of the issuer.

    Attributes:
        public: as PyJWT takes it.
        algorithms: of signatures that it verifies.
    """

    public: Any
    algorithms: tuple[str, ...]


def looks_like_jwt(secret: str) -> bool:
    """Whether a bearer token is a JSON Web Token; secrets of this service have no dots."""
    return secret.count(".") == 2


class Issuer:
    """One issuer and its keys; safe to share between threads.

    One thread at a time fetches the keys. Callers whose key is at hand do not wait for it.
    """

    def __init__(self, settings: Settings) -> None:
        assert settings.oidc_issuer is not None
        self._issuer = settings.oidc_issuer
        self._audience = settings.oidc_audience
        self._keys_url = settings.oidc_keys_url
        self._claim = settings.oidc_claim
        self._scopes = settings.oidc_scopes
        self._lock = threading.Lock()
        self._waiting = threading.BoundedSemaphore(MOST_WAITING)
        self._keys: dict[str | None, SigningKey] = {}
        self._fetched_at = self._asked_at = float("-inf")
        self._answered = threading.Event()

    def identify(self, token: str) -> Identity:
        """The identity of the bearer of a token.

        Raises:
            NotAllowed: the token is not valid for this issuer and audience, or it maps to no scope.
        """
        # Only a service with an issuer needs this library, which takes a tenth of a second to import.
        import jwt

        try:
            claims = self._claims(token)
            subject = _subject(claims)
            values = _permissions(claims.get(self._claim), self._claim)
        # What is signed is still text of somebody else: numbers may be infinite, members of any type.
        except (jwt.PyJWTError, ValueError, TypeError, ArithmeticError, RecursionError) as error:
            log.info("a token of %s was refused: %s", self._issuer, error)
            raise NotAllowed(
                "the token is not a valid token of the issuer", authenticated=False
            ) from None
        scopes = tuple(scope for value, scope in self._scopes.items() if value in values)
        if not scopes:
            raise NotAllowed(f"the token's claim {self._claim} allows nothing here", authenticated=True)
        names = (claims.get(claim) for claim in ("preferred_username", "name"))
        name = next((name for name in names if isinstance(name, str) and _is_printable(name)), subject)
        return Identity(f"{self._issuer}|{subject}", name[:200], scopes)

    def _claims(self, token: str) -> dict[str, Any]:
        """The claims of a token with a valid signature, in its time and for this audience."""
        import jwt

        header = jwt.get_unverified_header(token)
        kind = header.get("typ", "JWT")
        if not isinstance(kind, str) or kind.lower() not in TOKEN_TYPES:
            raise ValueError(f"typ: {kind!r:.80} found, the type of an access token expected")
        if "crit" in header:
            raise ValueError("crit: its extensions are not known")
        key, algorithm = self._key(header.get("kid")), header.get("alg")
        if algorithm not in key.algorithms:
            raise ValueError(f"alg: {algorithm!r:.80} does not belong to the key")
        claims: dict[str, Any] = jwt.decode(
            token,
            key=key.public,
            algorithms=[algorithm],
            audience=self._audience,
            issuer=self._issuer,
            leeway=LEEWAY_S,
            options={"require": ["exp", "iss", "aud", "sub"]},
        )
        if not kind.lower().endswith("at+jwt") and not ID_TOKEN_CLAIMS.isdisjoint(claims):
            raise ValueError("an access token expected, an ID token found")
        return claims

    def _key(self, key_id: Any) -> SigningKey:
        """The key with an id.

        Raises:
            ValueError: the issuer has no such key, or its keys have not arrived.
        """
        with self._lock:
            now = time.monotonic()
            key = self._known_key(key_id)
            is_wanted = key is None or now - self._fetched_at > KEYS_LIVE_S
            if is_wanted and now - self._asked_at > LEAST_PAUSE_S:
                self._asked_at, self._answered = now, threading.Event()
                arguments = (self._answered,)
                threading.Thread(target=self._renew, args=arguments, name="oidc", daemon=True).start()
            answered = self._answered
        if key is not None:
            return key
        if not answered.is_set() and self._waiting.acquire(blocking=False):
            try:
                answered.wait(3 * TIMEOUT_S)
            finally:
                self._waiting.release()
        with self._lock:
            key = self._known_key(key_id)
        if key is None:
            raise ValueError(f"no key {key_id!r:.80}")
        return key

    def _known_key(self, key_id: Any) -> SigningKey | None:
        return self._keys.get(key_id) if time.monotonic() - self._fetched_at < KEYS_DIE_S else None

    def _renew(self, answered: threading.Event) -> None:
        """Fetch the keys; after a failure the former ones stay until they are too old."""
        try:
            keys = self._fetch()
        except Exception as error:
            log.warning("the keys of %s cannot be fetched: %s", self._issuer, error)
        else:
            with self._lock:
                self._keys, self._fetched_at = keys, time.monotonic()
        finally:
            answered.set()

    def _fetch(self) -> dict[str | None, SigningKey]:
        url = self._keys_url
        if url is None:
            issuer = self._issuer.rstrip("/")
            document = _document(f"{issuer}/.well-known/openid-configuration")
            if document.get("issuer") != self._issuer:
                raise ValueError(
                    f"issuer: {document.get('issuer')!r:.200} found, {self._issuer} expected"
                )
            url = str(document["jwks_uri"])
            if self._issuer.startswith("https:") and not url.startswith("https:"):
                raise ValueError(f"jwks_uri: {url:.200} found, an https address expected")
        return _signing_keys(_document(url)["keys"])


def _document(url: str) -> dict[str, Any]:
    """A JSON object of the issuer, of limited size and fetched in limited time.

    Raises:
        ValueError: there is none at this address.
    """
    import httpx

    content, started = b"", time.monotonic()
    with httpx.stream("GET", url, timeout=TIMEOUT_S) as reply:
        reply.raise_for_status()
        for piece in reply.iter_bytes():
            content += piece
            if len(content) > MOST_BYTES or time.monotonic() - started > TIMEOUT_S:
                raise ValueError(f"{url}: more than {MOST_BYTES} bytes or {TIMEOUT_S:g} s")
    document = json.loads(content)
    if not isinstance(document, dict):
        raise ValueError(f"{url}: no JSON object")
    return document


def _signing_keys(members: Any) -> dict[str | None, SigningKey]:
    """The keys of a JSON Web Key Set that verify signatures, by id; other keys are left out."""
    import jwt

    keys: dict[str | None, SigningKey] = {}
    for member in members:
        if not isinstance(member, dict) or member.get("kty") not in ALGORITHMS_OF_KEY_TYPE:
            continue
        if member.get("use", "sig") != "sig" or "verify" not in member.get("key_ops", ["verify"]):
            continue
        key_id = member.get("kid")
        if not isinstance(key_id, str | None):
            continue
        algorithms = ALGORITHMS_OF_KEY_TYPE[member["kty"]]
        if "alg" in member:
            algorithms = tuple(name for name in algorithms if name == member["alg"])
        try:
            keys.setdefault(key_id, SigningKey(jwt.PyJWK(member).key, algorithms))
        except (jwt.PyJWTError, ValueError, TypeError) as error:
            log.warning("a key of the issuer cannot be used: %s", error)
    return keys


def _subject(claims: dict[str, Any]) -> str:
    """The identifier of the bearer at the issuer.

    Raises:
        ValueError: the claim is no text, is empty or too long.
    """
    subject = claims["sub"]
    if not isinstance(subject, str) or not subject.isascii() or not _is_printable(subject):
        raise ValueError("sub: printable ASCII expected")
    if len(subject) > LONGEST_SUBJECT:
        raise ValueError(f"sub: {len(subject)} characters found, at most {LONGEST_SUBJECT} expected")
    return subject


def _permissions(claim: Any, name: str) -> set[str]:
    """The values of the claim with permissions: words of a text, or the texts of a list.

    Raises:
        ValueError: the claim is something else.
    """
    if claim is None:
        return set()
    if isinstance(claim, str):
        return set(claim.split())
    if isinstance(claim, list) and all(isinstance(value, str) for value in claim):
        return set(claim)
    raise ValueError(f"{name}: a text or a list of texts expected, {type(claim).__name__} found")


def _is_printable(text: str) -> bool:
    return bool(text.strip()) and text.isprintable()
