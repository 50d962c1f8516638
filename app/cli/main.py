"""The command `amers`: noun, then verb; a group of commands is one file, registered here by one line.

Exit codes: 0 done, 2 the input cannot be used, 3 the scene could not be registered, 1 anything else.
"""

import signal
import sys
from collections import UserDict
from importlib import import_module
from types import FrameType
from typing import Any

import typer
from typer.core import TyperGroup
from typer.main import get_command, get_group

from app.errors import AmersError, ComputationError

EXIT_REFUSED = 2
EXIT_NOT_REGISTERED = 3
EXIT_INTERRUPTED = 130

NAMES = (
    "block",
    "points",
    "scene",
    "reference",
    "production",
    "db",
    "token",
    "demo",
    "serve",
    "worker",
    "audit",
)
"""Groups of commands, and commands, each in the module of its name."""


class Commands(UserDict[str, Any]):
    """The commands by name; the file of one is read when it is asked for: some bring all the science."""

    def __getitem__(self, name: str) -> Any:
        if self.data[name] is None:
            module = import_module(f"app.cli.{name}")
            self.data[name] = get_group(module.app) if hasattr(module, "app") else _single(module, name)
            self.data[name].name = name
        return self.data[name]


class Amers(TyperGroup):
    """The group of all commands."""

    def __init__(self, **more: Any) -> None:
        super().__init__(**more)
        self.commands = Commands(dict.fromkeys(NAMES))


app = typer.Typer(
    name="amers",
    cls=Amers,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@app.callback()
def amers() -> None:
    """An open base of 3D ground control points, and the registration of satellite scenes on them."""


def main() -> None:
    """Run one command; an error that the user can understand is one line, not a trace."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _leave)
    try:
        app()
    except AmersError as error:
        typer.echo(f"amers: {error}", err=True)
        sys.exit(EXIT_NOT_REGISTERED if isinstance(error, ComputationError) else EXIT_REFUSED)
    except KeyboardInterrupt:
        sys.exit(EXIT_INTERRUPTED)


def _single(module: Any, name: str) -> Any:
    """A command that is no group: the function of its name."""
    one = typer.Typer(add_completion=False)
    one.command(name)(getattr(module, name))
    return get_command(one)


def _leave(number: int, frame: FrameType | None) -> None:
    """Ends by an exception, so that what was opened is closed: the private database, a worker."""
    raise SystemExit(128 + number)


if __name__ == "__main__":
    main()
