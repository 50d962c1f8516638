"""What each owner keeps in the storage and in the queue, from the sizes that the rows record."""

from dataclasses import dataclass
from typing import Any
from uuid import UUID

from sqlalchemy import (
    BigInteger,
    ColumnElement,
    Executable,
    Select,
    cast,
    func,
    literal,
    or_,
    select,
    union_all,
)

from amers.app.db.engine import Connection
from amers.app.db.rows import every
from amers.app.db.schema import job, scene, upload


@dataclass(frozen=True)
class Usage:
    """What one owner keeps.

    Attributes:
        owner: id of the token; None for what the command line made.
        scenes: scenes that are not removed.
        open_uploads: resumable uploads that are not complete.
        jobs: rows of jobs.
        scene_bytes: images and the files beside them, and the announced sizes of those that arrive.
        upload_bytes: announced sizes of open uploads, and archives of blocks.
        result_bytes: files of results, and the room reserved for results that are being stored.
    """

    owner: UUID | None
    scenes: int
    open_uploads: int
    jobs: int
    scene_bytes: int
    upload_bytes: int
    result_bytes: int

    @property
    def total_bytes(self) -> int:
        """All bytes that count against the quota."""
        return self.scene_bytes + self.upload_bytes + self.result_bytes


FIGURES = ("scenes", "open_uploads", "jobs", "scene_bytes", "upload_bytes", "result_bytes")


def read_usage(connection: Connection, owner: UUID) -> Usage:
    """What one owner keeps."""
    rows = every(Usage, connection.execute(_usage(owner)))
    return rows[0] if rows else Usage(owner, *(0 for _ in FIGURES))


def read_all_usage(connection: Connection) -> list[Usage]:
    """What every owner keeps; owners who keep nothing are left out."""
    return every(Usage, connection.execute(_usage(None)))


def _usage(owner: UUID | None) -> Executable:
    """One row for each owner, or for one of them; every part reads an index of its table."""
    parts = union_all(
        _part(
            scene.c.owner,
            scene.c.state != "removed",
            owner,
            scenes=func.count(),
            scene_bytes=func.sum(func.coalesce(scene.c.size_bytes, 0) + scene.c.side_file_bytes),
        ),
        _part(
            upload.c.owner,
            or_(upload.c.finished_at.is_(None), upload.c.file_key.is_not(None)),
            owner,
            open_uploads=func.count().filter(upload.c.finished_at.is_(None)),
            upload_bytes=func.sum(upload.c.size_bytes),
        ),
        _part(job.c.owner, job.c.results_bytes > 0, owner, result_bytes=func.sum(job.c.results_bytes)),
        _part(job.c.owner, None, owner, jobs=func.count()),
    ).subquery()
    # The sum of bigints is numeric.
    sums = [cast(func.sum(parts.c[name]), BigInteger).label(name) for name in FIGURES]
    return select(parts.c.owner, *sums).group_by(parts.c.owner)


def _part(
    owner_column: ColumnElement[UUID],
    condition: ColumnElement[bool] | None,
    owner: UUID | None,
    **figures: ColumnElement[int],
) -> "Select[UUID, *tuple[Any, ...]]":
    """Some figures of one table, by owner; the others are zero."""
    columns = [figures.get(name, literal(0)).label(name) for name in FIGURES]
    statement = select(owner_column.label("owner"), *columns)
    for narrower in (condition, None if owner is None else owner_column == owner):
        statement = statement if narrower is None else statement.where(narrower)
    return statement.group_by(owner_column)
