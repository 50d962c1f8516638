"""Archives of blocks in the table `upload`: arrived whole, waiting to be ingested."""

from uuid import UUID, uuid4

from psycopg.rows import scalar_row

from app.db.engine import Connection

LIFE_HOURS = 24


def keep_upload(
    connection: Connection, owner: UUID, name: str, key: str, size_bytes: int, sha256: str
) -> UUID:
    """An archive that has arrived; it waits for a day to be asked for."""
    upload_id = uuid4()
    connection.execute(
        """insert into upload (id, owner, purpose, name, file_name, size_bytes, sha256, file_key,
               expires_at, finished_at)
           values (%s, %s, 'block', %s, %s, %s, %s, %s, now() + make_interval(hours => %s), now())""",
        [upload_id, owner, name, name, size_bytes, sha256, key, LIFE_HOURS],
    )
    return upload_id


def find_archive(connection: Connection, upload_id: UUID) -> str | None:
    """Where the storage has the archive of an upload that is complete."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        found: str | None = cursor.execute(
            "select file_key from upload"
            " where id = %s and purpose = 'block' and finished_at is not null",
            [upload_id],
        ).fetchone()
    return found


def delete_unwanted(connection: Connection) -> list[str]:
    """Forget archives that nobody asked for in time and no open job names; returns their keys."""
    with connection.cursor(row_factory=scalar_row) as cursor:
        keys: list[str] = cursor.execute(
            """delete from upload u where purpose = 'block' and finished_at is not null
                   and expires_at < now()
                   and not exists (select from job where state in ('accepted', 'running')
                                   and inputs ->> 'upload' = u.id::text)
               returning file_key"""
        ).fetchall()
    return keys
