"""Functions replaced by recorders: where the values that an interface is given go."""

import contextlib
import dataclasses
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from pydantic import BaseModel
from starlette.responses import Response

from amers.app.config import Settings
from tests.app.stand_ins import PLACE, Anything, result_of

RECORDED = ("amers.app.", "amers.services.")
CALLED = ("amers.app.config", "amers.services.docstrings")
"""Modules that are called as they are."""
LEFT_OUT = ("seconds", "_mock", "_spec")
"""How keys begin whose values are of this run alone, or of the stand-ins."""
OF_THIS_RUN = ("date", "content-length", "etag", "last-modified", "set-cookie")
"""Headers that are left out."""
MADE: Mapping[str, Callable[..., Any]] = {
    "stored_scenes": lambda both: both[:1],
    "replacing": lambda _folder: contextlib.nullcontext(Path()),
}
"""Functions with a result of their own: one scene of two, an empty folder in place of one to write."""
_CONVERTED = (
    *("parse_", "printable", "by_", "checked_", "named_", "box_of", "stated_", "file_place"),
    "parameter_names",
)
"""How functions begin that only convert what is given: these are called."""


class Recorders:
    """Stand in for all that modules call outside of themselves.

    Attributes:
        notes: the values that they were called with, each after the path that leads to it.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, package: str, but: tuple[str, ...] = ()) -> None:
        """Replace the functions of other packages in the modules of a package, but some, or in one."""
        self.notes: list[tuple[str, str]] = []
        self._package = package
        Anything.called = self.note
        for name, module in list(sys.modules.items()):
            if name.startswith(package) and name not in but:
                for own, value in list(vars(module).items()):
                    stand_in = self._in_place_of(value)
                    if stand_in is not None:
                        monkeypatch.setattr(module, own, stand_in)

    def _in_place_of(self, value: object) -> object | None:
        """What stands in for a function, or for a module with functions; None for anything else."""
        if isinstance(value, ModuleType):
            return _RecordedModule(self, value) if self._is_recorded(value.__name__) else None
        of = getattr(value, "__module__", "") or ""
        if inspect.isfunction(inspect.unwrap(value)) and self._is_recorded(of):  # type: ignore[arg-type]
            return None if value.__name__.startswith(_CONVERTED) else self.of(value)
        return None

    def of(self, function: Any) -> Any:
        """A recorder in place of a function."""
        name = function.__qualname__

        def recorder(*arguments: Any, **named: Any) -> Any:
            self.note(name, {**dict(enumerate(arguments)), **named})
            return MADE.get(name, lambda result: result)(result_of(function))

        return recorder

    def note(self, name: str, arguments: Mapping[int | str, Any]) -> None:
        """Note what something is called with, by place or name."""
        for place, value in arguments.items():
            self.notes.extend(leaves(f"{name}({place})", value))

    def _is_recorded(self, module: str) -> bool:
        return module.startswith(RECORDED) and not module.startswith((self._package, *CALLED))


class _RecordedModule:
    """A module whose functions are recorded."""

    def __init__(self, recorders: Recorders, module: ModuleType) -> None:
        self._recorders, self._module = recorders, module

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._module, name)
        stand_in = self._recorders._in_place_of(value)
        return value if stand_in is None else stand_in


def leaves(path: str, value: Any, depth: int = 0) -> Iterator[tuple[str, str]]:
    """The values in a value, each with the path that leads to it."""
    parts = _parts(value) if depth < 6 else None
    if hasattr(value, PLACE):
        yield path, getattr(value, PLACE)
    elif parts is not None:
        for name, part in parts.items():
            yield from leaves(f"{path}{name}", part, depth + 1)
    elif isinstance(value, Anything):
        yield path, value._extract_mock_name()
    elif isinstance(value, np.ndarray):
        yield path, str(value.tolist())
    elif isinstance(value, str | int | float | Path | UUID | Enum | datetime | type(None)):
        yield path, str(value)


def _parts(value: Any) -> dict[str, Any] | None:
    """What a value consists of, by its place, of settings no defaults; None for a single value."""
    if isinstance(value, Settings):
        return {f".{name}": one for name, one in value.model_dump(exclude_defaults=True).items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f".{one.name}": getattr(value, one.name, None) for one in dataclasses.fields(value)}
    if isinstance(value, BaseModel):
        return {f".{name}": one for name, one in vars(value).items()}
    if isinstance(value, Response):
        body = bytes(getattr(value, "body", b"")).decode(errors="replace")
        headers = {name: text for name, text in value.headers.items() if name not in OF_THIS_RUN}
        return {".status": value.status_code, ".body": body, ".headers": headers}
    if isinstance(value, dict):
        return {f"[{key}]": one for key, one in value.items() if not str(key).startswith(LEFT_OUT)}
    if isinstance(value, list | tuple):
        return {f"[{number}]": one for number, one in enumerate(value)}
    return None
