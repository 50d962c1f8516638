"""`amers block`: productions of points, from a folder to a publication."""

from pathlib import Path
from typing import Annotated

import typer

from app.cli.output import AsJson, Row, print_json, show, show_one
from app.cli.progress import shown_progress
from app.cli.store import transaction
from app.config import read_settings
from app.db.blocks import Block
from app.errors import InputError
from app.storage import StoredChips, open_storage
from app.usecases.blocks import lifecycle
from app.usecases.blocks.export import ExportBlock, select_points, write_selected
from app.usecases.blocks.lifecycle import Published
from services.quality.block import BlockQuality, Distribution, quality_document

app = typer.Typer(help="Productions of points.", no_args_is_help=True)

Reference = Annotated[str, typer.Argument(help="Number of the block, its ID, or ID@VERSION.")]


@app.command()
def ingest(
    path: Annotated[Path, typer.Argument(help="Folder of the block.")],
    publish: Annotated[bool, typer.Option("--publish", help="Make it visible at once.")] = False,
    priority: Annotated[int, typer.Option(help="Over the same place the greater one wins.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Check a block entirely and load it, staged."""
    settings = read_settings()
    storage = open_storage(settings)
    with transaction(settings) as connection:
        with shown_progress() as progress:
            ingested = lifecycle.ingest_block(connection, storage, path, progress, priority)
        block = ingested.block
        if publish:
            block = lifecycle.publish_block(connection, str(block.number)).block
    if as_json:
        print_json({"block": _record(block), "quality": quality_document(ingested.quality)})
        return
    show_one({**_record(block), **_figures(ingested.quality)}, as_json=False)


@app.command("list")
def list_blocks(as_json: AsJson = False) -> None:
    """List all blocks, the newest first."""
    with transaction() as connection:
        found = lifecycle.list_blocks(connection)
    show([_record(block) for block in found], as_json=as_json)


@app.command("show")
def show_block(reference: Reference, as_json: AsJson = False) -> None:
    """Show one block."""
    with transaction() as connection:
        block = lifecycle.find_block(connection, reference)
    show_one(_record(block), as_json=as_json)


@app.command()
def quality(reference: Reference, as_json: AsJson = False) -> None:
    """Show the quality figures of a block; with --json also the density of every cell."""
    with transaction() as connection:
        report = lifecycle.block_report(connection, lifecycle.find_block(connection, reference))
    if as_json:
        stated = [vars(figure) for figure in report.accuracy]
        print_json({**quality_document(report.quality), "accuracy": stated})
        return
    stated_lines = {
        f"{figure.kind} {figure.name}": f"{figure.value:g} ({figure.count} against {figure.against})"
        for figure in report.accuracy
    }
    show_one({**_figures(report.quality), **stated_lines}, as_json=False)


@app.command()
def publish(reference: Reference, as_json: AsJson = False) -> None:
    """Make a block visible, and the version of it that was visible before no longer."""
    with transaction() as connection:
        published = lifecycle.publish_block(connection, reference)
    show_one(_published(published), as_json=as_json)


@app.command()
def restore(reference: Reference, as_json: AsJson = False) -> None:
    """Make a block visible again that was withdrawn or superseded, in place of its visible version."""
    with transaction() as connection:
        published = lifecycle.restore_block(connection, reference)
    show_one(_published(published), as_json=as_json)


@app.command()
def prioritise(
    reference: Reference,
    priority: Annotated[int, typer.Argument(help="-1000 to 1000; 0 unless said otherwise.")],
    as_json: AsJson = False,
) -> None:
    """Let a block win or lose against other blocks over the same place."""
    with transaction() as connection:
        block = lifecycle.prioritise_block(connection, reference, priority)
    show_one(_record(block), as_json=as_json)


@app.command()
def export(
    bbox: Annotated[str, typer.Option(help="W,S,E,N in degrees; W greater than E crosses 180.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to make.")],
    name: Annotated[str, typer.Option("--id", help="Name of the new block.")] = "extract",
    version: Annotated[str, typer.Option(help="Version of the new block.")] = "1",
    title: Annotated[str, typer.Option(help="Title of the new block.")] = "",
    as_json: AsJson = False,
) -> None:
    """Write the points that are served in a box, with their chips, into a new block folder."""
    try:
        west, south, east, north = (float(part) for part in bbox.split(","))
    except ValueError:
        raise InputError(f"--bbox: {bbox!r:.100} found, four numbers W,S,E,N expected") from None
    settings = read_settings()
    inputs = ExportBlock((west, south, east, north), name, version, title)
    with transaction(settings) as connection:
        selected = select_points(connection, inputs)
    chips = StoredChips(open_storage(settings))
    try:
        with shown_progress() as progress:
            n_points = write_selected(selected, chips, output, progress)
    finally:
        chips.close()
    show_one({"block": output, "points": n_points}, as_json=as_json)


@app.command()
def withdraw(reference: Reference, as_json: AsJson = False) -> None:
    """Make a block invisible; it can be published again."""
    with transaction() as connection:
        block = lifecycle.withdraw_block(connection, reference)
    show_one(_record(block), as_json=as_json)


def _published(published: Published) -> Row:
    old = published.superseded
    return {
        **_record(published.block),
        "superseded": None if old is None else f"{old.id}@{old.version}",
    }


def _record(block: Block) -> Row:
    return {
        "number": block.number,
        "id": block.id,
        "version": block.version,
        "state": block.state,
        "priority": block.priority,
        "points": block.n_points,
        "points superseded": block.n_unserved,
        "views": block.n_views,
        "title": block.title,
        "created_at": block.created_at,
        "state_changed_at": block.state_changed_at,
    }


def _figures(quality: BlockQuality) -> Row:
    return {
        "area": f"{quality.area_km2:,.1f} km2",
        "density": f"{quality.points_per_km2:.3f} points/km2",
        "cells with 1 / 2 km2": f"{100.0 * quality.share_reaching_half:.1f} %",
        "cells with 1 / 4 km2": f"{100.0 * quality.share_reaching_quarter:.1f} %",
        "images a point": _five(quality.images_per_point, ".1f"),
        "chips a point": _five(quality.views_per_point, ".1f"),
        "sigma horizontal, m": _five(quality.sigma_horizontal_m, ".2f"),
        "sigma up, m": _five(quality.sigma_up_m, ".2f"),
    }


def _five(values: Distribution, form: str) -> str:
    return (
        f"median {values.median:{form}}, mean {values.mean:{form}}, 90 % below {values.p90:{form}}, "
        f"from {values.minimum:{form}} to {values.maximum:{form}}"
    )
