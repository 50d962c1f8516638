"""`amers reference`: reference images, for scenes on ground without control points."""

from typing import Annotated

import typer

from amers.app.cli.deletion import giving_up_reserve
from amers.app.cli.output import AsJson, Row, show, show_one
from amers.app.cli.transaction import transaction
from amers.app.config import read_settings
from amers.app.db.references import ReferenceRow
from amers.app.usecases import references
from amers.app.usecases.references import NewReference


def add(
    image: Annotated[str, typer.Argument(help="Path of the ortho-image below AMERS_REFERENCE_FOLDER.")],
    *,
    name: Annotated[str, typer.Option(help="Unique name of the reference.")],
    dem: Annotated[
        str | None,
        typer.Option(help="Path of the heights of the same ground, below AMERS_REFERENCE_FOLDER."),
    ] = None,
    vertical: Annotated[
        str | None, typer.Option(help="Vertical datum of the heights: ellipsoid, EGM96, EPSG:…")
    ] = None,
    geoid: Annotated[
        str | None,
        typer.Option(help="Path of the grid file of the geoid, below AMERS_REFERENCE_FOLDER."),
    ] = None,
    sigma_m: Annotated[
        float | None,
        typer.Option(help="Accuracy of the image on the Earth, one sigma, metres.", min=0.001),
    ] = None,
    sigma_up_m: Annotated[
        float | None,
        typer.Option(
            help="Accuracy of the heights of the reference on the Earth, one sigma, metres.", min=0.001
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Add a reference image that scenes can be registered on."""
    settings = read_settings()
    new = NewReference(name, image, dem, vertical, geoid, sigma_m, sigma_up_m)
    with transaction(settings) as connection:
        row = references.add_reference(connection, settings, new)
    show_one(_record(row), as_json=as_json)


def list_references(as_json: AsJson = False) -> None:
    """List the reference images, by name."""
    with transaction() as connection:
        rows = references.list_references(connection)
    show([_record(row) for row in rows], as_json=as_json)


@giving_up_reserve
def remove(name: Annotated[str, typer.Argument(help="Name of the reference.")]) -> None:
    """Remove a reference image from the installation; its files stay in their folder."""
    with transaction() as connection:
        references.remove_reference(connection, name)
    typer.echo(f"removed {name}")


def _record(row: ReferenceRow) -> Row:
    return {name: value for name, value in vars(row).items() if name != "footprint"}
