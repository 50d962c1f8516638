"""`amers points`: suspended points, and those proposed for suspension."""

from typing import Annotated

import typer

from amers.app.cli.output import AsJson, show, show_one
from amers.app.cli.transaction import transaction
from amers.app.usecases import history


def suspensions(
    *,
    suspended: Annotated[
        bool, typer.Option("--suspended", help="List suspended points instead of proposed ones.")
    ] = False,
    limit: Annotated[int, typer.Option(help="Largest number of points to show.")] = 100,
    as_json: AsJson = False,
) -> None:
    """List points proposed for suspension because many scenes do not find them, worst first."""
    with transaction() as connection:
        histories = history.list_histories(connection, "suspended" if suspended else "proposed", limit)
    show([vars(point) for point in histories], as_json=as_json)


def suspend(
    point: Annotated[int, typer.Argument(help="Id of the point.")],
    *,
    because: Annotated[str, typer.Option(help="Reason, which is recorded in the audit trail.")],
    as_json: AsJson = False,
) -> None:
    """Suspend a point: registrations do not use it, and readers do not get it."""
    with transaction() as connection:
        suspended = history.suspend_point(connection, point, because)
    show_one(vars(suspended), as_json=as_json)


def reinstate(
    point: Annotated[int, typer.Argument(help="Id of the point.")],
    as_json: AsJson = False,
) -> None:
    """Serve a suspended point again, with a new, empty history."""
    with transaction() as connection:
        reinstated = history.reinstate_point(connection, point)
    show_one(vars(reinstated), as_json=as_json)
