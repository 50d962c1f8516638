"""What a command hands on: each of its options alone, with what it calls replaced by recorders.

Every function of the use cases, the database and the sciences that a module of the command line has is
replaced by one that notes its arguments. A command is run without an option and with it; what differs in
the notes is where the option goes, and as what.
"""

import contextlib
import inspect
import json
import re
import sys
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime
from enum import Enum
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from types import SimpleNamespace
from typing import Any
from uuid import UUID

import pytest
from click.testing import Result
from typer.testing import CliRunner

from amers.app.cli.commands import COMMANDS
from amers.app.cli.main import app
from amers.app.cli.on_demand import Group, Tree, _load
from amers.app.cli.supervisor import Supervisor
from amers.app.client import Client
from amers.app.errors import InputError
from amers.app.request_context import Origin
from tests.app.recorders import Recorders
from tests.app.stand_ins import Anything, _AnyText, least_results

GOLDEN = Path(__file__).parents[1] / "golden" / "wiring.json"
PACKAGE = "amers.app.cli."
SHOWN = "what is shown"
"""Beside the options of a command: its result, as it goes to the terminal."""
HANDED_ON = "what is handed on"
"""Beside the options of a command: all that it calls something with when no option is given."""
LEAST = "what is shown of the least"
"""Beside the options of a command: what is shown of results in which nothing is true, known or found."""
WITH = "with"
"""Beside the options of a command: what those add that others need."""
NO_OPTIONS = (SHOWN, HANDED_ON, LEAST, WITH, "--json")
ASIDE = "(on standard error) "
"""How lines begin that are not the result."""
AN_ID = "01234567-89ab-4cde-8f01-23456789abcd"
TEXTS: Mapping[str, str] = {
    "--host": "127.0.0.7",
    "--bbox": "17.01,43.02,17.03,43.04",
    "--crs": "EPSG:32617",
    "--to": "EPSG:32617",
    "--control-crs": "EPSG:32617",
    "--crop-origin": "17,19",
    "--vertical": "EGM96",
    "--control-vertical": "EGM96",
    "--kernel": "bilinear",
    "--scope": "read",
    "--sigma-m": "17.5",
    "reference": "flat@2",
    "--control-sigma-m": "17,19",
    "--control-frame-sigma-m": "17,19",
    "--control-dem-frame-sigma-m": "17,19",
    "--site-frame-sigma-m": "17,19",
    "--point-sigma-m": "17,19",
    "--columns": "lon=a,lat=b",
    "--control-columns": "lon=a,lat=b",
    "--gsd-m": "17,19",
    "--sigma-axes": "ecef",
    "--control-sigma-axes": "ecef",
    "--heights-m": "17,19",
    "--cloud-limits": "17,19",
    "--control-points": "17,19",
    "--pixels": "corner",
    "batch": "batches()[0]",
}
"""Values of options whose text has a form."""
BESIDE: Mapping[str, tuple[str, ...]] = {
    "scene ortho": ("--vertical", "ellipsoid"),
    "vectors correct": ("--vertical", "ellipsoid"),
    "vectors project": ("--vertical", "ellipsoid"),
    "block renew": ("--image", "image"),
    "block frame": ("--control", "FILE", "--images", "FILE"),
    "production run": ("--catalogue", "FILE"),
    "base make": ("--bbox", "1.0", "2.0", "1.1", "2.1"),
}
"""Words that commands need beside what they require, FILE for a file."""
_DEM = ("--dem", "FILE")
COMPANIONS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("--control-ortho-", ("--control-ortho", "FILE", "--control-dem", "FILE")),
    (
        "--control-dem-",
        ("--control", "FILE", "--control-dem", "FILE", "--control-dem-vertical", "ellipsoid"),
    ),
    ("--control-", ("--control", "FILE")),
    ("--reference-", ("--reference", "FILE", *_DEM, "--vertical", "ellipsoid")),
    ("--reference", (*_DEM, "--vertical", "ellipsoid")),
    ("--dem-", (*_DEM, "--dem-vertical", "ellipsoid")),
    ("--dem", ("--reference", "FILE")),
    ("--vertical", ("--reference", "FILE", *_DEM)),
    ("--geoid", ("--reference", "FILE", *_DEM, "--vertical", "EGM2008")),
    ("--exclude-heights", (*_DEM, "--vertical", "ellipsoid")),
    ("--land-cover", (*_DEM, "--vertical", "ellipsoid")),
    ("--token", ("--server", "http://127.0.0.1:9")),
)
"""What an option needs beside it, by how its name begins; the first that fits."""
_FILES = ("dem", "control_dem", "model", "reference", "control_ortho")
"""Options whose files the command itself looks for."""
_USER = Origin().actor_name
"""As the audit names who calls commands."""
_OF_THIS_RUN = re.compile(
    r" at 0x[0-9a-f]+| id='\d+'|/\d{12,}|[\d-]+ [\d:]+\.\d{6}\+00:00|(?<=seconds)\W+[\d.]+,?|"
    r"(?<=time \(s\)) +[\d.]+|" + re.escape(gettempdir()) + r"/[\w.-]+"
)
"""Addresses of objects, times of now, durations, and temporary folders."""


