"""The command `amers`: noun, then verb. Each group of commands is one module, and one line here."""

import gc
import signal
import sys
from collections import UserDict
from importlib import import_module
from importlib.metadata import version
from types import FrameType
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command, get_group

from app.cli.exit_status import INTERRUPTED, exit_status
from app.errors import AmersError

OBJECTS_BEFORE_COLLECTION = 20_000
"""More than Python's 700: what is imported stays, and to look through it costs a tenth of the start."""

COMMANDS = {
    "block": "Blocks of control points: ingest, publish, withdraw, export.",
    "points": "Control points of published blocks: query, suspend, reinstate.",
    "scene": "Register and orthorectify scenes.",
    "vectors": "Vectors digitised on raw scenes, onto the map and back.",
    "reference": "Reference images, for scenes on ground without control points.",
    "production": "Make new blocks of points from images.",
    "db": "The database: schema, backup and restore with the stored files.",
    "store": "The storage of the files: verify, usage, adopt, sweep, trash.",
    "token": "Tokens of the callers of the API.",
    "demo": "Run the whole work on a simulated world.",
    "serve": "Run the API and one worker.",
    "worker": "Run a worker without the API.",
    "audit": "Show the audit trail.",
}
"""Groups of commands and single commands with their help, each in the module of its name."""


class Commands(UserDict[str, Any]):
    """The commands by name. The module of a command is imported on first use: some import much."""

    def __getitem__(self, name: str) -> Any:
        if self.data[name] is None:
            module = import_module(f"app.cli.{name}")
            self.data[name] = _group(module, name) if hasattr(module, "app") else _single(module, name)
            self.data[name].name = name
        return self.data[name]


class Amers(TyperGroup):
    """The group of all commands, whose help needs none of their modules."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = Commands(dict.fromkeys(COMMANDS))

    def list_commands(self, ctx: Any) -> list[str]:
        """The names of all commands."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The name and the help of a command, for lists of commands."""
        return TyperCommand(cmd_name, help=COMMANDS[cmd_name]) if cmd_name in COMMANDS else None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command to run, and the rest of the arguments."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, self.commands[name] if name in COMMANDS else command, rest


app = typer.Typer(
    name="amers",
    cls=Amers,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(version("amers"))
        raise typer.Exit


@app.callback()
def amers(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
) -> None:
    """An open base of 3D ground control points, and the registration of satellite scenes on them."""


def main() -> None:
    """Run one command; an `AmersError` is printed as one line, without a traceback."""
    gc.set_threshold(OBJECTS_BEFORE_COLLECTION)
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _exit)
    try:
        app()
    except AmersError as error:
        typer.echo(f"amers: {error}", err=True)
        sys.exit(exit_status(error))
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _group(module: Any, name: str) -> Any:
    """The group of commands of a module, with the help from `COMMANDS`."""
    group = get_group(module.app)
    group.help = COMMANDS[name]
    return group


def _single(module: Any, name: str) -> Any:
    """The command of a module without a group: its function of the same name."""
    one = typer.Typer(add_completion=False)
    one.command(name)(getattr(module, name))
    return get_command(one)


def _exit(number: int, frame: FrameType | None) -> None:
    """End by an exception, so that contexts close what they opened: the private database, a worker."""
    raise SystemExit(128 + number)


if __name__ == "__main__":
    main()
