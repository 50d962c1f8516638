"""Small files that describe an archive of ortho-images: TOML with the fields of `Archive`."""

import tomllib
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from amers.services.errors import FormatError
from amers.services.formats.text_files import read_text
from amers.services.imagery.archives import Archive, StatedAccuracy

_KINDS = {"str": str, "float": (int, float)}


def read_archive(path: Path) -> Archive:
    """The archive that a file describes.

    Args:
        path: TOML with the fields of `Archive`; `accuracy` is an array of tables with the fields of
            `StatedAccuracy`, one at least.

    Raises:
        FormatError: the file is no TOML, or a field is unknown, missing or of another type.
    """
    try:
        document = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise FormatError(f"{path}: TOML expected: {error}") from None
    stated = document.pop("accuracy", None)
    if not isinstance(stated, list) or not stated or not all(isinstance(one, dict) for one in stated):
        raise FormatError(f"{path}: accuracy: {stated!r:.80} found, [[accuracy]] with own_m expected")
    accuracy = [_checked(StatedAccuracy, one, f"{path}: accuracy") for one in stated]
    accuracy.sort(key=lambda one: one.since_baseline)
    return _checked(Archive, document, str(path), accuracy=tuple(accuracy))


def _checked(kind: type[Any], values: dict[str, Any], source: str, **more: Any) -> Any:
    known = {field.name: field for field in fields(kind)}
    for name, value in values.items():
        if name not in known:
            raise FormatError(f"{source}: {name}: unknown, one of {', '.join(known)} expected")
        annotation = str(known[name].type)
        if annotation.startswith("tuple"):
            member = str if "str" in annotation else int
            if not isinstance(value, list) or not all(isinstance(one, member) for one in value):
                raise FormatError(f"{source}: {name}: {value!r:.80} found, a list expected")
            values[name] = tuple(value)
            continue
        expected = annotation.removeprefix("<class '").removesuffix("'>")
        if not isinstance(value, _KINDS[expected]) or isinstance(value, bool):  # type: ignore[arg-type]
            raise FormatError(f"{source}: {name}: {value!r:.80} found, {expected} expected")
    missing = [
        name
        for name, field in known.items()
        if field.default is MISSING and name not in values and name not in more
    ]
    if missing:
        raise FormatError(f"{source}: {missing[0]}: nothing found, a value expected")
    return kind(**values, **more)
