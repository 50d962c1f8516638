"""`amers block delete`: a block that is no longer needed."""

from typing import Annotated

import typer

from amers.app.cli.block_listing import block_row
from amers.app.cli.deletion import giving_up_reserve
from amers.app.cli.output import AsJson, show_one
from amers.app.config import read_settings
from amers.app.db import engine
from amers.app.storage import open_storage
from amers.app.usecases.blocks.deletion import delete_block
from amers.app.usecases.installation import Installation


@giving_up_reserve
def delete(
    reference: Annotated[str, typer.Argument(help="The block with its version, ID@VERSION.")],
    as_json: AsJson = False,
) -> None:
    """Delete a block that is not published, permanently; its chip files go into the trash."""
    settings = read_settings()
    with engine.opened(settings) as database:
        deleted = delete_block(Installation(database, open_storage(settings), settings), reference)
    counts = {"files": deleted.n_files, "shared_files": deleted.n_shared_files}
    show_one({**block_row(deleted.block), **counts}, as_json=as_json)
