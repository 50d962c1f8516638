"""Archives of blocks that were uploaded, in one piece or by tus: where they lie, how long they wait."""

from collections.abc import Iterable
from contextlib import suppress
from uuid import UUID

from app.auth import may_access
from app.config import Settings
from app.db import uploads
from app.db.engine import Connection, Database
from app.db.tokens import Token
from app.db.uploads import UploadRow
from app.errors import Conflict, InputError, NotFound, StorageOutage
from app.storage import Storage
from app.usecases import quotas
from app.usecases.scenes import clean_name


def receive_block(
    database: Database,
    storage: Storage,
    settings: Settings,
    caller: Token,
    name: str,
    chunks: Iterable[bytes],
    announced_bytes: int | None = None,
) -> UUID:
    """Take in a zip or tar of a block; it is looked into by the job that ingests it, not here.

    Returns:
        The id by which an ingestion names it.

    Raises:
        TooLarge: more bytes than are accepted, or than the caller's quota leaves.
        InputError: the name is none, or the archive is empty.
    """
    file_name = clean_name(name)
    with database.transaction() as connection:
        left = quotas.upload_allowance(connection, settings, caller, announced_bytes)
        limit = min(left, settings.upload_limit_bytes)
        # An archive that does not say its size may take all that is left until it has arrived.
        upload = uploads.insert_upload(
            connection,
            owner=caller.id,
            purpose="block",
            scene_id=None,
            name=name[-200:],
            file_name=file_name,
            size_bytes=announced_bytes or limit,
            sha256=None,
            metadata="",
        )
    try:
        stored = storage.put(block_key(upload), chunks, limit)
        if stored.size_bytes == 0:
            raise InputError(f"{file_name}: empty; a zip or tar of a block expected")
        with database.transaction() as connection:
            if not uploads.finish(connection, upload.id, stored.key, stored.size_bytes, stored.sha256):
                raise Conflict("the upload took so long that it was given up")
    except BaseException:
        with database.transaction() as connection:
            uploads.delete_upload(connection, upload.id)
        # What an outage leaves is swept.
        with suppress(StorageOutage):
            storage.delete(block_key(upload))
        raise
    return upload.id


def block_key(upload: UploadRow) -> str:
    """Where the storage has the archive of an upload."""
    return f"uploads/{upload.id}/{upload.file_name}"


def finished_block(connection: Connection, caller: Token, upload_id: UUID) -> str:
    """The key of an archive with a block that has arrived.

    Raises:
        NotFound: there is no such upload of this caller.
        Conflict: it has not arrived yet.
        InputError: it is no block.
    """
    upload = uploads.find_upload(connection, upload_id)
    if upload is None or not may_access(caller, upload.owner) or upload.expired:
        raise NotFound(f"no uploaded block {upload_id}")
    if upload.purpose != "block":
        raise InputError(f"upload {upload_id} is not one of a block")
    if upload.file_key is None:
        raise Conflict(f"upload {upload_id} has not arrived yet")
    return upload.file_key


def sweep_blocks(connection: Connection, storage: Storage) -> list[str]:
    """Remove the archives that nobody had ingested in time; returns their keys."""
    unwanted = uploads.delete_unwanted_blocks(connection)
    for key in unwanted:
        storage.delete(key)
    return unwanted
