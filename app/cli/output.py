"""Output of commands: JSON with --json, a table on a terminal, tab-separated lines elsewhere."""

import dataclasses
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any
from uuid import UUID

import typer

from amers.app.cli.row_labels import SHARES, label
from amers.app.printable import printable
from amers.services.statements import Statement, gathered, worth_saying

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]

Row = Mapping[str, object]

_ALWAYS_SHOWN = ("damaged", "outdated", "problems")
"""Lists of which "none" is good news; rows of other empty lists are left out."""
_DECIMALS = 3
"""Decimals of numbers for people; small numbers have as many significant digits."""


def show(rows: Sequence[Row], *, as_json: bool) -> None:
    """Print records with the same fields as a JSON array, a table, or tab-separated lines with a header.

    On a pipe, every record is one line and every value one field of it, whatever the values are.
    """
    if as_json:
        print_json(rows)
    elif sys.stdout.isatty():
        _show_table(rows)
    elif rows:
        for fields in (map(_field_name, rows[0]), *(map(_field, row.values()) for row in rows)):
            typer.echo("\t".join(fields))


def _show_table(rows: Sequence[Row]) -> None:
    from rich.console import Console  # pipes do without its 0.06 s of CPU
    from rich.table import Table

    table = Table(*map(label, rows[0] if rows else ()))
    for row in rows:
        table.add_row(*map(as_text, row.values()))
    Console().print(table if rows else "none")


def show_one(record: Row, *, as_json: bool) -> None:
    """Print one record as a JSON object, or as one line per field that has a value.

    Lines have names with blanks, axes and units. What files state, under `statements`, is an array in
    JSON; people get it by `show_statements`.
    """
    if as_json:
        print_json(record)
        return
    record = dict(record)
    statements: Any = record.pop("statements", ())
    show_statements(statements)
    lines = {
        label(name): (_percent(value) if name in SHARES else as_text(value)) or "none"
        for name, value in record.items()
        if name in _ALWAYS_SHOWN or not _is_empty(value)
    }
    width = max(map(len, lines), default=0)
    for name, text in lines.items():
        typer.echo(f"{name:<{width}}  {text}")


def show_statements(statements: Iterable[Statement | Mapping[str, Any]]) -> None:
    """Print on standard error what was assumed of files, and what they state and was not used.

    Args:
        statements: as readers return them, or as members of a JSON document.
    """
    stated = [one if isinstance(one, Statement) else Statement(**one) for one in statements]
    for statement in worth_saying(gathered(stated)):
        typer.echo(f"amers: {printable(str(statement))}", err=True)


def print_json(value: object) -> None:
    """Print a value as JSON; dataclasses become objects, times ISO 8601."""
    typer.echo(json.dumps(value, indent=2, default=_as_json, allow_nan=False))


def as_text(value: object) -> str:
    """A value as text for people; numbers are rounded here and nowhere else."""
    if value is None:
        return "-"
    if isinstance(value, datetime):
        return value.isoformat(sep=" ", timespec="seconds")
    if isinstance(value, Mapping):
        return "; ".join(f"{as_text(name)}: {as_text(one)}" for name, one in value.items())
    if isinstance(value, list | tuple | set | frozenset):
        nested = any(isinstance(one, list | tuple) for one in value)
        return ("; " if nested else ", ").join(map(as_text, value))
    return _rounded(float(value)) if isinstance(value, float) else printable(str(value))


def _rounded(value: float) -> str:
    """A number with three decimals, or with three digits where it is small; without final zeros."""
    if not math.isfinite(value):
        return "-"
    decimals = _DECIMALS
    if 0.0 < abs(value) < 0.1:
        decimals = min(12, _DECIMALS - 1 - math.floor(math.log10(abs(value))))
    whole, _, fraction = f"{value:.{decimals}f}".partition(".")
    return f"{whole}.{fraction.rstrip('0') or '0'}"


def _percent(share: object) -> str:
    return f"{100.0 * share:.1f}" if isinstance(share, float) and math.isfinite(share) else "-"


def _is_empty(value: object) -> bool:
    """Whether a value is a text or a list without anything in it."""
    return isinstance(value, str | Mapping | list | tuple | set | frozenset) and not value


def _field_name(name: str) -> str:
    """The name of a field in a header: words joined by underscores, as in JSON."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _field(value: object) -> str:
    """A value on one line without tabs."""
    return as_text(value)


def as_size(size_bytes: int) -> str:
    """A number of bytes for people, in binary units."""
    size, unit = float(size_bytes), "B"
    for larger in ("KiB", "MiB", "GiB", "TiB"):
        if size < 1024.0:
            break
        size, unit = size / 1024.0, larger
    return f"{size_bytes} B" if unit == "B" else f"{size:.1f} {unit}"


def _as_json(value: object) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    conversions: dict[type, Callable[[Any], Any]] = {
        datetime: lambda moment: moment.isoformat(),
        UUID: str,
        Path: str,
        frozenset: sorted,
        set: sorted,
    }
    for kind, convert in conversions.items():
        if isinstance(value, kind):
            return convert(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")
