"""Files that arrive in pieces, over lines that break: begun, gone on with, put in their places."""

import fcntl
import hashlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO
from uuid import UUID

from app.auth import Scope, may_access, require
from app.config import Settings
from app.db import scenes, uploads
from app.db.engine import Connection, Database
from app.db.tokens import Token
from app.db.uploads import Purpose, UploadRow
from app.errors import AmersError, Conflict, InputError, NotFound, TooLarge
from app.storage import Storage
from app.usecases import quotas
from app.usecases.blocks.uploads import block_key
from app.usecases.scenes import (
    MODEL_LIMIT_BYTES,
    MODEL_SUFFIXES,
    clean_name,
    folder_of,
    limit_beside,
    name_beside,
    note_model,
    refuse_strange,
    visible_scene,
)
from services.formats.archives import (
    HEAD_BYTES,
    ArchiveLimits,
    check_archive,
    is_archive,
    unpack_archive,
)

IMAGE_SUFFIXES = (".tif", ".tiff", ".jp2", ".j2k", ".ntf", ".nitf")
PURPOSES: tuple[Purpose, ...] = ("image", "model", "block")
PREFIX = "upload-"
READ_BYTES = 1 << 20


class Busy(AmersError):
    """Somebody else is sending to this upload just now."""


class WrongChecksum(AmersError):
    """A piece is not as announced; it was thrown away."""


@dataclass(frozen=True)
class NewUpload:
    """A file as its sender announces it.

    Attributes:
        name: as the sender calls it; folders in it mean nothing.
        size_bytes: of the whole file.
        purpose: None: a model if it is to lie beside an image, else an image.
        scene: beside whose image it is to lie.
        sha256: of the whole file, in hexadecimal; not checked when None.
        sigma_m: accuracy of the model of an image, metres.
        metadata: all of this as sent, to be repeated.
    """

    name: str
    size_bytes: int
    purpose: Purpose | None = None
    scene: UUID | None = None
    sha256: str | None = None
    sigma_m: float | None = None
    metadata: str = ""


@dataclass(frozen=True)
class Checksum:
    """What a piece must hash to.

    Attributes:
        algorithm: one that hashlib knows.
    """

    algorithm: str
    digest: bytes


def begin(
    connection: Connection, storage: Storage, settings: Settings, caller: Token, new: NewUpload
) -> UploadRow:
    """Make room for a file; that of an image begins a scene.

    Raises:
        NotAllowed: the caller may not send such files.
        TooLarge: more bytes than the limit or the caller's quota.
        InputError, NotFound, Conflict: it can have no place.
    """
    purpose: Purpose = new.purpose or ("image" if new.scene is None else "model")
    require(caller, Scope.ADMIN if purpose == "block" else Scope.REGISTER)
    is_beside = purpose == "model"
    limit = limit_beside(settings, new.name) if is_beside else settings.upload_limit_bytes
    if new.size_bytes > limit:
        raise TooLarge(f"{new.size_bytes} bytes announced, at most {limit} are accepted")
    quotas.upload_allowance(connection, settings, caller, new.size_bytes)
    file_name, scene_id = clean_name(new.name), new.scene
    if purpose == "model":
        if scene_id is None:
            raise InputError("scene: a model needs the id of the scene beside whose image it lies")
        file_name = name_beside(visible_scene(connection, caller, scene_id), new.name)
    elif purpose == "image":
        if scene_id is not None:
            raise InputError("scene: an image begins a scene of its own")
        name = new.name[-200:]
        scene_id = scenes.begin_upload(connection, caller.id, name, file_name, new.sigma_m)
    upload = uploads.insert_upload(
        connection,
        owner=caller.id,
        purpose=purpose,
        scene_id=None if purpose == "block" else scene_id,
        name=new.name[-200:],
        file_name=file_name,
        size_bytes=new.size_bytes,
        sha256=new.sha256,
        metadata=new.metadata,
    )
    _path(storage, upload.id).touch(mode=0o600, exist_ok=False)
    return upload


