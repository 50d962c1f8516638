"""Functions replaced by recorders: where the values that an interface is given go."""

import dataclasses
import inspect
import re
import sys
from collections.abc import Iterator
from datetime import datetime
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar
from unittest.mock import MagicMock
from uuid import UUID

import numpy as np
import pytest

RECORDED = ("amers.app.", "amers.services.")
CALLED = ("amers.app.config", "amers.services.docstrings")
"""Modules that are called as they are."""
OUTPUT = "amers.app.cli.output"
SHOWING = ("show", "show_one", "print_json")
"""Functions of the command line by which results are shown."""
LEFT_OUT = ("seconds", "_mock", "_spec")
"""How keys begin whose values are of this run alone, or of the stand-ins."""
OF_ONE = ("stored_scenes",)
"""Functions whose result stands for one thing, in a list."""
_CONVERTED = ("parse_", "printable", "by_", "checked_", "named_", "box_of", "stated_", "file_place")
"""How functions begin that only convert what is given: these are called."""

_TWO = ("first", "second")
"""What any result consists of; these consist of nothing."""


class Anything(MagicMock):
    """A result that is printed, compared and passed on like any.

    Attributes:
        notes: of the recorders at work.
    """

    notes: ClassVar[list[tuple[str, str]]] = []

    def __init__(self, *arguments: Any, **named: Any) -> None:
        """Replace what every instance of a mock has of its own."""
        super().__init__(*arguments, **named)
        for name in ("__lt__", "__gt__", "__le__", "__ge__"):
            setattr(self, name, lambda _self, _other: False)
        if self._extract_mock_name() not in _TWO:
            self.__iter__ = lambda _self: iter([Anything(name=name) for name in _TWO])

    def __format__(self, _spec: str) -> str:
        """Some text."""
        return "anything"

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Note what a method of a result is called with."""
        name = re.sub(r"\(\)(?=\.|$)", "", self._extract_mock_name())
        for place, value in [*enumerate(arguments), *named.items()]:
            if "__" not in name:
                Anything.notes.extend(leaves(f"{name}({place})", value))
        return super().__call__(*arguments, **named)


class Recorders:
    """Stand in for all that modules call outside of themselves.

    Attributes:
        notes: the values that they were called with, each after the path that leads to it.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, package: str, but: tuple[str, ...] = ()) -> None:
        """Replace the functions of other packages in the modules of a package, but some, or in one."""
        self.notes: list[tuple[str, str]] = []
        self._package = package
        Anything.notes = self.notes
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
        if inspect.isfunction(value) and of == OUTPUT and value.__name__ in SHOWING:
            return self.of(value)
        if inspect.isfunction(inspect.unwrap(value)) and self._is_recorded(of):  # type: ignore[arg-type]
            return None if value.__name__.startswith(_CONVERTED) else self.of(value)
        return None

    def of(self, function: Any) -> Any:
        """A recorder in place of a function."""
        name = function.__qualname__

        def recorder(*arguments: Any, **named: Any) -> Any:
            for place, value in [*enumerate(arguments), *named.items()]:
                self.notes.extend(leaves(f"{name}({place})", value))
            result = Anything(name=f"{name}()")
            return [result] if name in OF_ONE else result

        return recorder

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
    if parts is not None:
        for name, part in parts.items():
            yield from leaves(f"{path}{name}", part, depth + 1)
    elif isinstance(value, Anything):
        yield path, value._extract_mock_name()
    elif isinstance(value, np.ndarray):
        yield path, str(value.tolist())
    elif isinstance(value, str | int | float | Path | UUID | Enum | datetime | type(None)):
        yield path, str(value)


def _parts(value: Any) -> dict[str, Any] | None:
    """What a value consists of, by its place; None for a single value."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f".{one.name}": getattr(value, one.name, None) for one in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {f"[{key}]": one for key, one in value.items() if not str(key).startswith(LEFT_OUT)}
    if isinstance(value, list | tuple):
        return {f"[{number}]": one for number, one in enumerate(value)}
    return None
