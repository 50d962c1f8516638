"""What processes and endpoints hand on: each of their inputs alone, with what they call replaced.

A process is run with its least inputs and with all of them; then each input gets another value. What
differs in the notes of the recorders is where the input goes. Endpoints are called in the same way.
"""

import contextlib
import dataclasses
import inspect
import json
import re
import sys
import types
import typing
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, date, datetime
from enum import Enum
from itertools import chain
from pathlib import Path
from tempfile import gettempdir
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from fastapi.params import Depends
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.datastructures import Headers

from amers.app.api.marks import AskedPlace
from amers.app.main import ROUTERS
from amers.app.usecases.jobs import PROCESSES
from amers.app.usecases.processes import Process, Work
from tests.app.recorders import Recorders, leaves
from tests.app.stand_ins import Anything, least_results

GOLDEN = Path(__file__).parents[1] / "golden" / "wiring_of_jobs.json"
Found = dict[str, list[str]]
Notes = list[tuple[str, str]]
_CHANGING = re.compile(r" at 0x[0-9a-f]+| id='\d+'|/\d{12,}|" + re.escape(gettempdir()) + r"/[\w./-]+")
GIVES = "gives "
"""How notes of a result begin."""
_MOST = 300
"""Values of a result that are compared: larger ones are documents, which have tests of their own."""
RESULT = "what it gives"
"""Beside the inputs: the result with the least inputs, and with all."""
HANDED_ON = "what it hands on"
"""Beside the inputs: all that it calls something with, with the least inputs, and with all."""
LEAST = "with the least results"
"""Beside the inputs: what differs when nothing is true, known or found in what it calls."""
NO_INPUTS = (RESULT, HANDED_ON, LEAST)
_WHOLE = re.compile(r"\.inputs\.|^check_file_names\(0\)\.")
"""Notes of all inputs together, which do not tell where one of them goes."""

FORMS: Mapping[str, tuple[Any, Any]] = {
    "along": ("17,43", "18,44"),
    "bands": ("1,2", "2,3"),
    "bbox": ((17.01, 43.02, 17.03, 43.04), (17.02, 43.03, 17.04, 43.05)),
    "content_type": ("application/offset+octet-stream", "text/plain"),
    "crop_origin": ("17,19", "23,29"),
    "datetime": ("2017-03-19T11:13:00Z", "2018-03-19T11:13:00Z"),
    "heights_m": ((17.0, 19.0), (18.0, 23.0)),
    "matrix_set": ("WebMercatorQuad", "OtherQuad"),
    "outputs": ({}, {}),
    "places": ([AskedPlace(line=17, sample=19)], [AskedPlace(lon=18, lat=23)]),
    "upload_checksum": (
        f"sha1 {b64encode(bytes(20)).decode()}",
        f"sha256 {b64encode(bytes(32)).decode()}",
    ),
    "upload_metadata": ("filename dGV4dA==", "filename b3RoZXI="),
    "vectors": ("text.geojson", "other.geojson"),
}
"""Two values of inputs whose text, or order, has a form."""
APART: Mapping[str, tuple[str, ...]] = {
    "ingest-block": ("upload",),
    "make-mosaic": ("height_m",),
    "GET /collections/points/chips": ("query.ids",),
    "POST /collections/points/chips": ("body.ids",),
    "GET /search": ("query.bbox", "query.crs", "query.properties"),
}
"""Inputs that others rule out, and that are not among all."""
REQUEST: Mapping[str, Any] = {"headers": Headers(), "query_params": {"f": "json"}}
"""What a request has besides the parameters that are named."""


def interfaces() -> Iterator[tuple[str, Callable[[], Found]]]:
    """Every process and endpoint, with what finds where its inputs go."""
    for process in PROCESSES.values():
        yield process.id, lambda process=process: of_process(process)
    for router in ROUTERS:
        for route in router.routes:
            if isinstance(route, APIRoute):
                yield name_of(route), lambda route=route: of_endpoint(route)


def name_of(route: APIRoute) -> str:
    """Methods and path of a route."""
    return f"{' '.join(sorted(route.methods or ()))} {route.path}"


