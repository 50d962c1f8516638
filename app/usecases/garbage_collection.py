"""Removing files that no row of the store names: what was left by uploads and attempts cut off."""

from collections.abc import Callable
from uuid import UUID

from app.db import scenes, uploads
from app.db.engine import Connection, Database
from app.db.jobs import attempts
from app.storage import Storage


def remove_unnamed_files(database: Database, storage: Storage) -> list[str]:
    """Remove scenes and uploads that are not there any more, and results of attempts that do not count.

    Rows come before files (an upload, a running attempt) and go after them, so a file without a row is
    never one on its way.

    Returns:
        The keys removed.
    """
    removed = []
    wanted: tuple[tuple[str, Callable[[Connection, list[str]], set[str]]], ...] = (
        ("scenes", _scene_folders),
        ("results", _attempt_folders),
        ("uploads", _upload_folders),
    )
    for top, still_wanted in wanted:
        keys = storage.keys(top)
        folders = {key: key.rsplit("/", 1)[0] for key in keys}
        with database.transaction() as connection:
            kept = still_wanted(connection, sorted(set(folders.values())))
        for key, folder in folders.items():
            if folder not in kept:
                storage.delete(key)
                removed.append(key)
    return removed


def _scene_folders(connection: Connection, folders: list[str]) -> set[str]:
    """Those of `scenes/ID` whose scene is there or arriving."""
    ids = {folder: UUID(folder.split("/")[1]) for folder in folders}
    present = scenes.with_files(connection, list(ids.values()))
    return {folder for folder, scene_id in ids.items() if scene_id in present}


def _attempt_folders(connection: Connection, folders: list[str]) -> set[str]:
    """Those of `results/JOB/ATTEMPT` whose attempt is under way or succeeded."""
    ids = {folder: UUID(folder.split("/")[1]) for folder in folders}
    counting = attempts.counting_attempts(connection, list(set(ids.values())))
    return {
        folder for folder, job_id in ids.items() if counting.get(job_id) == int(folder.split("/")[2])
    }


def _upload_folders(connection: Connection, folders: list[str]) -> set[str]:
    """Those of `uploads/ID` whose upload is there or arriving."""
    ids = {folder: UUID(folder.split("/")[1]) for folder in folders}
    present = uploads.present(connection, list(ids.values()))
    return {folder for folder, upload_id in ids.items() if upload_id in present}
