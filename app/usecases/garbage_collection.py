"""Garbage collection in the storage: move files that no row of the store refers to into the trash.

Interrupted uploads, ingestions and attempts leave such files. A row is written before its files and
deleted before them, so a file without a row is never one that is just being written.
"""

import logging
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from uuid import UUID

from amers.app.db import blocks, scenes, uploads, uptime
from amers.app.db.engine import Connection, Database
from amers.app.db.jobs import attempts
from amers.app.storage import Storage, trash
from amers.app.storage.trash import Moment

SHARE_AT_ONCE = 0.05
FILES_AT_ONCE = 100
"""A sweep removes at most this share of the files of a family, or this number if it is larger."""
OURS = re.compile(r"(scenes|results|uploads)/[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}/.")

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Family:
    """The files below one folder of the storage, compared with the rows of the database.

    Attributes:
        name: of the folder: `chips`, `scenes`, `results` or `uploads`.
        n_files: number of files.
        given_up: keys of files that their row no longer needs: of removed scenes, of failed attempts.
        unknown: keys of files without a row.
    """

    name: str
    n_files: int
    given_up: list[str]
    unknown: list[str]

    @property
    def most_at_once(self) -> int:
        """The largest number of files that one sweep may remove."""
        return max(FILES_AT_ONCE, int(SHARE_AT_ONCE * self.n_files))


@dataclass(frozen=True)
class Bin:
    """Where a sweep puts what it removes.

    Attributes:
        storage: of the files.
        at: names the batch of the trash; None deletes the files.
        limited: whether a sweep removes only a small share of the files.
    """

    storage: Storage
    at: Moment | None = None
    limited: bool = True

    def remove(self, keys: Iterable[str]) -> list[str]:
        """Move files into the trash, or delete them; returns their keys."""
        removed = list(keys)
        if self.at is not None:
            trash.discard(self.storage, removed, self.at)
        else:
            for key in removed:
                self.storage.delete(key)
        return removed

    def remove_unnamed(self, family: Family) -> list[str]:
        """Remove the files of a family that are given up or unknown; returns their keys.

        Many unknown files at once mean that the database does not know the storage: they stay.
        """
        if not self.limited:
            return self.remove(family.given_up + family.unknown)
        if len(family.unknown) <= family.most_at_once:
            return self.remove((family.unknown + family.given_up)[: family.most_at_once])
        log.error(
            "%s: no row of the database knows %d of the %d files in the storage; at most %d are removed "
            "at once, so all of them stay. If the service misses nothing, run `amers store sweep`",
            family.name,
            len(family.unknown),
            family.n_files,
            family.most_at_once,
        )
        return self.remove(family.given_up[: family.most_at_once])


def remove_unnamed_files(database: Database, rubbish: Bin) -> list[str]:
    """Remove files of removed scenes, of deleted uploads and of attempts without effect.

    Returns:
        The keys of the files.
    """
    removed = []
    for name in FOLDER_STATES:
        with database.transaction() as connection:
            family = compare_folders(connection, rubbish.storage, name)
        removed += rubbish.remove_unnamed(family)
    return removed


def remove_unnamed_chips(connection: Connection, rubbish: Bin) -> list[str]:
    """Remove chip files that no block refers to, left by failed ingestions; returns their keys.

    Waits for the ingestions under way.
    """
    blocks.lock_sweep(connection)
    return rubbish.remove_unnamed(compare_chips(connection, rubbish.storage))


def remove_all_unnamed(database: Database, storage: Storage) -> list[str]:
    """Move all files that no row needs into the trash, however many they are; returns their keys."""
    with database.transaction() as connection:
        rubbish = Bin(storage, moment(connection), limited=False)
    removed = remove_unnamed_files(database, rubbish)
    with database.transaction() as connection:
        return removed + remove_unnamed_chips(connection, rubbish)


def moment(connection: Connection) -> Moment:
    """This moment, for the trash."""
    day, uptime_s = uptime.today(connection)
    return Moment(day, int(uptime_s // 3600))


def compare_files(connection: Connection, storage: Storage) -> list[Family]:
    """All files of the storage compared with the rows of the database."""
    folders = [compare_folders(connection, storage, name) for name in FOLDER_STATES]
    return [*folders, compare_chips(connection, storage)]


def compare_folders(connection: Connection, storage: Storage, name: str) -> Family:
    """The files of scenes, results or uploaded blocks compared with their rows.

    Files whose keys Amers does not make are left out.
    """
    folder_of_key = {key: key.rsplit("/", 1)[0] for key in storage.keys(name) if OURS.match(key)}
    states = FOLDER_STATES[name](connection, sorted(set(folder_of_key.values())))
    return Family(
        name,
        len(folder_of_key),
        [key for key, folder in folder_of_key.items() if states.get(folder) is False],
        [key for key, folder in folder_of_key.items() if folder not in states],
    )


def compare_chips(connection: Connection, storage: Storage) -> Family:
    """The chip files compared with the rows of blocks."""
    keys = storage.keys("chips")
    return Family("chips", len(keys), [], sorted(set(keys) - blocks.storage_keys(connection)))


def _scene_folders(connection: Connection, folders: list[str]) -> dict[str, bool]:
    """Of the folders `scenes/ID`, those whose scene is known, with whether it keeps its files."""
    ids = _ids(folders)
    keeping = scenes.keeping_files(connection, list(ids.values()))
    return {folder: keeping[scene_id] for folder, scene_id in ids.items() if scene_id in keeping}


def _attempt_folders(connection: Connection, folders: list[str]) -> dict[str, bool]:
    """Of the folders `results/JOB/ATTEMPT`, those of known jobs, with whether the attempt counts."""
    ids = _ids(folders)
    counting = attempts.counting_attempts(connection, list(set(ids.values())))
    return {
        folder: folder.split("/")[2:3] == [str(counting[job_id])]
        for folder, job_id in ids.items()
        if job_id in counting
    }


def _upload_folders(connection: Connection, folders: list[str]) -> dict[str, bool]:
    """Of the folders `uploads/ID`, those whose upload is present or arriving."""
    ids = _ids(folders)
    present = uploads.present(connection, list(ids.values()))
    return {folder: True for folder, upload_id in ids.items() if upload_id in present}


def _ids(folders: list[str]) -> dict[str, UUID]:
    """The ids in the names of folders."""
    return {folder: UUID(folder.split("/")[1]) for folder in folders}


FOLDER_STATES: dict[str, Callable[[Connection, list[str]], dict[str, bool]]] = {
    "scenes": _scene_folders,
    "results": _attempt_folders,
    "uploads": _upload_folders,
}
