"""Progress of commands on standard error: a bar on a terminal, elsewhere a line for every tenth."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import typer
from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from amers.app.printable import printable
from amers.services.types import Progress


@contextmanager
def shown_progress() -> Iterator[Progress]:
    """A `Progress` that shows on standard error."""
    if not sys.stderr.isatty():
        yield _lines()
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)

        def report(fraction: float, message: str) -> None:
            bar.update(task, completed=fraction, description=printable(message))

        yield report


def _lines() -> Progress:
    last_tenth = -1

    def report(fraction: float, message: str) -> None:
        nonlocal last_tenth
        tenth = int(fraction * 10.0)
        if tenth > last_tenth:
            last_tenth = tenth
            typer.echo(f"{10 * tenth:3d} % {printable(message)}", err=True)

    return report
