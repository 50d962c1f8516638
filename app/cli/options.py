"""Options of commands, declared once: as the fields of frozen dataclasses.

A command takes objects of such dataclasses among its parameters. `with_options` gives typer what it
reads: a function with one option for each field, which makes the objects and calls the command.
"""

import inspect
from collections.abc import Callable
from copy import copy
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.models import ArgumentInfo, OptionInfo

from amers.app.errors import InputError
from amers.services.docstrings import attribute_descriptions

FromMilli = Annotated[float | None, typer.Option(min=0.001)]
"""A positive number, 0.001 at least: a length in metres, or an error in pixels."""
FromCenti = Annotated[float | None, typer.Option(min=0.01)]
"""A positive number, 0.01 at least: a length in metres."""


GeoidFile = Annotated[Path | None, typer.Option()]
"""A grid file of a geoid: by its path, or its name alone where PROJ keeps its grids."""


def existing_place(text: str) -> str:
    """The text of an address, or of a path, which must exist.

    Raises:
        BadParameter: it does not.
    """
    if "://" not in text and not Path(text).exists():
        raise typer.BadParameter(f"path '{text}' does not exist")
    return text


Places = Annotated[tuple[str, ...], typer.Option(parser=existing_place, metavar="PATH")]
"""Paths and addresses of files, folders and catalogues: an option that is given repeatedly."""


class Shown(dict[str, OptionInfo | ArgumentInfo | None]):
    """The fields of a dataclass that a command has options for, in the order of its help.

    `Annotated[FILES, Shown(image=typer.Argument(), sigma_m=typer.Option(min=0.01), bands=None)]` asks
    for an object of FILES whose other fields have their defaults.
    """


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """A command with an option for each field of the dataclasses among its parameters, in their order.

    An option has the name of its field, in dashes, and the default of the field; it is required without
    one. Its help is the text of the field below `Attributes:` in the docstring of the dataclass.

    A `bool` is a flag, and a `tuple[X, ...]` an option that is given repeatedly. A `Path` is a file or a
    folder that must exist. `Annotated[TYPE, typer.Option(…)]` in the dataclass, or `Shown` in the
    command, adds bounds, another name (`--name`) or a short name (`-n`). A path that has one of these
    may be missing, unless it has `exists=True`.
    """
    hints = get_type_hints(command, include_extras=True)
    parameters = []
    groups: dict[str, tuple[type[Any], list[str]]] = {}
    for parameter in inspect.signature(command).parameters.values():
        kind, *stated = _parts(hints[parameter.name])
        if is_dataclass(kind) and isinstance(kind, type):
            made = _parameters(kind, stated[0] if stated else {})
            groups[parameter.name] = (kind, [option.name for option in made])
            parameters += made
        else:
            hint = hints[parameter.name]
            parameters.append(parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY))

    @wraps(command)
    def run(**given: Any) -> None:
        made = {name: _made(kind, options, given) for name, (kind, options) in groups.items()}
        command(**given, **made)

    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return run


def option_name(field: str) -> str:
    """The option of a field of this name."""
    return f"--{field.replace('_', '-')}"


def refuse_alone(file: str, options: Any, *statements: str) -> None:
    """Refuse options that belong to a file which is not given.

    Args:
        file: field of the file, or of the files.
        options: object with this field.
        statements: fields of the same object that describe the file, or are of no use without it.

    Raises:
        InputError: one of them is given without the file.
    """
    alone = [option_name(name) for name in statements if getattr(options, name) not in (None, ())]
    if alone and not getattr(options, file):
        name = option_name(file)
        belong, them = ("it belongs", "it") if len(alone) == 1 else ("they belong", "them")
        raise InputError(
            f"{', '.join(alone)}: given without {name}, to which {belong}; add {name} FILE, or leave "
            f"{them} out"
        )


def words_of(options: Any) -> list[str]:
    """The words of a command line that give these options, without those that have their defaults."""
    words = []
    for field in fields(options):
        name, value = option_name(field.name), getattr(options, field.name)
        if value is True:
            words.append(name)
        elif value != field.default:
            values = value if isinstance(value, tuple) else (value,)
            words += [word for one in values for word in (name, str(one))]
    return words


def _parameters(kind: type[Any], shown: dict[str, Any]) -> list[inspect.Parameter]:
    """The parameters of a function that typer reads, for fields of a dataclass: those shown, or all."""
    hints = get_type_hints(kind, include_extras=True)
    helps = attribute_descriptions(kind)
    by_name = {field.name: field for field in fields(kind)}
    return [
        _parameter(by_name[name], hints[name], helps[name], shown.get(name)) for name in shown or by_name
    ]


def _parameter(field: Field[Any], hint: Any, text: str, shown: Any) -> inspect.Parameter:
    value, *stated = _parts(hint)
    default = inspect.Parameter.empty if field.default is MISSING else field.default
    option = copy(shown or (stated[0] if stated else typer.Option(exists=Path in _kinds(value))))
    option.help = text[0].upper() + text[1:]
    if isinstance(option, OptionInfo) and not str(option.default).startswith("--"):
        option.param_decls = (option_name(field.name),)
    if get_origin(value) is tuple:
        value = list[get_args(value)[0]]  # type: ignore[misc]
        if default == ():
            value, default = value | None, None
    annotation = Annotated[value, option]  # type: ignore[valid-type]
    return inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


def _parts(hint: Any) -> tuple[Any, ...]:
    """A type, and what is annotated to it."""
    return get_args(hint) if get_origin(hint) is Annotated else (hint,)


def _kinds(value: Any) -> tuple[Any, ...]:
    """The types that a type is made of: those of a union, or of a tuple."""
    return get_args(value) or (value,)


def _made(kind: type[Any], options: list[str], given: dict[str, Any]) -> Any:
    """An object of a dataclass of the values of options, which are taken out of those given."""
    values = {name: given.pop(name) for name in options}
    stated = {name: value for name, value in values.items() if value is not None}
    return kind(**{name: tuple(v) if isinstance(v, list) else v for name, v in stated.items()})