def of_process(process: Process) -> Found:
    """Where the inputs of a process go."""

    def call(inputs: dict[str, Any]) -> Notes:
        modules = (process.check.__module__, process.run.__module__)
        given = _filled(process.inputs, inputs)
        with _recorded(*modules) as recorders:
            recorders.attempt(lambda: process.check(Anything(), Anything(), given))
            work = Work(*(Anything(name=one.name) for one in dataclasses.fields(Work)))
            work = dataclasses.replace(work, inputs=given)
            recorders.attempt(lambda: process.run(work)(Anything()))
        return recorders.notes

    types_of = {
        name: kind
        for name, kind in _paths(process.inputs)
        if not dataclasses.is_dataclass(_inside(kind))
    }
    least = {
        field.name
        for field in dataclasses.fields(process.inputs)
        if field.default is field.default_factory is dataclasses.MISSING
    }
    return _found(call, types_of, least, APART.get(process.id, ()))


def of_endpoint(route: APIRoute) -> Found:
    """Where the parameters of an endpoint go."""
    function = route.endpoint
    hints = typing.get_type_hints(function, include_extras=True)
    signature = inspect.signature(function)
    own = {name: hints[name] for name in signature.parameters if _is_given(hints[name])}

    def call(inputs: dict[str, Any]) -> Notes:
        given = {
            name: inputs.get(
                name, None if parameter.default is inspect.Parameter.empty else parameter.default
            )
            if name in own
            else Anything(name=name, **(REQUEST if name == "request" else {}))
            for name, parameter in signature.parameters.items()
        }
        with _recorded(function.__module__) as recorders:
            recorders.attempt(lambda: _answer(function, given))
        return recorders.notes

    least = {name for name in own if signature.parameters[name].default is inspect.Parameter.empty}
    return _found(call, own, least, APART.get(name_of(route), ()))


def _answer(function: Callable[..., Any], given: dict[str, Any]) -> Any:
    """What an endpoint gives, called to its first pause if it is asynchronous."""
    result = function(**given)
    if not inspect.iscoroutine(result):
        return result
    try:
        return result.send(None)
    except StopIteration as end:
        return end.value
    finally:
        result.close()


class _Attempts(Recorders):
    """Recorders that also note why a call ended."""

    def attempt(self, call: Callable[[], Any]) -> None:
        """Make a call, and note what it gives, or the exception that ends it."""
        try:
            self.notes.extend((GIVES + path, text) for path, text in leaves("", call()))
        except Exception as error:
            self.notes.append((f"ends with {type(error).__name__}", str(error).split("\n")[0][:120]))


