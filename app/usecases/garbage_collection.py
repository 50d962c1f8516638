"""Garbage collection in the storage: remove files that no row of the store refers to.

Interrupted uploads, ingestions and attempts leave such files. A row is written before its files and
deleted before them, so a file without a row is never one that is just being written.
"""

from collections.abc import Callable
from uuid import UUID

from app.db import blocks, scenes, uploads
from app.db.engine import Connection, Database
from app.db.jobs import attempts
from app.storage import Storage


def remove_unnamed_files(database: Database, storage: Storage) -> list[str]:
    """Remove files of deleted scenes and uploads and of attempts without effect; returns their keys."""
    removed = []
    in_use: tuple[tuple[str, Callable[[Connection, list[str]], set[str]]], ...] = (
        ("scenes", _scene_folders),
        ("results", _attempt_folders),
        ("uploads", _upload_folders),
    )
    for prefix, folders_in_use in in_use:
        folder_of_key = {key: key.rsplit("/", 1)[0] for key in storage.keys(prefix)}
        with database.transaction() as connection:
            used = folders_in_use(connection, sorted(set(folder_of_key.values())))
        for key, folder in folder_of_key.items():
            if folder not in used:
                storage.delete(key)
                removed.append(key)
    return removed


def remove_unnamed_chips(connection: Connection, storage: Storage) -> list[str]:
    """Remove chip files that no block refers to, left by failed ingestions; returns their keys.

    Waits for the ingestions under way.
    """
    blocks.lock_sweep(connection)
    unnamed = sorted(set(storage.keys("chips")) - blocks.storage_keys(connection))
    for key in unnamed:
        storage.delete(key)
    return unnamed


def _scene_folders(connection: Connection, folders: list[str]) -> set[str]:
    """Of the folders `scenes/ID`, those whose scene has files or is being uploaded."""
    ids = {folder: UUID(folder.split("/")[1]) for folder in folders}
    present = scenes.with_files(connection, list(ids.values()))
    return {folder for folder, scene_id in ids.items() if scene_id in present}


def _attempt_folders(connection: Connection, folders: list[str]) -> set[str]:
    """Of the folders `results/JOB/ATTEMPT`, those whose attempt is under way or has succeeded."""
    ids = {folder: UUID(folder.split("/")[1]) for folder in folders}
    counting = attempts.counting_attempts(connection, list(set(ids.values())))
    return {
        folder for folder, job_id in ids.items() if counting.get(job_id) == int(folder.split("/")[2])
    }


def _upload_folders(connection: Connection, folders: list[str]) -> set[str]:
    """Of the folders `uploads/ID`, those whose upload is present or arriving."""
    ids = {folder: UUID(folder.split("/")[1]) for folder in folders}
    present = uploads.present(connection, list(ids.values()))
    return {folder for folder, upload_id in ids.items() if upload_id in present}
