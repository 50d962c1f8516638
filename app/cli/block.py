"""`amers block`: productions of points, from a folder to a publication."""

from pathlib import Path
from typing import Annotated

import typer

from app.cli.output import AsJson, Row, print_json, show, show_one
from app.cli.progress import shown_progress
from app.cli.store import transaction
from app.config import read_settings
from app.db.blocks import Block
from app.storage import open_storage
from app.usecases import blocks
from services.quality.block import BlockQuality, Distribution, quality_document

app = typer.Typer(help="Productions of points.", no_args_is_help=True)

Reference = Annotated[str, typer.Argument(help="Number of the block, its ID, or ID@VERSION.")]


@app.command()
def ingest(
    path: Annotated[Path, typer.Argument(help="Folder of the block.")],
    publish: Annotated[bool, typer.Option("--publish", help="Make it visible at once.")] = False,
    as_json: AsJson = False,
) -> None:
    """Check a block entirely and load it, staged."""
    settings = read_settings()
    storage = open_storage(settings)
    with transaction(settings) as connection:
        with shown_progress() as progress:
            ingested = blocks.ingest_block(connection, storage, path, progress)
        block = ingested.block
        if publish:
            block = blocks.publish_block(connection, str(block.number)).block
    if as_json:
        print_json({"block": _record(block), "quality": quality_document(ingested.quality)})
        return
    show_one({**_record(block), **_figures(ingested.quality)}, as_json=False)


@app.command("list")
def list_blocks(as_json: AsJson = False) -> None:
    """List all blocks, the newest first."""
    with transaction() as connection:
        found = blocks.list_blocks(connection)
    show([_record(block) for block in found], as_json=as_json)


@app.command("show")
def show_block(reference: Reference, as_json: AsJson = False) -> None:
    """Show one block."""
    with transaction() as connection:
        block = blocks.find_block(connection, reference)
    show_one(_record(block), as_json=as_json)


@app.command()
def quality(reference: Reference, as_json: AsJson = False) -> None:
    """Show the quality figures of a block; with --json also the density of every cell."""
    with transaction() as connection:
        figures = blocks.find_quality(connection, reference)
    if as_json:
        print_json(quality_document(figures))
    else:
        show_one(_figures(figures), as_json=False)


@app.command()
def publish(reference: Reference, as_json: AsJson = False) -> None:
    """Make a block visible, and the version of it that was visible before no longer."""
    with transaction() as connection:
        published = blocks.publish_block(connection, reference)
    old = published.superseded
    record = {
        **_record(published.block),
        "superseded": None if old is None else f"{old.id}@{old.version}",
    }
    show_one(record, as_json=as_json)


@app.command()
def withdraw(reference: Reference, as_json: AsJson = False) -> None:
    """Make a block invisible; it can be published again."""
    with transaction() as connection:
        block = blocks.withdraw_block(connection, reference)
    show_one(_record(block), as_json=as_json)


def _record(block: Block) -> Row:
    return {
        "number": block.number,
        "id": block.id,
        "version": block.version,
        "state": block.state,
        "points": block.n_points,
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
