"""`amers block export`: served points as a new block folder."""

from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.box_option import BoxText, box_of
from amers.app.cli.output import AsJson, show_one
from amers.app.cli.progress import shown_progress
from amers.app.config import read_settings
from amers.app.db.engine import opened
from amers.app.errors import InputError
from amers.app.usecases import storage_identity
from amers.app.usecases.blocks.export import ExportBlock, select_points, write_selected
from amers.app.usecases.damage import open_chips


def export(
    *,
    bbox: BoxText,
    output: Annotated[Path, typer.Option("-o", "--output", help="New folder of the block.")],
    name: Annotated[str, typer.Option("--id", help="Id of the new block.")] = "extract",
    version: Annotated[str, typer.Option(help="Version of the new block.")] = "1",
    title: Annotated[str, typer.Option(help="Title of the new block.")] = "",
    as_json: AsJson = False,
) -> None:
    """Write the served points of a box, with their chips, into a new block folder."""
    box = box_of(bbox)
    if box.bounds_height:
        raise InputError(
            f"--bbox: {bbox!r:.100} found, four numbers expected: a block has no limits of height"
        )
    settings = read_settings()
    inputs = ExportBlock((box.west, box.south, box.east, box.north), name, version, title)
    with opened(settings) as database:
        with database.snapshot() as connection:
            selected = select_points(connection, inputs)
        chips = open_chips(database, storage_identity.opened(database, settings))
        try:
            with shown_progress() as progress:
                n_points = write_selected(selected, chips, output, progress)
        finally:
            chips.close()
    show_one({"block": output, "points": n_points}, as_json=as_json)
