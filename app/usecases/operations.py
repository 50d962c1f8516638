"""Operations of an installation: its figures and its audit trail."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from amers.app.db import audit, metrics
from amers.app.db.audit import Change
from amers.app.db.engine import Connection
from amers.app.db.jobs import progress
from amers.app.db.metrics import Gauges
from amers.app.errors import InputError

MOST_CHANGES = 1000


@dataclass(frozen=True)
class InstallationFigures:
    """The figures of the store, and of the disk with the data folder.

    Attributes:
        workers: that are alive.
    """

    store: Gauges
    workers: int
    disk_free_bytes: int
    disk_total_bytes: int


def installation_figures(connection: Connection, data_folder: Path) -> InstallationFigures:
    """The present figures of an installation."""
    disk = shutil.disk_usage(existing_folder(data_folder))
    workers = progress.count_workers(connection)
    return InstallationFigures(metrics.read_gauges(connection), workers, disk.free, disk.total)


def existing_folder(data_folder: Path) -> Path:
    """The data folder, or its nearest existing parent: the first write creates the data folder."""
    return next(folder for folder in (data_folder, *data_folder.parents) if folder.exists())


def list_changes(
    connection: Connection,
    limit: int,
    *,
    before: int | None = None,
    kind: str | None = None,
    subject: str | None = None,
    actor: str | None = None,
) -> list[Change]:
    """The recorded changes, the newest first.

    Args:
        limit: at most this many changes, 1 to 1,000.
        before: only changes with an id below this one: the next page.
        kind: only changes of this kind: `token`, `block`, `scene`, `job`, `point`, `reference_image` or
            `audit`.
        subject: only changes of the thing with this id; ID@VERSION for a block.
        actor: only changes by who has this name: a token, or a user of the command line.

    Raises:
        InputError: the limit is out of range, or the kind is unknown.
    """
    if not 1 <= limit <= MOST_CHANGES:
        raise InputError(f"limit: {limit} found, 1 to {MOST_CHANGES} expected")
    if kind is not None and kind not in audit.KINDS:
        raise InputError(f"kind: {kind!r:.40} found, one of {', '.join(audit.KINDS)} expected")
    return audit.list_changes(connection, limit, before, kind, subject, actor=actor)
