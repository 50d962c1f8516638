"""Uploaded archives of blocks: receive one, find one that is complete, delete the expired ones."""

from contextlib import suppress
from uuid import UUID

from amers.app.auth import may_access
from amers.app.db import uploads
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.db.uploads import AnnouncedFile, UploadRow
from amers.app.errors import Conflict, InputError, NotFound, StorageOutage
from amers.app.usecases import quotas
from amers.app.usecases.garbage_collection import Bin
from amers.app.usecases.installation import Installation
from amers.app.usecases.scenes import SentFile, clean_name


def receive_block(installation: Installation, caller: Token, sent: SentFile) -> UUID:
    """Store a zip or tar archive of a block; the job that ingests it checks its content.

    Returns:
        The id of the upload, an input of the process `ingest-block`.

    Raises:
        TooLarge: the archive exceeds the limit or the caller's quota.
        InputError: the name cannot be used, or the archive is empty.
    """
    database, storage = installation.database, installation.storage
    file_name = clean_name(sent.name)
    storage.prove()
    with database.transaction() as connection:
        left = quotas.require_room(
            connection, installation.settings, caller.id, "the archive", sent.size_bytes
        )
        limit = min(left, installation.settings.upload_limit_bytes)
        # An archive of unknown size reserves all that is left of the quota until it has arrived.
        announced = AnnouncedFile(
            owner=caller.id,
            purpose="block",
            scene_id=None,
            name=sent.name[-200:],
            file_name=file_name,
            size_bytes=sent.size_bytes or limit,
            sha256=None,
            metadata="",
        )
        upload = uploads.insert_upload(connection, announced)
    try:
        stored = storage.put(block_key(upload), sent.chunks, limit)
        if stored.size_bytes == 0:
            raise InputError(f"{file_name}: empty file found, a zip or tar of a block expected")
        with database.transaction() as connection:
            if not uploads.finish(connection, upload.id, stored.key, stored.size_bytes, stored.sha256):
                raise Conflict(f"upload {upload.id} took too long and has expired; start a new one")
    except BaseException:
        with database.transaction() as connection:
            uploads.delete_upload(connection, upload.id)
        # After an outage of the storage, garbage collection deletes what is left.
        with suppress(StorageOutage):
            storage.delete(block_key(upload))
        raise
    return upload.id


def block_key(upload: UploadRow) -> str:
    """The storage key of the archive of an upload."""
    return f"uploads/{upload.id}/{upload.file_name}"


def find_uploaded_block(connection: Connection, caller: Token, upload_id: UUID) -> str:
    """The storage key of a completely uploaded archive of a block.

    Raises:
        NotFound: there is no such upload, or the caller may not see it.
        Conflict: it is not complete yet.
        InputError: it is not the archive of a block.
    """
    upload = uploads.find_upload(connection, upload_id)
    if upload is None or upload.expired or not may_access(caller, upload.owner):
        raise NotFound(f"no uploaded block {upload_id}")
    if upload.purpose != "block":
        raise InputError(f"upload {upload_id} has the purpose {upload.purpose}, block is expected")
    if upload.file_key is None:
        raise Conflict(f"upload {upload_id} is not complete yet; send the rest of it first")
    return upload.file_key


def remove_expired_archives(connection: Connection, rubbish: Bin) -> list[str]:
    """Remove the archives that were not ingested in time; returns their keys."""
    return rubbish.remove(uploads.delete_unwanted_blocks(connection))
