"""The parameters of every command in a file, so that help needs none of the modules of a command.

The functions of commands and the dataclasses of their options stand beside the work that they are for,
whose modules take seconds to import. `scripts/make_parameters.py` writes down what typer reads of each;
a test compares the file with the functions.
"""

import inspect
import json
from collections.abc import Callable
from datetime import datetime
from enum import Enum
from functools import cache, reduce
from operator import or_
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin
from uuid import UUID

import typer
from typer.models import ArgumentInfo, OptionInfo

RECORD = Path(__file__).with_name("parameters.json")
TYPES = {one.__name__: one for one in (bool, int, float, str, Path, UUID, datetime, NoneType)}
"""Types of single values, by the names in the file."""
_NOT_SHOWN = ("parser", "callback", "shell_complete", "autocompletion")
"""What is only for values that are given."""

Entry = dict[str, Any]


def recorded(function: str) -> Callable[..., None] | None:
    """A function that does nothing and has the parameters and the docstring of that of a command.

    Args:
        function: `MODULE:FUNCTION` below `amers.app.cli`; None for one that the file has not.
    """
    entry = _entries().get(function)
    if entry is None:
        return None

    def shown(**given: Any) -> None:
        pass

    shown.__doc__ = entry["help"]
    parameters = [_parameter(name, one) for name, one in entry["parameters"].items()]
    shown.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return shown


def record_of(command: Callable[..., None]) -> Entry:
    """What the file has of the function of a command, as `with_options` gives it to typer."""
    signature = inspect.signature(command)
    return {
        "help": inspect.getdoc(command),
        "parameters": {
            name: _record(parameter)
            for name, parameter in signature.parameters.items()
            if parameter.annotation is not typer.Context
        },
    }


@cache
def _entries() -> dict[str, Entry]:
    entries: dict[str, Entry] = json.loads(RECORD.read_text(encoding="utf-8"))
    return entries


def _record(parameter: inspect.Parameter) -> Entry:
    kind, info = get_args(parameter.annotation)
    usual = vars(typer.Argument() if isinstance(info, ArgumentInfo) else typer.Option())
    stated = {name: value for name, value in vars(info).items() if value != usual[name]}
    entry: Entry = {
        "is": "argument" if isinstance(info, ArgumentInfo) else "option",
        "type": _words(kind),
        "stated": {name: value for name, value in stated.items() if name not in _NOT_SHOWN},
    }
    if parameter.default is not inspect.Parameter.empty:
        # What is shown of a default in words may be another value on each machine.
        value = None if isinstance(info.show_default, str) else parameter.default
        entry["default"] = str(value) if isinstance(value, Path) else value
    return entry


def _parameter(name: str, entry: Entry) -> inspect.Parameter:
    info: ArgumentInfo | OptionInfo = typer.Argument() if entry["is"] == "argument" else typer.Option()
    for stated, value in entry["stated"].items():
        setattr(info, stated, value)
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=entry.get("default", inspect.Parameter.empty),
        annotation=Annotated[_type(entry["type"]), info],
    )


def _words(kind: Any) -> Any:
    """A type for the file: its name, `[Literal, VALUE, …]`, or `[KIND, TYPE, …]`: list, tuple, Union."""
    if kind in TYPES.values():
        return kind.__name__
    if isinstance(kind, type) and issubclass(kind, Enum):
        return ["Literal", *(one.value for one in kind)]
    inside = get_args(kind)
    if get_origin(kind) is Literal:
        return ["Literal", *inside]
    origin = {list: "list", tuple: "tuple", Union: "Union", UnionType: "Union"}[get_origin(kind)]
    return [origin, *map(_words, inside)]


def _type(words: Any) -> Any:
    """The type of its words in the file."""
    if isinstance(words, str):
        return TYPES[words]
    kind, *inside = words
    if kind == "Literal":
        return Literal[tuple(inside)]
    if kind == "list":
        return list[_type(inside[0])]  # type: ignore[misc]
    if kind == "tuple":
        return tuple[tuple(map(_type, inside))]  # type: ignore[misc]
    return reduce(or_, map(_type, inside))
