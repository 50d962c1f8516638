"""`amers audit`: the record of every change."""

from typing import Annotated

import typer

from app.cli.output import AsJson, show
from app.cli.store import transaction
from app.usecases import operations


def audit(
    limit: Annotated[int, typer.Option(help="Most changes shown.")] = 50,
    kind: Annotated[str | None, typer.Option(help="token, block, scene or job.")] = None,
    subject: Annotated[
        str | None, typer.Option(help="Id of one of them; ID@VERSION of a block.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the last changes of tokens, blocks, scenes and jobs, the newest first."""
    with transaction() as connection:
        found = operations.list_changes(connection, limit, kind=kind, subject=subject)
    if as_json:
        show([vars(change) for change in found], as_json=True)
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
            for change in found
        ],
        as_json=False,
    )
