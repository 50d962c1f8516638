"""Results that nothing computed: of any type, with a value in every field that no other field has.

What is made of such a result shows where each value of it goes: two exchanged fields, a part that is
left out, or the first of two that is taken twice, all change it.
"""

import contextlib
import dataclasses
import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from datetime import UTC, date, datetime, timedelta
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any, ClassVar
from unittest.mock import MagicMock
from uuid import UUID
from zlib import crc32

import numpy as np
from pydantic import BaseModel

PLACE = "__stand_in__"
"""Attribute of a result with the path that leads to it."""
_DEEPEST = 8
"""Levels of results in results; those below have no value."""
_LEAST = ContextVar("least", default=False)
_MANY: tuple[Any, ...] = (list, Sequence, Iterable, set, frozenset)


@contextlib.contextmanager
def least_results() -> Iterator[None]:
    """Let what stands in be the least of its type: nothing, no, none of several, the first word."""
    before = _LEAST.set(True)
    try:
        yield
    finally:
        _LEAST.reset(before)


class Anything(MagicMock):
    """What is passed on only: a connection, a store, a function. It iterates over two more.

    Attributes:
        called: told the name of what is called of it, and the arguments by place or name.
    """

    called: ClassVar[Callable[[str, Mapping[int | str, Any]], None]] = lambda _name, _arguments: None

    def __init__(self, *arguments: Any, **named: Any) -> None:
        """Replace what every instance of a mock has of its own."""
        super().__init__(*arguments, **named)
        for name in ("__lt__", "__gt__", "__le__", "__ge__"):
            setattr(self, name, lambda _self, _other: False)
        own = self._extract_mock_name()
        if not own.endswith("]"):
            self.__iter__ = lambda _self: iter([Anything(name=f"{own}[{n}]") for n in range(2)])
        self.__str__ = lambda _self: own

    def __format__(self, _spec: str) -> str:
        """Its name, also where a number is written."""
        return self._extract_mock_name()

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Tell what a method of a result is called with."""
        name = re.sub(r"\(\)(?=\.|$)", "", self._extract_mock_name())
        if "__" not in name:
            type(self).called(name, {**dict(enumerate(arguments)), **named})
        return super().__call__(*arguments, **named)


class _AnyText(str):
    """A text that does for a number, a list or a mapping of anything.

    Attributes:
        asked: told the name of a member that may be missing, and what stands for it.
    """

    asked: ClassVar[Callable[[str, Mapping[int | str, Any]], None]] = staticmethod(
        lambda _name, _arguments: None
    )

    def __format__(self, _spec: str) -> str:
        return str(self)

    def __mul__(self, _factor: Any) -> "_AnyText":
        return self

    __rmul__ = __mul__

    def __getitem__(self, key: Any) -> Any:
        return super().__getitem__(key) if isinstance(key, slice) else _AnyText(f"{self}[{key}]")

    def get(self, key: str, default: Any = None) -> Any:
        """A member; what stands for none, where one is given: then that it was asked for is told."""
        if default is None:
            return self[key]
        self.asked(f"{self}.get", {0: key, 1: default})
        return default

    def __iter__(self) -> Iterator[Any]:
        return iter([_AnyText(f"{self}[{number}]") for number in range(2)])


class _AnyKey(dict[Any, Any]):
    """Two members, and one of any other name that is asked for."""

    def __init__(self, members: Iterable[tuple[Any, Any]], kind: Any = Any, path: str = "") -> None:
        super().__init__(members)
        self._kind, self._path = kind, path

    def __missing__(self, key: Any) -> Any:
        path = f"{self._path}[{key}]"
        return _AnyText(path) if self._kind is Any else stand_in(self._kind, path)


def result_of(function: Callable[..., Any]) -> Any:
    """What stands in for the result of a function, by its annotation: a context where it gives one."""
    inside = inspect.unwrap(function)
    path = f"{function.__qualname__}()"
    try:
        kind = typing.get_type_hints(inside)["return"]
    except (KeyError, NameError):
        return Anything(name=path)
    if inside is not function and inspect.isgeneratorfunction(inside):
        return contextlib.nullcontext(stand_in(typing.get_args(kind)[0], path))
    return stand_in(kind, path)


def stand_in(kind: Any, path: str, depth: int = 0) -> Any:
    """A value of a type, that follows from the path that leads to it.

    Texts are the path itself; numbers, times and ids come from its checksum. Of what repeats there are
    two, and of alternatives the last, or none and the first among the least results. What is of no known
    type is opaque.
    """
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if depth > _DEEPEST or (_LEAST.get() and type(None) in inside):
        return None
    if origin is typing.Annotated:
        return stand_in(inside[0], path, depth)
    if origin in (typing.Union, types.UnionType):
        return stand_in(next(one for one in inside if one is not type(None)), path, depth)
    if origin is typing.Literal:
        return inside[0 if _LEAST.get() else -1]
    if origin is not None:
        return _collection(origin, inside, path, depth)
    if kind is Any:
        return _AnyText(path)
    return _single(kind, path, depth) if isinstance(kind, type) else Anything(name=path)


def _collection(origin: Any, inside: tuple[Any, ...], path: str, depth: int) -> Any:
    """A list, tuple, mapping or array of two; among the least results of one, in others of none."""
    many = int(depth == 0) if _LEAST.get() else 2

    def each(kinds: Iterable[Any]) -> list[Any]:
        return [stand_in(one, f"{path}[{number}]", depth + 1) for number, one in enumerate(kinds)]

    if origin is tuple:
        repeated = len(inside) == 2 and inside[1] is Ellipsis
        return tuple(each(inside[:1] * many if repeated else inside))
    if origin in _MANY:
        return each(inside[:1] * many)
    if origin is Iterator:
        return iter(each(inside[:1] * many))
    if origin in (dict, Mapping):
        both = zip(each(inside[:1] * many), each(inside[1:] * many), strict=True)
        return _AnyKey(() if inside[1] is Any else both, inside[1], path)
    if origin is np.ndarray:
        return _array(inside[1], path, (2,))
    return Anything(name=path)


def _single(kind: type, path: str, depth: int) -> Any:
    """A value that is no collection."""
    if issubclass(kind, Enum):
        return list(kind)[0 if _LEAST.get() else -1]
    if issubclass(kind, BaseModel):
        kinds = {name: field.annotation for name, field in kind.model_fields.items()}
        return kind.model_construct(**_filled(kinds, path, depth))
    if dataclasses.is_dataclass(kind):
        hints = _hints(kind)
        made = object.__new__(kind)
        names = {field.name: hints[field.name] for field in dataclasses.fields(kind)}
        values = _filled(names, path, depth)
        for name, shape in _shapes(kind).items():
            if typing.get_origin(names.get(name)) is np.ndarray:
                values[name] = _array(typing.get_args(names[name])[1], f"{path}.{name}", shape)
        for name, value in values.items():
            object.__setattr__(made, name, value)
        with contextlib.suppress(AttributeError):
            object.__setattr__(made, PLACE, path)
        return made
    maker = _MAKERS.get(kind)
    return Anything(name=path) if maker is None else maker(path)


def _filled(kinds: Mapping[str, Any], path: str, depth: int) -> dict[str, Any]:
    return {name: stand_in(kind, f"{path}.{name}", depth + 1) for name, kind in kinds.items()}


def _number(path: str) -> int:
    """A number from 100 to 9999."""
    return 100 + crc32(path.encode()) % 9900


def _array(kind: Any, path: str, shape: tuple[int, ...]) -> Any:
    """Numbers of a shape; whole ones are rows of what has two, and of two truths one holds."""
    scalar = typing.get_args(kind)[0]
    count = math.prod(shape)
    if scalar is np.bool_:
        return np.arange(count).reshape(shape) % 2 == 1
    if scalar is np.int64:
        return np.arange(count).reshape(shape) % 2
    return np.reshape(_numbers(path, count), shape) / 8.0


@cache
def _numbers(path: str, count: int) -> tuple[int, ...]:
    return tuple(_number(f"{path}[{place}]") for place in range(count))


@cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


@cache
def _shapes(kind: type) -> dict[str, tuple[int, ...]]:
    """The shapes of arrays that the docstring of a dataclass states, with 2 for any letter."""
    return {
        name: tuple(
            int(size) if size.isdigit() else 2 + size.count("+") for size in _SIZES.findall(inside)
        )
        for names, inside in _STATED.findall(inspect.getdoc(kind) or "")
        for name in names.split(", ")
    }


_STATED = re.compile(r"^ +([a-z]\w*(?:, \w+)*): \((\w[^)]*),?\)", re.MULTILINE)
_SIZES = re.compile(r"[^\s,][^,]*")
_MAKERS: Mapping[type, Callable[[str], Any]] = {
    str: str,
    bool: lambda _path: not _LEAST.get(),
    int: _number,
    float: lambda path: _number(path) / 1000.0,
    bytes: str.encode,
    Path: lambda path: Path("PLACE", path.replace("/", "_")),
    UUID: lambda path: UUID(int=crc32(path.encode())),
    date: lambda path: date(2017, 1, 1) + timedelta(_number(path)),
    datetime: lambda path: datetime(2017, 1, 1, tzinfo=UTC) + timedelta(hours=_number(path)),
    timedelta: lambda path: timedelta(seconds=_number(path)),
    object: str,
    type(None): lambda _path: None,
}
"""What makes a value of a type."""