def find(connection: Connection, caller: Token, upload_id: UUID) -> UploadRow:
    """The upload, for its owner or an administrator.

    Raises:
        NotFound: there is none, it was given up, or it is somebody else's: strangers cannot tell which.
    """
    upload = uploads.find_upload(connection, upload_id)
    if upload is None or not may_access(caller, upload.owner) or upload.expired:
        raise NotFound(f"no upload {upload_id}")
    return upload


def offset(storage: Storage, upload: UploadRow) -> int:
    """How much of a file has arrived, bytes.

    Raises:
        NotFound: nothing of it is on this machine.
    """
    if upload.finished_at is not None:
        return upload.size_bytes
    try:
        return _path(storage, upload.id).stat().st_size
    except FileNotFoundError:
        raise NotFound(f"nothing of upload {upload.id} is left on this machine") from None


def receive(
    database: Database,
    storage: Storage,
    settings: Settings,
    upload: UploadRow,
    start: int,
    chunks: Iterable[bytes],
    checksum: Checksum | None = None,
) -> int:
    """Append a piece; the last one puts the file into its place.

    What arrived before a line broke is kept, but for a piece with a checksum.

    Returns:
        How much has arrived, bytes.

    Raises:
        Busy: somebody else is sending.
        Conflict: the piece does not begin where the file ends.
        WrongChecksum: the piece is not as announced.
        TooLarge: the piece goes beyond the announced size.
        InputError: the whole file is not what it should be; it is thrown away.
    """
    path = _path(storage, upload.id)
    with _locked(path) as file:
        arrived = file.seek(0, os.SEEK_END)
        if start != arrived:
            raise Conflict(f"{arrived} bytes have arrived, the piece begins at {start}")
        _append(file, start, upload.size_bytes, chunks, checksum)
        arrived = file.tell()
        with database.transaction() as connection:
            if uploads.prolong(connection, upload.id) is None:
                raise NotFound(f"no upload {upload.id}")
        if arrived == upload.size_bytes:
            _settle(database, storage, settings, upload, path)
    return arrived


def drop(connection: Connection, storage: Storage, upload: UploadRow) -> None:
    """End an upload and forget what has arrived of it; a complete one stays where it is.

    Raises:
        Conflict: it is complete.
    """
    if upload.finished_at is not None:
        raise Conflict(f"upload {upload.id} is complete: remove the scene instead")
    _forget(connection, upload)
    _path(storage, upload.id).unlink(missing_ok=True)


def sweep_uploads(database: Database, storage: Storage) -> list[str]:
    """Give up the uploads nobody went on with; returns the names of the files removed.

    A file without a row is one whose upload was given up: rows come first.
    """
    with database.transaction() as connection:
        uploads.delete_expired(connection)
    files = {UUID(path.name.removeprefix(PREFIX)): path for path in storage.scratch().glob(f"{PREFIX}*")}
    with database.transaction() as connection:
        kept = uploads.arriving(connection, list(files))
    gone = [path for upload_id, path in files.items() if upload_id not in kept]
    for path in gone:
        path.unlink(missing_ok=True)
    return [path.name for path in gone]


def _path(storage: Storage, upload_id: UUID) -> Path:
    return storage.scratch() / f"{PREFIX}{upload_id}"


@contextmanager
def _locked(path: Path) -> Iterator[IO[bytes]]:
    """The file, for one sender; the kernel lets go of it however that one ends."""
    try:
        file = path.open("r+b", buffering=0)
    except FileNotFoundError:
        raise NotFound(f"nothing of {path.name} is left on this machine") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Busy("somebody else is sending to this upload just now") from None
        yield file


def _append(
    file: IO[bytes], start: int, size_bytes: int, chunks: Iterable[bytes], checksum: Checksum | None
) -> None:
    digest = hashlib.new(checksum.algorithm) if checksum else None
    whole = False
    try:
        for chunk in chunks:
            if file.tell() + len(chunk) > size_bytes:
                raise TooLarge(f"the piece goes beyond the {size_bytes} bytes announced")
            if digest is not None:
                digest.update(chunk)
            left = memoryview(chunk)
            while left:
                left = left[file.write(left) :]
        whole = True
    finally:
        right = checksum is None or (whole and digest is not None and digest.digest() == checksum.digest)
        if not right:
            file.truncate(start)
            file.seek(start)
        os.fsync(file.fileno())
    if not right:
        raise WrongChecksum(f"the piece from byte {start} does not have the checksum announced")