@contextlib.contextmanager
def _recorded(*modules: str) -> Iterator[_Attempts]:
    """All that some modules call outside of themselves, recorded."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        recorders = _Attempts(monkeypatch, modules[0])
        yield recorders
    recorders.notes = [
        (path, _CHANGING.sub("", text)) for path, text in recorders.notes if not _WHOLE.search(path)
    ]


def _found(
    call: Callable[[dict[str, Any]], Notes], own: dict[str, Any], least: set[str], apart: tuple[str, ...]
) -> Found:
    """What differs in the notes when one input differs, beside the least inputs and beside all."""
    values = {name: _named_value(name, kind, number) for number, (name, kind) in enumerate(own.items())}
    others = {
        name: _named_value(name, kind, number, 1) for number, (name, kind) in enumerate(own.items())
    }
    for model, field in (name.split(".") for name in apart if "." in name and name not in own):
        for given in (values, others):
            object.__setattr__(given[model], field, None)
    beside = (
        {name: values[name] for name in values if name in least},
        {name: values[name] for name in values if name not in apart},
    )
    before = [set(call(inputs)) for inputs in beside]
    found = {RESULT: _texts(note for note in chain(*before) if note[0].startswith(GIVES))}
    found[HANDED_ON] = _texts(note for note in chain(*before) if not note[0].startswith(GIVES))
    with least_results():
        found[LEAST] = _texts(
            note for inputs in beside for note in set(call(inputs)) - set(chain(*before))
        )
    for name, other in others.items():
        moved: set[str] = set()
        for inputs, notes in zip(beside, before, strict=True):
            after = set(call({**inputs, name: other}))
            moved |= {f"{path} = {text}" for path, text in after - notes}
            moved |= {f"no {path} = {text}" for path, text in notes - after if after < notes}
        found[name] = sorted(moved)
    return found


def _texts(notes: Iterable[tuple[str, str]]) -> list[str]:
    """Some notes, sorted, each once; of those that are too many their number."""
    texts = sorted({f"{path} = {text}" for path, text in notes})
    return texts if len(texts) <= _MOST else [f"{len(texts)} values"]


def _is_given(hint: Any) -> bool:
    """Whether a parameter is a value of the request, not a dependency."""
    if any(isinstance(one, Depends) for one in typing.get_args(hint)):
        return False
    inside = _inside(hint)
    return (
        inside in (str, int, float, bool, UUID, date, datetime, bytes)
        or typing.get_origin(inside) in (typing.Literal, list, tuple, dict)
        or (isinstance(inside, type) and issubclass(inside, Enum | BaseModel))
    )


def _inside(kind: Any) -> Any:
    """The type of a value, without None and annotations."""
    origin = typing.get_origin(kind)
    if origin is typing.Annotated:
        return _inside(typing.get_args(kind)[0])
    if origin in (typing.Union, types.UnionType):
        return _inside(next(one for one in typing.get_args(kind) if one is not type(None)))
    return kind


def _paths(of: type[Any], start: str = "") -> Iterator[tuple[str, Any]]:
    """The fields of a dataclass and of those in it, by names with dots."""
    hints = typing.get_type_hints(of)
    for field in dataclasses.fields(of):
        kind = hints[field.name]
        yield start + field.name, kind
        if dataclasses.is_dataclass(_inside(kind)):
            yield from _paths(_inside(kind), f"{start}{field.name}.")


def _filled(of: type[Any], inputs: dict[str, Any]) -> Any:
    """A dataclass with some of its fields, whatever its own checks say of them."""
    own = {name: value for name, value in inputs.items() if "." not in name}
    for field in dataclasses.fields(of):
        below = {
            name.removeprefix(f"{field.name}."): value
            for name, value in inputs.items()
            if name.startswith(f"{field.name}.")
        }
        if below:
            own[field.name] = _filled(_inside(typing.get_type_hints(of)[field.name]), below)
        elif field.name not in own and field.default is not dataclasses.MISSING:
            own[field.name] = field.default
        elif field.name not in own and field.default_factory is not dataclasses.MISSING:
            own[field.name] = field.default_factory()
    made = object.__new__(of)
    for name, value in own.items():
        object.__setattr__(made, name, value)
    return made


def _named_value(name: str, kind: Any, number: int, other: int = 0) -> Any:
    """A value of the form that an input of this name has."""
    forms = FORMS.get(name.split(".")[-1])
    return _value(kind, number, other) if forms is None else forms[other]


def _value(kind: Any, number: int, other: int = 0) -> Any:
    """A value that no other input has; `other` is another one."""
    kind = _inside(kind)
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    unlike = 3 + 2 * number + other
    if origin is typing.Literal:
        return inside[(len(inside) - 1 - other) % len(inside)]
    if origin in (tuple, list):
        kinds = inside if origin is tuple and inside[-1] is not Ellipsis else inside[:1] * 2
        made = [_value(one, number + 40 * place, other) for place, one in enumerate(kinds)]
        return tuple(made) if origin is tuple else made
    if origin is not None:
        return {f"key{unlike}": unlike}
    if isinstance(kind, type) and issubclass(kind, Enum):
        return list(kind)[-1 - other]
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        fields = kind.model_fields
        return kind.model_construct(
            **{
                name: _named_value(name, field.annotation, number + 10 * place, other)
                for place, (name, field) in enumerate(fields.items())
            }
        )
    makers: dict[Any, Callable[[], Any]] = {
        bool: lambda: not other,
        int: lambda: unlike,
        float: lambda: unlike + 0.25,
        UUID: lambda: UUID(int=unlike),
        date: lambda: date(2017, 1, 1 + unlike % 28),
        datetime: lambda: datetime(2017, 1, 1 + unlike % 28, tzinfo=UTC),
        bytes: lambda: f"bytes{unlike}".encode(),
        np.ndarray: lambda: np.full(2, unlike),
    }
    return makers.get(kind, lambda: f"text{unlike}")()


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps({name: find() for name, find in interfaces()}, indent=1) + "\n")
    sys.exit()
