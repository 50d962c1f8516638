"""`amers points intersect`: ground coordinates of points that are marked in two images or more."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from amers.app.cli.options import GeoidFile, Shown
from amers.app.cli.output import AsJson, print_json, show, show_one, show_statements
from amers.app.cli.point_statements import stated_by_caller
from amers.app.json_values import usable
from amers.app.printable import printable
from amers.app.usecases.marks_in_images import MarkedImages
from amers.app.usecases.model_choice import ModelChoice
from amers.app.usecases.point_intersection import (
    IntersectedPoint,
    PointIntersection,
    intersect_files,
)

Files = Annotated[
    MarkedImages,
    Shown(
        marks=typer.Argument(exists=True),
        images=None,
        registered=None,
        block=None,
        rigorous=None,
        sigma_m=typer.Option(),
        mark_sigma_px=typer.Option(min=0.001),
    ),
]


@dataclass(frozen=True)
class GroundStatements:
    """What the files of the marks do not state about known ground.

    Attributes:
        vertical: vertical datum of known ground: ellipsoid, EGM96, EGM2008, EPSG:…
        geoid: grid file of the geoid of known ground, GTX or GeoTIFF.
        crs: reference system of x and y of a CSV, such as EPSG:32633.
        columns: names of the columns of a CSV, if they differ from the usual ones:
            lon=COLUMN,lat=COLUMN,…
        sigma_axes: axes of the sigmas of an ASP file: ecef or lat-lon-height.
    """

    vertical: str | None = None
    geoid: GeoidFile = None
    crs: str | None = None
    columns: str | None = None
    sigma_axes: str | None = None


def intersect(
    *,
    files: Files,
    models: ModelChoice,
    stated: GroundStatements,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="Output file for the points: CSV, GeoJSON or GeoPackage."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compute ground coordinates, with their accuracy, of points that are marked in several images.

    A mark that disagrees with two other marks of the same point is not used, and the command names it.
    Points of known ground are compared with their ground.
    """
    of_file = stated_by_caller(
        stated.geoid or stated.vertical, stated.crs, stated.columns, stated.sigma_axes
    )
    result = intersect_files(replace(files, models=models, stated=of_file), output)
    if as_json:
        print_json(usable(asdict(result)))
        return
    show_statements(result.statements)
    for note in result.notes:
        typer.echo(f"amers: {printable(note)}", err=True)
    show([_row(point) for point in result.points], as_json=False)
    typer.echo()
    show_one(_summary(result, output), as_json=False)


def _row(point: IntersectedPoint) -> dict[str, Any]:
    """A point in the table for people."""
    error = {} if point.error_m is None else {"error": _metres(point.error_m)}
    return {
        "point": point.id,
        "lon": f"{point.lon:.7f}",
        "lat": f"{point.lat:.7f}",
        "height m": f"{point.height_m:.2f}",
        "sigma E, N, U m": _metres(point.sigma_m),
        "on the Earth E, N, U m": _metres(point.on_the_earth_sigma_m),
        "images": point.images,
        "B/H": f"{point.base_to_height:.2f}",
        "residual px": f"{point.largest_residual_px:.2f} {point.largest_residual_image}",
        "error E, N, U m": error.get("error"),
    }


def _summary(result: PointIntersection, output: Path | None) -> dict[str, Any]:
    """The figures of all points for people."""
    known = result.known_ground
    record: dict[str, Any] = {
        "points": len(result.points),
        result.relative.label: result.relative.words,
        result.on_the_earth.label: result.on_the_earth.words,
        "residuals over what is stated": _number(result.scale),
        "residual parallaxes": f"{_metres(result.residual_parallax_m)} m along lines, samples",
    }
    for image in result.images:
        shift = ", ".join(f"{value:+.2f}" for value in image.shift_px)
        record[f"image {image.image}"] = f"{image.marks} marks, {shift} px from its model"
    if known is not None:
        record |= {
            "compared with known ground": f"{known.points} points",
            "rms E, N, U m": _metres(known.rms_m),
            "mean E, N, U m": _metres(known.mean_m),
            "errors over their sigma, rms": _number(known.normalised**0.5),
        }
    return record | ({} if output is None else {"file": output})


def _metres(values: list[float]) -> str:
    return ", ".join(map(_number, values))


def _number(value: float) -> str:
    return "-" if value != value else f"{value:.2f}"