def _settle(
    database: Database, storage: Storage, settings: Settings, upload: UploadRow, path: Path
) -> None:
    """Put a file that has arrived into its place, or throw it away and say why."""
    try:
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        if upload.sha256 not in (None, sha256):
            raise InputError(f"sha256 {upload.sha256} announced, {sha256} received")
        if upload.purpose == "image":
            _place_image(database, storage, settings, upload, path, sha256)
        elif upload.purpose == "model":
            assert upload.scene_id is not None
            storage.adopt(path, f"{folder_of(upload.scene_id)}/{upload.file_name}")
            with database.transaction() as connection:
                note_model(connection, upload.scene_id, upload.file_name, upload.size_bytes, sha256)
                uploads.finish(connection, upload.id)
        else:
            key = block_key(upload)
            storage.adopt(path, key)
            with database.transaction() as connection:
                uploads.finish(connection, upload.id, key)
    except AmersError:
        with database.transaction() as connection:
            _forget(connection, upload)
        path.unlink(missing_ok=True)
        raise


def _forget(connection: Connection, upload: UploadRow) -> None:
    uploads.delete_upload(connection, upload.id)
    if upload.purpose == "image" and upload.scene_id is not None:
        scenes.give_up_upload(connection, upload.scene_id)


def _place_image(
    database: Database,
    storage: Storage,
    settings: Settings,
    upload: UploadRow,
    path: Path,
    sha256: str,
) -> None:
    assert upload.scene_id is not None
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    with storage.scratch_folder("unpacked-") as folder:
        models: list[Path] = []
        image, name = path, upload.file_name
        if is_archive(head):
            image, models = _unpacked(path, folder, settings)
            name = image.name
            with image.open("rb") as file:
                head = file.read(HEAD_BYTES)
                file.seek(0)
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        refuse_strange(head)
        size_bytes = image.stat().st_size
        noted = [
            (one.name, one.stat().st_size, hashlib.sha256(one.read_bytes()).hexdigest())
            for one in models
        ]
        for one in [*models, image]:
            storage.adopt(one, f"{folder_of(upload.scene_id)}/{one.name if one != path else name}")
    key = f"{folder_of(upload.scene_id)}/{name}"
    with database.transaction() as connection:
        if scenes.finish_upload(connection, upload.scene_id, key, size_bytes, sha256) is None:
            raise Conflict("the upload took so long that it was given up")
        for model in noted:
            note_model(connection, upload.scene_id, *model)
        uploads.finish(connection, upload.id)
    path.unlink(missing_ok=True)


def _unpacked(archive: Path, folder: Path, settings: Settings) -> tuple[Path, list[Path]]:
    """The one image of an archive and the models beside it, unpacked into a folder.

    Raises:
        FormatError: the archive is broken or holds what it may not.
        InputError: it does not hold exactly one image.
    """
    limits = ArchiveLimits(settings.upload_limit_bytes)
    members = check_archive(archive, limits)
    images = [one.path for one in members if one.path.suffix.lower() in IMAGE_SUFFIXES]
    if len(images) != 1:
        names = ", ".join(str(path) for path in images[:5]) or "none"
        raise InputError(f"an archive with a scene holds one image, this one {len(images)}: {names}")
    beside = [
        one.path
        for one in members
        if one.path.parent == images[0].parent
        and one.path.suffix.lower() in MODEL_SUFFIXES
        and one.size_bytes <= MODEL_LIMIT_BYTES
    ]
    places: dict[PurePosixPath, Path] = {
        path: folder / clean_name(path.name) for path in (images[0], *beside)
    }
    if len(set(places.values())) < len(places):
        raise InputError("two files of the archive have the same name but for letters that are not kept")
    unpack_archive(archive, places, limits)
    return places[images[0]], [places[path] for path in beside]
