"""`amers points`: control points of published blocks."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, BinaryIO

import typer

from app.cli.output import AsJson, print_json, show, show_one
from app.cli.transaction import transaction
from app.usecases import history
from app.usecases.features import points
from app.usecases.features.query import parse_bbox

app = typer.Typer(no_args_is_help=True)


class PointFormat(StrEnum):
    """Formats of written points."""

    GEOJSON = "geojson"
    CSV = "csv"


@app.command()
def query(
    *,
    bbox: Annotated[
        str, typer.Option(help="W,S,E,N in degrees; W greater than E crosses the antimeridian.")
    ],
    form: Annotated[
        PointFormat, typer.Option("--format", help="Format of the points.")
    ] = PointFormat.GEOJSON,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File to write; by default standard output.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write all points of a box; --json without --output prints only their number."""
    parse_bbox(bbox)
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


@app.command()
def suspensions(
    *,
    suspended: Annotated[
        bool, typer.Option("--suspended", help="List suspended points instead of proposed ones.")
    ] = False,
    limit: Annotated[int, typer.Option(help="Largest number of points to show.")] = 100,
    as_json: AsJson = False,
) -> None:
    """List the points proposed for suspension because they fail in many scenes, the worst first."""
    with transaction() as connection:
        histories = history.list_histories(connection, "suspended" if suspended else "proposed", limit)
    show([vars(point) for point in histories], as_json=as_json)


@app.command()
def suspend(
    point: Annotated[int, typer.Argument(help="Id of the point.")],
    *,
    because: Annotated[str, typer.Option(help="Reason; it is recorded.")],
    as_json: AsJson = False,
) -> None:
    """Suspend a point: neither registrations nor readers get it any more."""
    with transaction() as connection:
        suspended = history.suspend_point(connection, point, because)
    show_one(vars(suspended), as_json=as_json)


@app.command()
def reinstate(
    point: Annotated[int, typer.Argument(help="Id of the point.")],
    as_json: AsJson = False,
) -> None:
    """Serve a suspended point again; its history starts again from nothing."""
    with transaction() as connection:
        reinstated = history.reinstate_point(connection, point)
    show_one(vars(reinstated), as_json=as_json)


@contextmanager
def _output_file(path: Path | None) -> Iterator[BinaryIO]:
    """A file that appears under its name once it is complete, or standard output."""
    if path is None:
        yield sys.stdout.buffer
        sys.stdout.buffer.flush()
        return
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            yield file
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
