"""`amers points query`: the served points of a box, of the store or of a service."""

import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated, BinaryIO

import typer

from amers.app.cli.box_option import BoxText, box_of
from amers.app.cli.output import AsJson, print_json
from amers.app.cli.transaction import transaction
from amers.app.client import Client, Feature
from amers.app.db.features.bbox import Box
from amers.app.db.features.counts import Count
from amers.app.errors import InputError
from amers.app.usecases.features import points


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
    server: Annotated[
        str | None,
        typer.Option(help="Address of an Amers service; its points are queried instead of the store."),
    ] = None,
    token: Annotated[
        str | None,
        typer.Option(
            envvar="AMERS_TOKEN",
            help="Token for the service; the environment variable is safer, because other users "
            "can see a command line.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write all points of a box; --json without --output prints only their number."""
    box = box_of(bbox)
    source = _of_store(bbox) if server is None else _of_service(server, token or "", box)
    with source as answer:
        if as_json and output is None:
            count = answer.count()
            print_json({"points": count.number, "exact": count.exact, "file": None})
            return
        with _output_file(output) as file:
            size = sum(file.write(piece) for piece in answer.pieces[form]())
    if as_json:
        print_json({"file": output, "size_bytes": size})


@dataclass(frozen=True)
class _Answer:
    """The points of a box; each function asks for them."""

    count: Callable[[], Count]
    pieces: Mapping[PointFormat, Callable[[], Iterator[bytes]]]


@contextmanager
def _of_store(bbox: str) -> Iterator[_Answer]:
    with transaction() as connection:
        geojson, csv = (partial(form, connection, bbox) for form in (points.geojson, points.csv))
        pieces = {PointFormat.GEOJSON: geojson, PointFormat.CSV: csv}
        yield _Answer(partial(points.count_points, connection, bbox), pieces)


@contextmanager
def _of_service(server: str, token: str, box: Box) -> Iterator[_Answer]:
    if box.bounds_height:
        raise InputError(
            "--bbox: six numbers found, but a service selects points without heights; give four: W,S,E,N"
        )
    corners = (box.west, box.south, box.east, box.north)
    with Client(server, token) as client:
        pieces: dict[PointFormat, Callable[[], Iterator[bytes]]] = {
            PointFormat.GEOJSON: lambda: _collection(client.points(corners)),
            PointFormat.CSV: partial(client.csv, "points", corners),
        }
        yield _Answer(lambda: Count(*client.count("points", corners)), pieces)


def _collection(features: Iterator[Feature]) -> Iterator[bytes]:
    """A FeatureCollection in pieces, one line for each feature."""
    yield b'{"type":"FeatureCollection","features":[\n'
    for number, feature in enumerate(features):
        line = json.dumps(feature, ensure_ascii=False, separators=(",", ":"))
        yield (",\n" if number else "").encode() + line.encode()
    yield b"\n]}\n"


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
