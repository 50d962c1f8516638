"""The public address of a service: what its callers write before every path."""

import re
from ipaddress import IPv6Address

SHAPE = re.compile(
    r"(?P<scheme>(?i:https?))://"
    r"(?P<host>(?i:[a-z0-9]([a-z0-9.-]*[a-z0-9])?)|\[(?P<ipv6>[0-9A-Fa-f:.]+)\])(?P<port>:[1-9][0-9]{0,4})?"
    r"(?P<path>(/[A-Za-z0-9_~-][A-Za-z0-9._~-]*)*)/?",
)
DEFAULT_PORTS = {"http": ":80", "https": ":443"}
MOST_PORT = 65535
EXPECTED = (
    "expected http or https, a host, and a port and a path where the service has them, such as "
    "https://gcp.example.org/amers/; no user name, no query, no fragment; a path of letters, digits and "
    "`-._~`"
)
FOLDERS = frozenset(
    {
        "blocks",
        "collections",
        "jobs",
        "map",
        "points",
        "processes",
        "references",
        "scenes",
        "schemas",
        "tileMatrixSets",
        "tokens",
        "uploads",
    }
)
"""First parts of the service's own paths that have others below them."""
LEAVES = frozenset(
    {
        "api",
        "audit",
        "conformance",
        "connect",
        "healthz",
        "metrics",
        "readyz",
        "search",
        "sign-in",
        "sign-out",
        "status",
    }
)
"""The service's own paths that have no others below them."""


def normal_public_url(text: str) -> str:
    """A public address with its host in lower case, without a default port, with a slash at its end.

    Raises:
        ValueError: it is no such address, or its path is one of the service's own: then nobody could
            tell whether a proxy has removed the public path from a request.
    """
    shape = SHAPE.fullmatch(text.strip())
    if shape is None or (shape["ipv6"] and not _is_ipv6(shape["ipv6"])):
        raise ValueError(EXPECTED)
    scheme, host, path, port = (
        shape["scheme"].lower(),
        shape["host"].lower(),
        shape["path"],
        shape["port"],
    )
    if port is not None and int(port[1:]) > MOST_PORT:
        raise ValueError(f"port {port[1:]} found, one of 1 to {MOST_PORT} expected")
    first = path[1:].partition("/")[0]
    if first in FOLDERS or path[1:] in LEAVES:
        raise ValueError(
            f"the service has a path /{first} of its own, so the public path has to begin with another "
            "word, such as /amers/"
        )
    return f"{scheme}://{host}{'' if port == DEFAULT_PORTS[scheme] else port or ''}{path}/"


def _is_ipv6(text: str) -> bool:
    try:
        IPv6Address(text)
    except ValueError:
        return False
    return True
