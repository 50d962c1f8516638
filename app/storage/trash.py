"""The trash of a storage: files that the sweep removed, under `trash/BATCH/KEY` for some days.

A batch is named by the date and by the hours that the service had run, such as `2026-11-22_310h`. A
batch is old when both say so: a clock that jumps ahead does not empty the trash.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import date

from amers.app.storage.folder import Storage

TRASH = "trash"
BATCH = re.compile(r"(\d{4}-\d\d-\d\d)_(\d+)h")


@dataclass(frozen=True)
class Moment:
    """A moment by the calendar and by the time that the service has run.

    Attributes:
        day: of the database's clock.
        uptime_h: whole hours that the service has run.
    """

    day: date
    uptime_h: int

    @property
    def batch(self) -> str:
        """The name of the batch of files that are discarded at this moment."""
        return f"{self.day.isoformat()}_{self.uptime_h}h"


def discard(storage: Storage, keys: Iterable[str], at: Moment) -> None:
    """Move files into the trash."""
    for key in keys:
        storage.move(key, f"{TRASH}/{at.batch}/{key}")


def batches(storage: Storage) -> dict[str, list[str]]:
    """The batches of the trash, oldest first, each with the former keys of its files."""
    contents: dict[str, list[str]] = {}
    for key in storage.keys(TRASH):
        _, batch, former_key = key.split("/", 2)
        contents.setdefault(batch, []).append(former_key)
    return dict(sorted(contents.items(), key=lambda one: _age(one[0])))


def _age(batch: str) -> tuple[str, int]:
    """The date and the hours of a batch: those of 95 hours come before those of 310."""
    form = BATCH.fullmatch(batch)
    return (batch, 0) if form is None else (form[1], int(form[2]))


def find(storage: Storage, key: str) -> str | None:
    """The key of a file in the trash, the newest if there are several; None if it is not there."""
    found = [f"{TRASH}/{batch}/{key}" for batch, keys in batches(storage).items() if key in keys]
    return found[-1] if found else None


def put_back(storage: Storage, batch: str, keys: Iterable[str]) -> list[str]:
    """Move files of a batch back to their former keys, if these are free; returns the keys."""
    free = [key for key in keys if not storage.exists(key)]
    for key in free:
        storage.move(f"{TRASH}/{batch}/{key}", key)
    return free


def empty(storage: Storage) -> int:
    """Delete all files of the trash; returns their number."""
    keys = storage.keys(TRASH)
    for key in keys:
        storage.delete(key)
    return len(keys)


def delete_old(storage: Storage, now: Moment, trash_days: float) -> int:
    """Delete the files of the batches that are this old by calendar and uptime; returns their number."""
    n_deleted = 0
    for batch, keys in batches(storage).items():
        form = BATCH.fullmatch(batch)
        if form is None:
            continue
        age_days = (now.day - date.fromisoformat(form[1])).days
        if min(age_days, (now.uptime_h - int(form[2])) / 24) < trash_days:
            continue
        for key in keys:
            storage.delete(f"{TRASH}/{batch}/{key}")
        n_deleted += len(keys)
    return n_deleted
