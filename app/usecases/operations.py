"""What those who keep an installation running ask of it: its figures, and the record of changes."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from app.db import audit, metrics
from app.db.audit import Change
from app.db.engine import Connection
from app.db.metrics import Gauges
from app.errors import InputError

MOST_CHANGES = 1000


@dataclass(frozen=True)
class Installation:
    """The figures of the store, and of the disk its files are on."""

    store: Gauges
    disk_free_bytes: int
    disk_total_bytes: int


def installation_figures(connection: Connection, data_folder: Path) -> Installation:
    """The figures of an installation at this moment."""
    # The folder is made by the first who writes into it.
    there = next(folder for folder in (data_folder, *data_folder.parents) if folder.exists())
    disk = shutil.disk_usage(there)
    return Installation(metrics.read_gauges(connection), disk.free, disk.total)


def list_changes(
    connection: Connection,
    limit: int,
    before: int | None = None,
    kind: str | None = None,
    subject: str | None = None,
) -> list[Change]:
    """Changes, the newest first.

    Args:
        limit: most changes, 1 to 1,000.
        before: changes with smaller ids only, to go on after a page.
        kind: `token`, `block`, `scene` or `job`; None for all.
        subject: id of one of them, ID@VERSION of a block.

    Raises:
        InputError: the limit, or a kind of which no changes are recorded.
    """
    if not 1 <= limit <= MOST_CHANGES:
        raise InputError(f"limit: {limit} found, 1 to {MOST_CHANGES} expected")
    if kind is not None and kind not in audit.KINDS:
        raise InputError(f"kind: {kind!r:.40} found, one of {', '.join(audit.KINDS)} expected")
    return audit.list_changes(connection, limit, before, kind, subject)
