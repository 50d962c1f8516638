"""`amers token`: tokens of the callers of the API."""

from typing import Annotated

import typer

from amers.app.cli.deletion import giving_up_reserve
from amers.app.cli.output import AsJson, Row, show, show_one
from amers.app.cli.transaction import transaction
from amers.app.db.tokens import Token
from amers.app.usecases import tokens


def create(
    name: Annotated[
        str, typer.Argument(help="Name of the token; it must differ from the names of all valid tokens.")
    ],
    *,
    scope: Annotated[
        list[str], typer.Option(help="read, register, monitor or admin; repeat for several scopes.")
    ],
    days: Annotated[
        int | None, typer.Option(help="Days until the token expires; by default it does not.")
    ] = None,
    storage_quota_bytes: Annotated[
        int | None,
        typer.Option(
            help="Storage in bytes that all files of the token may occupy; by default the quota "
            "of the settings."
        ),
    ] = None,
    job_quota: Annotated[
        int | None,
        typer.Option(
            help="Number of jobs of the token that may wait or run at once; by default the "
            "quota of the settings."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Create a token and print its secret, which is shown only once."""
    with transaction() as connection:
        new = tokens.create_token(
            connection,
            name,
            scope,
            days,
            storage_quota_bytes=storage_quota_bytes,
            job_quota=job_quota,
        )
    record = {**_record(new.token), "secret": new.secret}
    if as_json:
        show_one(record, as_json=True)
        return
    typer.echo("Keep this secret: it is not shown again.", err=True)
    typer.echo(new.secret)


def list_tokens(as_json: AsJson = False) -> None:
    """List all tokens, the newest first."""
    with transaction() as connection:
        all_tokens = tokens.list_tokens(connection)
    show([_record(token) for token in all_tokens], as_json=as_json)


@giving_up_reserve
def revoke(
    name_or_id: Annotated[str, typer.Argument(help="Id of the token, or its name if it is unique.")],
    as_json: AsJson = False,
) -> None:
    """Revoke a token: requests with its secret are refused."""
    with transaction() as connection:
        revoked = tokens.revoke_token(connection, name_or_id)
    show_one(_record(revoked), as_json=as_json)


def _record(token: Token) -> Row:
    return {
        "id": token.id,
        "name": token.name,
        "scopes": token.scopes,
        "created_at": token.created_at,
        "expires_at": token.expires_at,
        "revoked_at": token.revoked_at,
        "subject": token.subject,
        "storage_quota_bytes": token.storage_quota_bytes,
        "job_quota": token.job_quota,
    }
