"""Iteration over all items of a catalogue: folders, files, links, pages of a search."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit

from amers.services.errors import FormatError
from amers.services.formats.addresses import without_query
from amers.services.formats.stac.documents import Documents, is_address
from amers.services.formats.text_files import load_json

PAGE_ITEMS = 250
MOST_DOCUMENTS = 2_000_000
MOST_PAGES = 20_000
LONGEST_LINE = 50_000_000
_LINES = (".ndjson", ".jsonl", ".geojsonl")
_ROOTS = ("catalog.json", "collection.json")
_FOLLOWED = ("child", "item", "items")


@dataclass(frozen=True)
class Found:
    """An item of a catalogue, or a place where one should be.

    Attributes:
        source: where it stands, for messages.
        base: path or address that its relative addresses refer to.
        item: JSON, or the error that was met there.
    """

    source: str
    base: str
    item: Any | FormatError


def walk(documents: Documents, query: dict[str, str]) -> Iterator[Found]:
    """All items of a catalogue.

    Args:
        documents: of the catalogue.
        query: parameters of a search, where the catalogue is a search API.

    Raises:
        FormatError: the catalogue itself cannot be read, or is none.
    """
    source = documents.source
    path = Path(source)
    if is_address(source):
        yield from _on_server(documents, query)
    elif path.is_dir():
        root = next((path / name for name in _ROOTS if (path / name).is_file()), None)
        yield from _folder(documents, path) if root is None else _linked(documents, str(root))
    elif path.suffix.lower() in _LINES:
        yield from _lines(path)
    else:
        yield from _linked(documents, str(path))


def _folder(documents: Documents, folder: Path) -> Iterator[Found]:
    """Items of all files below a folder; other JSON there, such as masks, is passed over."""
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in _LINES:
            yield from _lines(path)
        elif path.suffix.lower() in (".json", ".geojson"):
            try:
                document = documents.read(str(path))
            except FormatError as error:
                yield Found(str(path), str(path), error)
                continue
            if isinstance(document, dict) and _has_items(document):
                yield from _items_of(document, str(path))


def _has_items(document: dict[str, Any]) -> bool:
    """Whether a document is a STAC item or a collection of them."""
    if document.get("type") == "FeatureCollection":
        features = document.get("features")
        members = features[:1] if isinstance(features, list) else []
        return any(isinstance(member, dict) and "stac_version" in member for member in members)
    return document.get("type") == "Feature" and "stac_version" in document


def _lines(path: Path) -> Iterator[Found]:
    try:
        with path.open("rb") as lines:
            number = 0
            while line := lines.readline(LONGEST_LINE):
                number += 1
                if line.strip():
                    source = f"{path}: line {number}"
                    try:
                        item = load_json(line.decode("utf-8-sig"), source)
                    except (FormatError, UnicodeDecodeError) as error:
                        item = error if isinstance(error, FormatError) else _no_text(source)
                    yield Found(source, str(path), item)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from None


def _no_text(source: str) -> FormatError:
    return FormatError(f"{source}: expected text in UTF-8")


def _linked(documents: Documents, start: str) -> Iterator[Found]:
    """Items of a document and of those that it links to, each document once."""
    waiting, met = [start], {start}
    while waiting:
        address = waiting.pop()
        try:
            document = _stac_document(documents, address)
        except FormatError as error:
            if address == start:
                raise
            yield Found(without_query(address), address, error)
            continue
        if document.get("type") in ("Feature", "FeatureCollection"):
            yield from _items_of(document, address)
        targets = []
        for link in _links(document):
            is_page = link["rel"] == "next" and is_address(address)
            if link["rel"] in _FOLLOWED or is_page:
                try:
                    targets.append(documents.resolved(link["href"], address))
                except FormatError as error:
                    yield Found(without_query(address), address, error)
        waiting += [target for target in reversed(targets) if target not in met]
        met.update(targets)
        if len(met) > MOST_DOCUMENTS:
            raise FormatError(f"{without_query(start)}: links to more than {MOST_DOCUMENTS} documents")


def _stac_document(documents: Documents, address: str) -> dict[str, Any]:
    document = documents.read(address)
    kind = document.get("type") if isinstance(document, dict) else document
    is_old_catalog = kind is None and "stac_version" in document if isinstance(document, dict) else False
    if kind in ("Feature", "FeatureCollection", "Catalog", "Collection") or is_old_catalog:
        return dict(document)
    raise FormatError(
        f"{without_query(address)}: type {kind!r:.80} found, a STAC item, item collection, catalog or "
        "collection expected"
    )


def _links(document: dict[str, Any]) -> list[dict[str, Any]]:
    links = document.get("links")
    return [
        link
        for link in (links if isinstance(links, list) else [])
        if isinstance(link, dict)
        and isinstance(link.get("rel"), str)
        and isinstance(link.get("href"), str)
    ]


def _items_of(document: dict[str, Any], address: str) -> Iterator[Found]:
    if document["type"] == "Feature":
        yield Found(without_query(address), address, document)
        return
    features, shown = document.get("features"), without_query(address)
    if not isinstance(features, list):
        wrong = FormatError(f"{shown}: features: {features!r:.80} found, a list expected")
        yield Found(shown, address, wrong)
        return
    for number, item in enumerate(features):
        yield Found(f"{shown}: features[{number}]", address, item)


def _on_server(documents: Documents, query: dict[str, str]) -> Iterator[Found]:
    """Pages of a search API, or the items of a linked catalogue."""
    address = documents.source
    has_box = "bbox" in query or "bbox=" in urlsplit(address).query
    if not urlsplit(address).path.rstrip("/").endswith("/search"):
        landing = documents.read(address)
        links = _links(landing) if isinstance(landing, dict) else []
        search = next((link["href"] for link in links if link["rel"] == "search"), None)
        if search is None:
            yield from _linked(documents, address)
            return
        # Relative addresses of a landing page refer to it as a folder.
        address = documents.resolved(search, address if "://" in search else address.rstrip("/") + "/")
    if not has_box:
        raise FormatError(f"{without_query(address)}: a search of all the Earth; state an area (--area)")
    yield from _pages(documents, _with_query(address, query))


def _with_query(address: str, query: dict[str, str]) -> str:
    """An address with parameters, those that it already has unchanged."""
    parts = urlsplit(address)
    parameters = {"limit": str(PAGE_ITEMS), **query, **dict(parse_qsl(parts.query))}
    return urlunsplit(parts._replace(query=urlencode(parameters)))


def _pages(documents: Documents, address: str) -> Iterator[Found]:
    body: dict[str, Any] | None = None
    asked: set[str] = set()
    shown = without_query(address)
    for _ in range(MOST_PAGES):
        page = documents.read(address, body)
        if not isinstance(page, dict) or page.get("type") != "FeatureCollection":
            raise FormatError(f"{shown}: a page of a search (FeatureCollection) expected")
        yield from _items_of(page, address)
        following = next((link for link in _links(page) if link["rel"] == "next"), None)
        if following is None:
            return
        asked.add(f"{address} {body}")
        address = documents.resolved(following["href"], address)
        if str(following.get("method", "GET")).upper() == "POST":
            new = following.get("body")
            new = new if isinstance(new, dict) else {}
            body = {**(body or {}), **new} if following.get("merge") else new
        else:
            body = None
        if f"{address} {body}" in asked:
            raise FormatError(f"{shown}: the next page is one that was already read")
    raise FormatError(f"{shown}: more than {MOST_PAGES} pages; ask for a smaller area or time")
