"""What the service says of itself is what it said: collections, their properties, processes, tilings.

A label, a unit, a choice or a limit that changes there is noticed here. If it is meant, the test
says where the new documents lie: read what differs, and put them in place of the old ones.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.app.callers import Caller

GOLDEN = Path(__file__).parents[1] / "golden" / "api_documents.json"
FIRST = ("/", "/conformance", "/collections", "/processes", "/tileMatrixSets")
"""Documents that are read, and those that their links and lists lead to."""
OF_COLLECTION = ("", "/schema", "/queryables", "/sortables", "/tiles")


def documents(me: Caller) -> Iterator[tuple[str, Any]]:
    """Every document, after its path."""
    for path in FIRST:
        yield path, me.get(path).json()
    for collection in me.get("/collections").json()["collections"]:
        for part in OF_COLLECTION:
            path = f"/collections/{collection['id']}{part}"
            reply = me.get(path)
            yield path, reply.json() if reply.status_code == 200 else reply.status_code
    for process in me.get("/processes").json()["processes"]:
        yield (path := f"/processes/{process['id']}"), me.get(path).json()
    for tiling in me.get("/tileMatrixSets").json()["tileMatrixSets"]:
        yield (path := f"/tileMatrixSets/{tiling['id']}"), me.get(path).json()


def test_documents_say_what_they_said(me: Caller, tmp_path: Path) -> None:
    written = tmp_path / "api_documents.json"
    found = dict(documents(me))
    written.write_text(json.dumps(found, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    expected = json.loads(GOLDEN.read_text(encoding="utf-8")) if GOLDEN.exists() else {}
    differing = [path for path in {**found, **expected} if found.get(path) != expected.get(path)]
    assert not differing, f"if this is meant, copy {written} to {GOLDEN}"
