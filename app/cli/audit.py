"""`amers audit`: the record of every change."""

from typing import Annotated

import typer

from app.cli.output import AsJson, show
from app.cli.transaction import transaction
from app.usecases import operations


def audit(
    *,
    limit: Annotated[int, typer.Option(help="Largest number of changes to show, 1 to 1000.")] = 50,
    kind: Annotated[
        str | None,
        typer.Option(help="Only this kind: token, block, scene, job, point, reference_image or audit."),
    ] = None,
    subject: Annotated[
        str | None, typer.Option(help="Only the thing with this id; ID@VERSION for a block.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the last changes of tokens, blocks, scenes, jobs and points, the newest first."""
    with transaction() as connection:
        changes = operations.list_changes(connection, limit, kind=kind, subject=subject)
    if as_json:
        show([vars(change) for change in changes], as_json=True)
        return
    show(
        [
            {
                "at": change.at,
                "who": change.actor_name,
                "what": f"{change.kind} {change.subject} {change.action}",
                "before": change.before,
                "after": change.after,
            }
            for change in changes
        ],
        as_json=False,
    )
