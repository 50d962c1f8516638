"""The command `amers`, and the sentence that every error ends with."""

import gc
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from amers.app.child_processes import leave_out_working_folder
from amers.app.cli.commands import COMMANDS
from amers.app.cli.exit_status import FAILURE, INTERRUPTED, REFUSED
from amers.app.cli.failures import failure, print_traceback
from amers.app.cli.on_demand import GroupOnDemand
from amers.app.errors import AmersError
from amers.app.one_thread import use_one_thread

OBJECTS_BEFORE_COLLECTION = 20_000
"""More than Python's 700: what is imported stays, and to look through it costs a tenth of the start."""


class Amers(GroupOnDemand):
    """The group of all commands."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(COMMANDS, **attributes)


app = typer.Typer(
    name="amers",
    cls=Amers,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version  # a third of the start; only this option needs it

        typer.echo(version("amers"))
        raise typer.Exit


@app.callback()
def amers(
    context: typer.Context,
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version."),
    ] = False,
    options: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml",
            envvar="AMERS_OPTIONS",
            help="File with options of commands, such as dem under \\[scene.register].",
        ),
    ] = None,
) -> None:
    """An open base of 3D ground control points, and the registration of satellite scenes on them."""
    if options is not None:
        from amers.app.cli.options_file import read_options  # most commands have none

        context.default_map = read_options(options, COMMANDS)


def main() -> None:
    """Run one command; an error is printed as one sentence, without a traceback."""
    use_one_thread()
    leave_out_working_folder()
    gc.set_threshold(OBJECTS_BEFORE_COLLECTION)
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _exit)
    try:
        sys.exit(app(prog_name="amers", standalone_mode=False))
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except Exception as error:
        if _is_help(error):
            sys.exit(REFUSED)
        sentence, status = failure(error)
        if status == FAILURE and _debugs():
            print_traceback(error)
        typer.echo(f"amers: {sentence}", err=True)
        sys.exit(status)


def _is_help(error: Exception) -> bool:
    """Whether a group was called without a command: its help was printed."""
    return type(error).__name__ == "NoArgsIsHelpError"


def _debugs() -> bool:
    """Whether the settings ask for details."""
    from amers.app.config import read_settings  # most errors need no settings

    try:
        return read_settings().log_level == "debug"
    except AmersError:
        return False


def _exit(number: int, frame: FrameType | None) -> None:
    """End by an exception, so that contexts close what they opened: the private database, a worker."""
    raise SystemExit(128 + number)


if __name__ == "__main__":
    main()
