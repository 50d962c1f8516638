"""`amers points experiment`: errors of a user's own points, by control points, images and base."""

from dataclasses import asdict, replace
from typing import Annotated, Any

import typer

from amers.app.cli.options import Shown
from amers.app.cli.output import AsJson, print_json, show, show_statements
from amers.app.cli.point_intersection import GroundStatements
from amers.app.cli.point_statements import sigma_pair, stated_by_caller
from amers.app.cli.progress import shown_progress
from amers.app.errors import InputError
from amers.app.json_values import usable
from amers.app.printable import printable
from amers.app.usecases.control_experiment import (
    COUNTS,
    ExperimentOptions,
    ExperimentRow,
    run_experiment,
)
from amers.app.usecases.marks_in_images import MarkedImages
from amers.app.usecases.model_choice import ModelChoice

Files = Annotated[
    MarkedImages,
    Shown(
        marks=typer.Argument(exists=True),
        images=None,
        rigorous=None,
        sigma_m=typer.Option(),
        mark_sigma_px=typer.Option(min=0.001),
    ),
]


def experiment(
    *,
    files: Files,
    models: ModelChoice,
    stated: GroundStatements,
    point_sigma_m: Annotated[
        str | None,
        typer.Option(
            help="Accuracy of known ground if its file states none: HORIZONTAL,UP, one sigma, metres."
        ),
    ] = None,
    control_points: Annotated[
        str | None,
        typer.Option(help="Numbers of control points, such as 3,6,10; by default 0 to 20."),
    ] = None,
    options: Annotated[ExperimentOptions, Shown(draws=typer.Option(min=1, max=1000), seed=None)],
    as_json: AsJson = False,
) -> None:
    """Measure errors of marked points by the number of control points, the images and their base.

    Some points of known ground are control, the others check the result. The errors are measured for
    every image alone, for every pair of images, and for all images together.
    """
    of_file = stated_by_caller(
        stated.geoid or stated.vertical, stated.crs, stated.columns, stated.sigma_axes
    )
    with shown_progress() as progress:
        result = run_experiment(
            replace(files, models=models, stated=of_file),
            sigma_pair(point_sigma_m, "--point-sigma-m"),
            COUNTS if control_points is None else _counts(control_points),
            options,
            progress,
        )
    if as_json:
        print_json(usable(asdict(result)))
        return
    show_statements(result.statements)
    for note in result.notes:
        typer.echo(f"amers: {printable(note)}", err=True)
    for row in result.rows:
        if row.reason:
            names = ", ".join(row.images)
            note = f"{names} on {row.control_points} control points: {row.reason}"
            typer.echo(f"amers: {printable(note)}", err=True)
    show([_shown(row) for row in result.rows if not row.reason], as_json=False)


def _counts(text: str) -> tuple[int, ...]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdigit() and len(part) < 6 for part in parts):
        raise InputError(f"--control-points: {text[:60]!r} found, numbers expected, such as 3,6,10")
    return tuple(sorted({int(part) for part in parts}))


def _shown(row: ExperimentRow) -> dict[str, Any]:
    east, north, up = map(_number, row.rms_m)
    return {
        "images": ", ".join(row.images),
        "B/H": _number(row.base_to_height),
        "control": row.control_points,
        "errors": row.errors,
        "east m": east,
        "north m": north,
        "up m": up,
        "parallaxes m": ", ".join(map(_number, row.residual_parallax_m)),
        "worst": f"{row.worst} {_number(row.worst_m)} m",
    }


def _number(value: float) -> str:
    return "-" if value != value else f"{value:.2f}"
