"""`amers db backup`, `verify-backup` and `restore`: database and files as one set."""

from pathlib import Path
from typing import Annotated

import typer

from amers.app.cli.exit_status import FAILURE, REFUSED
from amers.app.cli.output import AsJson, show_one
from amers.app.cli.progress import shown_progress
from amers.app.config import read_settings
from amers.app.db import engine, revisions
from amers.app.db.cluster import backup as archive
from amers.app.db.cluster import embedded
from amers.app.storage import open_storage
from amers.app.usecases.backups.make import make_backup
from amers.app.usecases.backups.manifest import Manifest, find_problems, read_manifest
from amers.app.usecases.backups.restore import restore_backup
from amers.app.usecases.installation import Installation


def backup(
    folder: Annotated[Path, typer.Argument(help="Folder to write; it must not exist.")],
    as_json: AsJson = False,
) -> None:
    """Write the database and the stored files into a folder, as one set with a manifest."""
    settings = read_settings()
    with engine.opened(settings) as database, shown_progress() as progress:
        here = Installation(database, open_storage(settings), settings)
        manifest = make_backup(here, folder.absolute(), progress)
    show_one(_summary(folder, manifest), as_json=as_json)
    if manifest.damaged:
        typer.echo(
            "amers: the backup is complete, but files of the storage are damaged or missing: "
            + "; ".join(f"{item.key}: {item.reason}" for item in manifest.damaged),
            err=True,
        )
        raise typer.Exit(FAILURE)


def verify_backup(
    folder: Annotated[Path, typer.Argument(exists=True, help="A folder written by `amers db backup`.")],
    as_json: AsJson = False,
) -> None:
    """Read a backup and compare it with its manifest: missing, surplus and changed files."""
    manifest = read_manifest(folder)
    with shown_progress() as progress:
        problems = find_problems(folder, manifest, progress)
    show_one({**_summary(folder, manifest), "problems": problems}, as_json=as_json)
    if problems:
        raise typer.Exit(REFUSED)


def restore(
    folder: Annotated[
        Path,
        typer.Argument(
            exists=True, help="A folder written by `amers db backup`, or only its database.dump."
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Verify a backup, and restore it into an empty database and an empty storage."""
    settings = read_settings()
    with embedded.database(settings) as dsn:
        if folder.is_file():
            archive.restore(dsn, folder)
            revisions.upgrade(dsn)
            record: dict[str, object] = {"archive": folder, "revision": revisions.status(dsn).found}
        else:
            with shown_progress() as progress:
                record = _summary(folder, restore_backup(dsn, open_storage(settings), folder, progress))
    show_one(record, as_json=as_json)


def _summary(folder: Path, manifest: Manifest) -> dict[str, object]:
    return {
        "backup": folder,
        "created_at": manifest.created_at,
        "installation": manifest.installation,
        "revision": manifest.revision,
        "files": len(manifest.files),
        "size_bytes": manifest.size_bytes,
        "damaged": [item.key for item in manifest.damaged],
        "outdated": [item.key for item in manifest.outdated],
    }
