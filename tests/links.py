"""The addresses that replies name, as clients and people find them."""

import re
from collections.abc import Iterator
from html import unescape
from typing import Any
from urllib.parse import urljoin

import httpx

STANDARDS = (
    "http://www.opengis.net/",
    "http://www.w3.org/",
    "https://api.stacspec.org/",
    "https://stac-extensions.github.io/",
    "https://json-schema.org/",
    "http://json-schema.org/",
    "https://geojson.org/",
    "https://schemas.opengis.net/",
)
"""Addresses that name a standard and are not followed to use the service."""
PLACES = ("tileMatrix", "tileRow", "tileCol", "z", "y", "x")
POST_ALONE = ("/execution", "/sign-out")


def urls_of(reply: httpx.Response, url: str) -> set[str]:
    """All addresses that a reply to the request for an address names, but those of standards.

    Places of templates are filled in.
    """
    locations = ", ".join(reply.headers.get(name, "") for name in ("location", "content-location"))
    found = re.findall(r"https?://[^\s,]+", locations)
    found += re.findall(r"<([^>]+)>", reply.headers.get("link", ""))
    kind = reply.headers.get("content-type", "")
    if "json" in kind:
        found += [text for text in _strings_of(reply.json()) if re.match(r"https?://\S+$", text)]
    elif "html" in kind:
        found += map(unescape, re.findall(r'(?:href|src|action)="([^"#][^"]*)"', reply.text))
        found += re.findall(r"https?://[^\s<>\"'&]+", unescape(reply.text))
    urls = (_filled_in(urljoin(url, one)) for one in found if not one.startswith("data:"))
    return {one for one in urls if not one.startswith(STANDARDS)}


def kind_of(url: str) -> str:
    """An address without ids and numbers: one of a kind answers for the others."""
    return re.sub(r"[0-9a-f-]{36}|token=[^&]+|\d+", "N", url)


def _strings_of(value: Any) -> Iterator[str]:
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _strings_of(inner)
    elif isinstance(value, str):
        yield value


def _filled_in(template: str) -> str:
    for name in PLACES:
        template = template.replace(f"{{{name}}}", "0")
    return template.rstrip("`.,;)\\")
