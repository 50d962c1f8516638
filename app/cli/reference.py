"""`amers reference`: images that scenes are registered on where there are no points."""

from typing import Annotated

import typer

from app.cli.output import AsJson, Row, show, show_one
from app.cli.store import transaction
from app.config import read_settings
from app.db.references import ReferenceRow
from app.usecases import references
from app.usecases.references import NewReference

app = typer.Typer(help="Reference images, for scenes where there are no points.", no_args_is_help=True)


@app.callback()
def group() -> None:
    """Reference images, for scenes where there are no points."""


@app.command()
def add(
    image: Annotated[str, typer.Argument(help="Ortho-image, path below AMERS_REFERENCE_FOLDER.")],
    name: Annotated[str, typer.Option(help="By which people know it.")],
    dem: Annotated[str | None, typer.Option(help="Heights of the same place, there too.")] = None,
    vertical: Annotated[
        str | None, typer.Option(help="What the heights are counted from: ellipsoid, EGM96, EPSG:…")
    ] = None,
    geoid: Annotated[str | None, typer.Option(help="Grid file of the geoid, there too.")] = None,
    sigma_m: Annotated[
        float | None, typer.Option(help="How well it lies on the Earth, metres.", min=0.001)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Let scenes be registered on a reference image."""
    settings = read_settings()
    new = NewReference(name, image, dem, vertical, geoid, sigma_m)
    with transaction(settings) as connection:
        row = references.add_reference(connection, settings, new)
    show_one(_record(row), as_json=as_json)


@app.command("list")
def list_references(as_json: AsJson = False) -> None:
    """List the reference images, by name."""
    with transaction() as connection:
        found = references.list_references(connection)
    show([_record(row) for row in found], as_json=as_json)


@app.command()
def remove(name: Annotated[str, typer.Argument(help="Of the reference.")]) -> None:
    """Use a reference image no longer; its files stay where they are."""
    with transaction() as connection:
        references.remove_reference(connection, name)
    typer.echo(f"removed {name}")


def _record(row: ReferenceRow) -> Row:
    return {name: value for name, value in vars(row).items() if name != "footprint"}
