"""Writing STAC items as one item collection."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def write_items(path: Path, items: Iterable[dict[str, Any]]) -> None:
    """Write an item collection (GeoJSON FeatureCollection), an item a line."""
    with path.open("w", encoding="utf-8") as out:
        out.write('{"type": "FeatureCollection", "features": [')
        for number, item in enumerate(items):
            out.write(",\n" if number else "\n")
            out.write(json.dumps(item, ensure_ascii=False))
        out.write("\n]}\n")
