"""`amers points query`: the served points of a box."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, BinaryIO

import typer

from app.cli.box_option import BoxText, box_of
from app.cli.output import AsJson, print_json
from app.cli.transaction import transaction
from app.errors import InputError
from app.usecases.features import points


class PointFormat(StrEnum):
    """Formats of written points."""

    GEOJSON = "geojson"
    CSV = "csv"


def query(
    *,
    bbox: BoxText,
    form: Annotated[
        PointFormat, typer.Option("--format", help="Format of the points.")
    ] = PointFormat.GEOJSON,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write; by default standard output.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write all points of a box; --json without --output prints only their number."""
    box_of(bbox)
    with transaction() as connection:
        if as_json and output is None:
            count = points.count_points(connection, bbox)
            print_json({"points": count.number, "exact": count.exact, "file": None})
            return
        with _output_file(output) as file:
            pieces = (
                points.geojson(connection, bbox)
                if form is PointFormat.GEOJSON
                else points.csv(connection, bbox)
            )
            size = sum(file.write(piece) for piece in pieces)
    if as_json:
        print_json({"file": output, "size_bytes": size})


@contextmanager
def _output_file(path: Path | None) -> Iterator[BinaryIO]:
    """A file that appears under its name once it is complete, or standard output."""
    if path is None:
        yield sys.stdout.buffer
        sys.stdout.buffer.flush()
        return
    partial = path.with_name(f".{path.name}.partial")
    try:
        file = partial.open("wb")
    except OSError as error:
        raise InputError(
            f"--output: {path} cannot be written ({error.strerror}); expected a file in a folder that "
            "exists"
        ) from None
    try:
        with file:
            yield file
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