def commands(tree: Tree = COMMANDS, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The words of every command."""
    for name, entry in tree.items():
        if isinstance(entry, Group):
            yield from commands(entry.commands, (*words, name))
        else:
            yield (*words, name)


def parameters(words: tuple[str, ...]) -> list[Any]:
    """The arguments and options of a command."""
    entry: Any = COMMANDS
    for word in words:
        entry = entry.commands[word] if isinstance(entry, Group) else entry[word]
    return [one for one in _load(words[-1], entry).params if one.name != "help"]


def value_of(parameter: Any, folder: Path) -> list[str]:
    """Words that give a parameter a value that is not its default."""
    option = parameter.opts[0]
    given = [option] if option.startswith("-") else []
    if getattr(parameter, "is_flag", False):
        names = parameter.secondary_opts if parameter.default is True else parameter.opts
        return [names[0]]
    kind = _kind(parameter.type_descriptor.annotation)
    if kind is Path:
        return [*given, str(_file(parameter, folder))]
    if kind in (int, float):
        return [*given, _number(parameter, kind)]
    if kind is UUID:
        return [*given, AN_ID]
    if kind is datetime:
        return [*given, f"{datetime(2017, 3, 19):{parameter.type_descriptor.parameter_info.formats[0]}}"]
    if parameter.nargs > 1:
        return [*given, *(str(17 + number) for number in range(parameter.nargs))]
    if parameter.type_descriptor.parameter_info.exists or parameter.name in _FILES:
        return [*given, str(_file(parameter, folder))]
    choices = _choices(kind)
    if choices:
        return [*given, next(one for one in reversed(choices) if one != str(parameter.default))]
    return [*given, TEXTS.get(option, f"text-of-{parameter.name}")]


def _kind(annotation: Any) -> Any:
    """The type of one value."""
    if typing.get_origin(annotation) is typing.Annotated:
        return _kind(typing.get_args(annotation)[0])
    inside = [one for one in typing.get_args(annotation) if one not in (type(None), Ellipsis)]
    if typing.get_origin(annotation) is typing.Literal or not inside:
        return annotation
    return _kind(inside[0])


def _choices(kind: Any) -> list[str]:
    if typing.get_origin(kind) is typing.Literal:
        return [str(one) for one in typing.get_args(kind)]
    return [str(one.value) for one in kind] if isinstance(kind, type) and issubclass(kind, Enum) else []


def _number(parameter: Any, kind: type) -> str:
    info = parameter.type_descriptor.parameter_info
    low = info.min if info.min is not None else 0
    high = info.max if info.max is not None else low + 40
    value = low + (high - low) * 0.4375
    return str(round(value)) if kind is int else str(value)


def _file(parameter: Any, folder: Path) -> Path:
    info = parameter.type_descriptor.parameter_info
    path = folder / parameter.name
    if info.exists and not info.file_okay:
        path.mkdir(exist_ok=True)
    elif info.exists or parameter.name in _FILES:
        path.write_text("")
    return path


def run(words: list[str], folder: Path) -> list[tuple[str, str]]:
    """What a command hands on, without the names of temporary folders."""
    notes, result = _invoked(words, folder)
    if result is not None:
        notes += [(SHOWN, line.rstrip()) for line in result.stdout.splitlines()]
        aside = result.stderr.splitlines() if "Usage: " not in result.stderr else []
        notes += [(SHOWN, f"{ASIDE}{line.rstrip()}") for line in aside]
        notes.append(("exit status", str(result.exit_code)))
    return [
        (path, _OF_THIS_RUN.sub("", text.replace(str(folder), "FOLDER").replace(_USER, "USER")))
        for path, text in notes
    ]


def refusals(words: tuple[str, ...], folder: Path) -> Iterator[tuple[str, tuple[str, ...], str]]:
    """Each option that belongs to others, those, and why it is refused alone; empty if it is not."""
    own, required = parameters(words), required_by(words, folder)
    for one in own:
        needed = companions(one, own, folder)[::2]
        if needed and not {one.opts[0], *needed} & set(required):
            _, result = _invoked([*words, *required, *value_of(one, folder)], folder)
            reason = None if result is None else result.exception
            yield one.opts[0], needed, str(reason) if isinstance(reason, InputError) else ""


def _invoked(words: list[str], folder: Path) -> tuple[list[tuple[str, str]], Result | None]:
    """What a command hands on to recorders, and how it ends."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("AMERS_DATA_FOLDER", str(folder / "kept"))
        monkeypatch.chdir(folder / "empty")
        recorders = Recorders(monkeypatch, PACKAGE)
        _record_service(recorders, monkeypatch)
        monkeypatch.setattr(_AnyText, "asked", staticmethod(recorders.note))
        result = None
        with contextlib.suppress(Exception):
            result = CliRunner().invoke(app, words)
        return recorders.notes, result


def _record_service(recorders: Recorders, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let nothing listen, no process run and no service be asked: what they are given is noted.

    The demonstration places files as for a user who is not root.
    """
    asked = {
        name: recorders.of(function)
        for name, function in vars(Client).items()
        if inspect.isfunction(inspect.unwrap(function)) and not name.startswith("_")
    }

    def client(*given: Any) -> contextlib.AbstractContextManager[SimpleNamespace]:
        recorders.note("Client", dict(enumerate(given)))
        return contextlib.nullcontext(SimpleNamespace(**asked))

    def listen(address: tuple[str, int], **options: Any) -> Anything:
        recorders.note("create_server", {"address": address, **options})
        return Anything(name=f"socket of {address[0]}", **{"fileno.return_value": 17})

    def run_children(_own: Supervisor, children: Any, at_stop: Callable[[], None]) -> None:
        recorders.note("Supervisor.run", {"children": children})
        at_stop()

    for module in [one for name, one in sys.modules.items() if name.startswith(PACKAGE)]:
        if hasattr(module, "Client"):
            monkeypatch.setattr(module, "Client", client)
    monkeypatch.setattr("os.getuid", lambda: 1000)
    monkeypatch.setattr("socket.create_server", listen)
    monkeypatch.setattr(Supervisor, "run", run_children)


def wiring(words: tuple[str, ...], folder: Path) -> dict[str, list[str]]:
    """Where each option of a command goes, and as what."""
    own = parameters(words)
    required = required_by(words, folder)
    base = run([*words, *required], folder)
    found = {SHOWN: _shown(base), HANDED_ON: _texts(note for note in base if note[0] != SHOWN)}
    with least_results():
        asked = [[], ["--json"]] if any("--json" in one.opts for one in own) else [[]]
        found[LEAST] = [
            line for more in asked for line in _shown(run([*words, *required, *more], folder))
        ]
    bases = {(): base}
    for one in own:
        if one.required:
            value = value_of(one, folder)[-1].replace(str(folder), "FOLDER")
            found[one.opts[0]] = sorted(
                {text for text in _texts(base) if value in text.partition(" = ")[2]}
            )
            continue
        with_it = companions(one, own, folder)
        if with_it not in bases:
            bases[with_it] = run([*words, *required, *with_it], folder)
            found[" ".join((WITH, *with_it[::2]))] = _moved(base, bases[with_it])
        notes = run([*words, *required, *with_it, *value_of(one, folder)], folder)
        found[one.opts[0]] = _shown(notes) if one.opts[0] == "--json" else _moved(bases[with_it], notes)
    return found


def _shown(notes: list[tuple[str, str]]) -> list[str]:
    return [text for path, text in notes if path == SHOWN]


def _texts(notes: Iterable[tuple[str, str]]) -> list[str]:
    """Notes as texts, each once, in their order."""
    return list(dict.fromkeys(f"{path} = {text}" for path, text in notes))


def _moved(before: list[tuple[str, str]], after: list[tuple[str, str]]) -> list[str]:
    """What an option adds to the notes; where it adds nothing, what it takes from them."""
    added = sorted({f"{path} = {text}" for path, text in set(after) - set(before)})
    return added or sorted({f"no {path} = {text}" for path, text in set(before) - set(after)})


def companions(option: Any, own: list[Any], folder: Path) -> tuple[str, ...]:
    """What an option needs, without itself and without options that the command does not have."""
    name = option.opts[0]
    needs = next((more for start, more in COMPANIONS if name.startswith(start)), ())
    names = {name for one in own for name in one.opts} - {name}
    return tuple(
        word
        for needed, value in zip(needs[::2], needs[1::2], strict=True)
        if needed in names
        for word in (needed, str(folder / "beside") if value == "FILE" else value)
    )


def required_by(words: tuple[str, ...], folder: Path) -> list[str]:
    """Words that a command does nothing without, with the files that they name, in a new folder."""
    (folder / "beside").write_text("")
    (folder / "empty").mkdir()
    beside = [str(folder / "beside") if w == "FILE" else w for w in BESIDE.get(" ".join(words), ())]
    return [word for one in parameters(words) if one.required for word in value_of(one, folder)] + beside


def limits(words: tuple[str, ...], folder: Path) -> Iterator[tuple[str, float, float, list[str]]]:
    """Each option at each of its limits, but for defaults: a value between, the limit, and its notes."""
    own, required = parameters(words), required_by(words, folder)
    for one in own:
        info = one.type_descriptor.parameter_info
        for limit in {info.min, info.max} - {None, one.default}:
            with_it = companions(one, own, folder)
            notes = run([*words, *required, *with_it, one.opts[0], str(limit)], folder)
            yield one.opts[0], float(value_of(one, folder)[-1]), limit, _texts(notes)


if __name__ == "__main__":
    found = {}
    for words_of_one in commands():
        with TemporaryDirectory() as scratch:
            found[" ".join(words_of_one)] = wiring(words_of_one, Path(scratch))
    GOLDEN.write_text(json.dumps(found, indent=1) + "\n")
