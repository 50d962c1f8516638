"""`amers block renew`: a version of a block with views of new scenes, staged."""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated
from uuid import UUID

import typer

from amers.app.cli.block_listing import renewal_row
from amers.app.cli.output import AsJson, print_json, show_one
from amers.app.cli.progress import shown_progress
from amers.app.cli.transaction import transaction
from amers.app.config import read_settings
from amers.app.db.engine import opened
from amers.app.errors import InputError
from amers.app.storage import open_storage
from amers.app.usecases import storage_identity
from amers.app.usecases.blocks.renewal import read_base, renew_block, stage_renewal
from amers.app.usecases.blocks.renewing_scenes import registered_job, scene_of_image, scene_of_job
from amers.services.types import part_of


def renew(
    reference: Annotated[str, typer.Argument(help="Number of the published block, ID, or ID@VERSION.")],
    *,
    job: Annotated[
        list[UUID] | None,
        typer.Option(help="Job of a service that registered scenes on the block; repeat for several."),
    ] = None,
    image: Annotated[
        list[Path] | None,
        typer.Option(
            help="Image that `amers scene register` registered on the points of this store; "
            "repeat for several."
        ),
    ] = None,
    version: Annotated[
        str, typer.Option(help="Version of the renewed block; by default the next whole number.")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Stage a new version of a block: add views of registered scenes and points, remove vanished points.

    Readers get the new version only after `amers block publish`.
    """
    if not job and not image:
        raise InputError(
            "no scene given: name registered images with --image FILE, or registration jobs with --job "
            "ID"
        )
    settings = read_settings()
    storage = open_storage(settings)
    with transaction(settings):
        storage_identity.announce(partial(transaction, settings), storage)
        storage.prove()
    with (
        opened(settings) as database,
        TemporaryDirectory(prefix="amers-renewal-") as scratch,
        shown_progress() as progress,
    ):
        folder = Path(scratch) / "block"
        progress(0.0, "reading points")
        with database.snapshot() as connection:
            base = read_base(connection, reference, version)
            rows = [row for one in job or () for row in registered_job(connection, base.block, one)]
            scenes = [scene_of_image(connection, base.block, one) for one in image or ()]
        scenes += [scene_of_job(database, storage, settings, row, Path(scratch)) for row in rows]
        document = renew_block(
            database, storage, base, scenes, folder, progress=part_of(progress, 0.0, 0.9)
        )
        with database.transaction() as connection:
            block = stage_renewal(connection, storage, base, folder, part_of(progress, 0.9, 0.1)).block
    staged = {"number": block.number, "id": block.id, "version": block.version, "state": block.state}
    if as_json:
        print_json({**staged, "points": block.n_points, "renewal": document})
        return
    show_one({**staged, "points": block.n_points, **renewal_row(document)}, as_json=False)
