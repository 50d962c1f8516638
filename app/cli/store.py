"""`amers store`: the storage of the files."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.deletion import giving_up_reserve
from amers.app.cli.exit_status import FAILURE
from amers.app.cli.output import AsJson, Row, as_size, print_json, show, show_one
from amers.app.cli.progress import shown_progress
from amers.app.cli.transaction import transaction
from amers.app.config import read_settings
from amers.app.db import engine
from amers.app.storage import open_storage
from amers.app.usecases import garbage_collection, storage_identity, usage
from amers.app.usecases.installation import Installation
from amers.app.usecases.store_verification import Finding, verify_store


def adopt(as_json: AsJson = False) -> None:
    """Bind the storage to the database, after you have checked that they belong together."""
    settings = read_settings()
    storage = open_storage(settings)
    with transaction(settings):
        row = storage_identity.adopt(partial(transaction, settings), storage)
    record = {"storage": storage.place, "installation": row.id, "generation": row.storage_generation}
    show_one(record, as_json=as_json)


def show_usage(as_json: AsJson = False) -> None:
    """Show the storage that every owner uses, and files without an owner."""
    settings = read_settings()
    storage = open_storage(settings)
    with transaction(settings) as connection:
        if storage_identity.expect(connection, storage).storage_generation > 0:
            storage.prove()
        owners = usage.read_all_usage(connection, settings)
        unowned = usage.read_unowned(connection, storage)
    total_bytes = sum(row.total_bytes for row in owners) + sum(row.total_bytes for row in unowned)
    if as_json:
        print_json({"owners": owners, "unowned": unowned, "total_bytes": total_bytes})
        return
    rows: list[Row] = [
        {
            "owner": row.name,
            "scenes": row.scenes,
            "open uploads": row.open_uploads,
            "jobs": row.jobs,
            "results": as_size(row.result_bytes),
            "total": as_size(row.total_bytes),
            "quota": None if row.quota_bytes is None else as_size(row.quota_bytes),
            "share": None if row.share is None else f"{row.share:.1%}",
        }
        for row in owners
    ]
    blank = dict.fromkeys(("scenes", "open uploads", "jobs", "results"))
    ends = {"quota": None, "share": None}
    for what, size in [(row.what, row.total_bytes) for row in unowned] + [("total", total_bytes)]:
        rows.append({"owner": what, **blank, "total": as_size(size), **ends})
    show(rows, as_json=False)


@giving_up_reserve
def sweep(as_json: AsJson = False) -> None:
    """Move all files that no row of the database names into the trash, without a limit."""
    settings = read_settings()
    storage = open_storage(settings)
    with engine.opened(settings) as database:
        storage_identity.require_match(database, storage)
        keys = garbage_collection.remove_all_unnamed(database, storage)
    show([{"key": key} for key in keys], as_json=as_json)


def verify(
    *,
    repair: Annotated[
        Path | None,
        typer.Option(
            metavar="FROM",
            exists=True,
            file_okay=False,
            help="Replace rotten and missing files by their copies in this folder: a backup, or a copy "
            "of the storage.",
        ),
    ] = None,
    rate: Annotated[
        float,
        typer.Option(metavar="MB/S", min=0.001, help="Largest reading rate, megabytes per second."),
    ] = 100.0,
    as_json: AsJson = False,
) -> None:
    """Read every file and report rotten, missing and unknown files; exit code 1 if there are any."""
    settings = read_settings()
    storage = open_storage(settings)
    with engine.opened(settings) as database:
        storage_identity.require_match(database, storage)
        installation = Installation(database, storage, settings)
        with shown_progress() as progress:
            outcome = verify_store(installation, progress, rate, repair)
    if as_json:
        print_json(outcome)
    else:
        show([_finding(finding) for finding in outcome.findings], as_json=False)
        n_bad = sum(not finding.repaired for finding in outcome.findings)
        typer.echo(
            f"{outcome.n_files} files of {outcome.size_bytes / 1e6:,.1f} MB read: {n_bad} not as they "
            f"should be, {len(outcome.findings) - n_bad} repaired; {outcome.n_recorded} had no checksum "
            "before",
            err=True,
        )
    if not outcome.is_whole:
        raise typer.Exit(FAILURE)


def _finding(finding: Finding) -> Row:
    points = ", ".join(map(str, finding.first_points))
    more = " …" if finding.n_points > len(finding.first_points) else ""
    return {
        "file": finding.key,
        "kind": finding.kind or "-",
        "state": "repaired" if finding.repaired else finding.state,
        "what": finding.detail,
        "points": f"{finding.n_points}: {points}{more}" if finding.n_points else "-",
    }
