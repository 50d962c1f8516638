"""`amers audit`: the record of every change."""

from collections.abc import Mapping
from typing import Annotated, Any

import typer

from amers.app.cli.output import AsJson, as_text, show
from amers.app.cli.transaction import transaction
from amers.app.db.audit import Change
from amers.app.usecases import operations

LONGEST_VALUE = 60
"""Characters of a value in the table; --json has all."""


def audit(
    *,
    limit: Annotated[int, typer.Option(help="Largest number of changes to show, 1 to 1000.")] = 50,
    kind: Annotated[
        str | None,
        typer.Option(
            help="Only changes of this kind of object: token, block, scene, job, point, "
            "reference_image or audit."
        ),
    ] = None,
    subject: Annotated[
        str | None, typer.Option(help="Only changes of the object with this id; ID@VERSION for a block.")
    ] = None,
    actor: Annotated[
        str | None, typer.Option(help="Only changes by this token or this user of the command line.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the last changes of tokens, blocks, scenes, jobs and points, the newest first."""
    with transaction() as connection:
        changes = operations.list_changes(connection, limit, kind=kind, subject=subject, actor=actor)
    if as_json:
        show([vars(change) for change in changes], as_json=True)
        return
    show(
        [
            {
                "at": change.at,
                "who": change.actor_name,
                "kind": change.kind,
                "subject": change.subject,
                "action": change.action,
                "change": _change_in_words(change),
            }
            for change in changes
        ],
        as_json=False,
    )


def _change_in_words(change: Change) -> str:
    """The values that a change set or replaced: `state: staged -> published`."""
    before, after = change.before, change.after
    if before is None or after is None:
        return "; ".join(
            f"{name}: {_short(value)}" for name, value in _set_values(after or before or {})
        )
    names = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    return "; ".join(f"{n}: {_short(before.get(n))} -> {_short(after.get(n))}" for n in names)


def _set_values(row: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return [(name, value) for name, value in row.items() if value is not None]


def _short(value: object) -> str:
    text = as_text(value)
    return text if len(text) <= LONGEST_VALUE else f"{text[:LONGEST_VALUE]}…"
