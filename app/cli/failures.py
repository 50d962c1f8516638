"""The sentence that a command ends with when it fails, and its exit status."""

import traceback

import typer

from amers.app.cli.exit_status import FAILURE, REFUSED, exit_status, is_refusal
from amers.app.errors import StorageOutage, is_no_memory, is_no_room
from amers.app.outages import outage_of
from amers.app.printable import printable


def failure(error: Exception) -> tuple[str, int]:
    """What to print for an error that ended a command, one sentence on one line, and the exit status."""
    if is_refusal(error):
        return _one_line(error), exit_status(error)
    if isinstance(error, typer.TyperException):
        return _usage(error), REFUSED
    status = REFUSED if isinstance(error, OSError) and error.filename is not None else FAILURE
    return _one_line(_sentence(error)), status


def _sentence(error: Exception) -> str:
    """What happened, for errors that are not about the input."""
    if is_no_room(error):
        return f"{error}: a disk is full; free some room, then run the command again"
    if is_no_memory(error):
        return f"{error}: this process got no more memory; use smaller inputs or fewer --jobs"
    if isinstance(error, StorageOutage):
        return f"{error}; see that the storage is mounted and can be used, then run the command again"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}; expected a place that this user can use"
    if _comes_from(error, "amers.app.client.errors"):
        return f"{error}; see that the service answers at this address, then run the command again"
    if (outage := outage_of(error)) is not None:
        return f"{outage.reason}; run the command again" if outage.again else outage.reason
    if isinstance(error, ConnectionError | TimeoutError):
        return f"a connection broke: {error}; run the command again"
    return (
        f"an error that should not happen: {type(error).__name__}: {error}; set AMERS_LOG_LEVEL=debug "
        "to see where, and report it"
    )


def print_traceback(error: Exception) -> None:
    """Print where an error comes from, on standard error."""
    traceback.print_exception(error)


def _comes_from(error: Exception, module: str) -> bool:
    """Whether a module defines a kind of error; it is not imported for commands that do without it."""
    return any(kind.__module__ == module for kind in type(error).__mro__)


def _usage(error: typer.TyperException) -> str:
    """What is wrong with a command line, and where to read on."""
    context = getattr(error, "ctx", None)
    words = context.command_path if context is not None else "amers"
    return f"{_one_line(error.format_message()).rstrip('.')}; see `{words} --help`"


def _one_line(text: object) -> str:
    return printable(" ".join(str(text).split()))
