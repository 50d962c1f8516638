"""Create, append to and complete resumable uploads (tus 1.0)."""

import fcntl
import hashlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO
from uuid import UUID

from amers.app.auth import Scope, may_access, require
from amers.app.config import Settings
from amers.app.db import scenes, uploads
from amers.app.db.engine import Connection, Database
from amers.app.db.schema import UploadPurpose
from amers.app.db.tokens import Token
from amers.app.db.uploads import AnnouncedFile, UploadRow
from amers.app.errors import AmersError, Conflict, InputError, NotFound, TooLarge
from amers.app.storage import Storage
from amers.app.usecases import quotas
from amers.app.usecases.blocks.uploads import block_key
from amers.app.usecases.installation import Installation
from amers.app.usecases.scenes import (
    MODEL_SUFFIXES,
    SIDE_FILE_LIMIT_BYTES,
    clean_name,
    folder_of,
    record_side_file,
    require_image_signature,
    side_file_limit,
    side_file_name,
    visible_scene,
)
from amers.services.formats.archives import (
    HEAD_BYTES,
    ArchiveLimits,
    check_archive,
    is_archive,
    unpack_archive,
)
from amers.services.formats.sensor_models.product_documents import without_tile
from amers.services.formats.sensor_models.product_files import IMAGE_SUFFIXES, whole_product

PURPOSES: tuple[UploadPurpose, ...] = ("image", "model", "block")
UPLOAD_PREFIX = "upload-"
"""Beginning of the names of unfinished files of uploads in the scratch folder."""


class Busy(AmersError):
    """Another request is sending to this upload."""


class WrongChecksum(AmersError):
    """A piece does not have the announced checksum; it was discarded."""


@dataclass(frozen=True)
class NewUpload:
    """A file that a sender announces.

    Attributes:
        name: as the sender calls the file; folders in it are ignored.
        size_bytes: of the whole file.
        purpose: None means "model" with a scene, else "image".
        scene: id of the scene that a model belongs to.
        sha256: of the whole file, in hexadecimal; None is not checked.
        sigma_m: accuracy of the model of an image, metres.
        metadata: the announcement as sent, returned on request.
    """

    name: str
    size_bytes: int
    purpose: UploadPurpose | None = None
    scene: UUID | None = None
    sha256: str | None = None
    sigma_m: float | None = None
    metadata: str = ""


@dataclass(frozen=True)
class Checksum:
    """The announced checksum of a piece.

    Attributes:
        algorithm: name of a hashlib algorithm.
        digest: expected.
    """

    algorithm: str
    digest: bytes


@dataclass(frozen=True)
class Piece:
    """A part of a file.

    Attributes:
        start: position of its first byte in the file.
        chunks: its bytes.
        checksum: None is not checked.
    """

    start: int
    chunks: Iterable[bytes]
    checksum: Checksum | None = None


def create_upload(
    connection: Connection, storage: Storage, settings: Settings, caller: Token, new: NewUpload
) -> UploadRow:
    """Create an upload; that of an image also creates the scene.

    Raises:
        NotAllowed: the caller's token lacks the scope.
        TooLarge: the announced size exceeds the limit or the quota of the owner.
        TooMany: the owner has as many open uploads, or the scene as many files, as are allowed.
        InputError, NotFound, Conflict: name, purpose or scene cannot be used.
    """
    purpose: UploadPurpose = new.purpose or ("image" if new.scene is None else "model")
    require(caller, Scope.ADMIN if purpose == "block" else Scope.REGISTER)
    limit = side_file_limit(settings, new.name) if purpose == "model" else settings.upload_limit_bytes
    if new.size_bytes > limit:
        raise TooLarge(f"{new.name[-200:]}: {new.size_bytes} bytes announced, at most {limit} accepted")
    file_name, scene_id, owner = clean_name(new.name), new.scene, caller.id
    if purpose == "model":
        if scene_id is None:
            raise InputError("scene: missing; a model needs the id of the scene it belongs to")
        scene = visible_scene(connection, caller, scene_id)
        file_name, owner = side_file_name(scene, new.name), scene.owner or caller.id
    elif purpose == "image" and scene_id is not None:
        raise InputError("scene: not expected; the upload of an image creates a new scene")
    quotas.require_free_upload(connection, settings, owner)
    quotas.require_room(connection, settings, owner, file_name, new.size_bytes)
    if purpose == "image":
        scene_id = scenes.begin_upload(
            connection, caller.id, new.name[-200:], file_name, sigma_m=new.sigma_m
        )
    announced = AnnouncedFile(
        owner=owner,
        purpose=purpose,
        scene_id=None if purpose == "block" else scene_id,
        name=new.name[-200:],
        file_name=file_name,
        size_bytes=new.size_bytes,
        sha256=new.sha256,
        metadata=new.metadata,
    )
    upload = uploads.insert_upload(connection, announced)
    with storage.proven():
        _path(storage, upload.id).touch(mode=0o600, exist_ok=False)
    return upload


def find_upload(connection: Connection, caller: Token, upload_id: UUID) -> UploadRow:
    """The upload, for its owner or an administrator.

    Raises:
        NotFound: there is none, it has expired, or the caller may not see it; the message does not say
            which.
    """
    upload = uploads.find_upload(connection, upload_id)
    if upload is None or upload.expired or not may_access(caller, upload.owner):
        raise NotFound(f"no upload {upload_id}")
    return upload


def received_bytes(storage: Storage, upload: UploadRow) -> int:
    """The number of bytes of an upload that have arrived.

    Raises:
        NotFound: this machine has no file of the upload.
    """
    if upload.finished_at is not None:
        return upload.size_bytes
    try:
        with storage.proven():
            return _path(storage, upload.id).stat().st_size
    except FileNotFoundError:
        raise _missing_file(upload.id) from None


def append_piece(installation: Installation, upload: UploadRow, piece: Piece) -> int:
    """Append a piece to an upload; the last piece completes it and stores the file.

    When the connection breaks, the bytes that arrived stay, unless the piece has a checksum. The bytes
    stay too until the transaction that completes the upload is committed: after a failure, an empty
    piece at the end of the file completes it again.

    Returns:
        The number of bytes of the file that have arrived.

    Raises:
        Busy: another request is sending to the upload.
        Conflict: the piece does not start where the received bytes end.
        WrongChecksum: the piece does not have the announced checksum.
        TooLarge: the piece exceeds the announced size of the file.
        InputError: the complete file cannot be used; it is deleted.
    """
    path = _path(installation.storage, upload.id)
    with installation.storage.proven(), _locked(path, upload.id) as file:
        received = file.seek(0, os.SEEK_END)
        if piece.start != received:
            raise Conflict(
                f"the piece starts at byte {piece.start}, but {received} bytes have arrived; "
                f"continue from byte {received}"
            )
        with installation.storage.proven():
            _append(file, piece, upload.size_bytes)
        received = file.tell()
        with installation.database.transaction() as connection:
            if uploads.prolong(connection, upload.id) is None:
                raise NotFound(f"no upload {upload.id}")
        if received == upload.size_bytes:
            _complete(installation, upload, path)
    return received


def terminate_upload(connection: Connection, storage: Storage, upload: UploadRow) -> None:
    """Delete an incomplete upload with the bytes that have arrived.

    Raises:
        Conflict: the upload is complete.
    """
    if upload.finished_at is not None:
        raise Conflict(f"upload {upload.id} is complete: remove its scene instead")
    _delete_row(connection, upload)
    with storage.proven():
        _path(storage, upload.id).unlink(missing_ok=True)


def remove_abandoned_uploads(database: Database, storage: Storage) -> list[str]:
    """Delete the expired uploads and their files; returns the names of the deleted files.

    Rows are written before files, so a file without a row belongs to a deleted upload.
    """
    with database.transaction() as connection:
        uploads.delete_expired(connection)
    files = arriving_files(storage)
    with database.transaction() as connection:
        arriving = uploads.arriving(connection, list(files))
    abandoned = [path for upload_id, path in files.items() if upload_id not in arriving]
    with storage.proven():
        for path in abandoned:
            path.unlink(missing_ok=True)
    return [path.name for path in abandoned]


def arriving_files(storage: Storage) -> dict[UUID, Path]:
    """The files of incomplete uploads on this machine, by the ids of their uploads."""
    paths = storage.unfinished(UPLOAD_PREFIX)
    return {UUID(path.name.removeprefix(UPLOAD_PREFIX)): path for path in paths}


def _path(storage: Storage, upload_id: UUID) -> Path:
    return storage.scratch() / f"{UPLOAD_PREFIX}{upload_id}"


def _missing_file(upload_id: UUID) -> NotFound:
    return NotFound(f"upload {upload_id}: its file is not on this machine; start a new upload")


@contextmanager
def _locked(path: Path, upload_id: UUID) -> Iterator[IO[bytes]]:
    """The file of an upload, locked for one sender; the kernel releases the lock of a killed process."""
    try:
        file = path.open("r+b", buffering=0)
    except FileNotFoundError:
        raise _missing_file(upload_id) from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Busy(f"another request is sending to upload {upload_id}; try again later") from None
        yield file


def _append(file: IO[bytes], piece: Piece, size_bytes: int) -> None:
    """Write a piece; whatever ends it, a piece with a wrong or unchecked checksum leaves nothing."""
    checksum = piece.checksum
    digest = hashlib.new(checksum.algorithm) if checksum else None
    is_complete = False
    try:
        for chunk in piece.chunks:
            if file.tell() + len(chunk) > size_bytes:
                raise TooLarge(f"the piece exceeds the announced size of {size_bytes} bytes")
            if digest is not None:
                digest.update(chunk)
            rest = memoryview(chunk)
            while rest:
                rest = rest[file.write(rest) :]
        is_complete = True
    finally:
        is_right = checksum is None or (
            is_complete and digest is not None and digest.digest() == checksum.digest
        )
        if not is_right:
            file.truncate(piece.start)
            file.seek(piece.start)
        os.fsync(file.fileno())
    if not is_right:
        raise WrongChecksum(
            f"the piece from byte {piece.start} does not have the announced checksum; send it again"
        )


def _complete(installation: Installation, upload: UploadRow, path: Path) -> None:
    """Store a complete file and delete it from the scratch folder; delete it too if it cannot be used.

    The file in the scratch folder is deleted after the commit. Until then every step can be repeated.
    """
    database, storage = installation.database, installation.storage
    try:
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        if upload.sha256 not in (None, sha256):
            raise InputError(f"sha256 {upload.sha256} announced, {sha256} received")
        if upload.purpose == "image":
            _complete_image(installation, upload, path, sha256)
        elif upload.purpose == "model":
            assert upload.scene_id is not None
            with database.transaction() as connection:
                scenes.drop_model(connection, upload.scene_id, upload.file_name)
            storage.link(path, f"{folder_of(upload.scene_id)}/{upload.file_name}")
            with database.transaction() as connection:
                record_side_file(
                    connection, upload.scene_id, upload.file_name, upload.size_bytes, sha256
                )
                uploads.finish(connection, upload.id)
        else:
            key = block_key(upload)
            storage.link(path, key)
            with database.transaction() as connection:
                uploads.finish(connection, upload.id, key, sha256=sha256)
    except AmersError:
        with database.transaction() as connection:
            _delete_row(connection, upload)
        path.unlink(missing_ok=True)
        raise
    path.unlink(missing_ok=True)


def _delete_row(connection: Connection, upload: UploadRow) -> None:
    """Delete the row of an upload, and the scene that the upload of an image created."""
    uploads.delete_upload(connection, upload.id)
    if upload.purpose == "image" and upload.scene_id is not None:
        scenes.give_up_upload(connection, upload.scene_id)


def _complete_image(installation: Installation, upload: UploadRow, path: Path, sha256: str) -> None:
    """Store an image, or the image and the models of an archive, in the folder of the scene."""
    assert upload.scene_id is not None
    storage = installation.storage
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    with storage.scratch_folder("unpacked-") as folder:
        models: list[Path] = []
        image, name = path, upload.file_name
        if is_archive(head):
            image, models = _unpack(installation, upload, path, folder)
            name = image.name
            with image.open("rb") as file:
                head = file.read(HEAD_BYTES)
                file.seek(0)
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        require_image_signature(head)
        size_bytes = image.stat().st_size
        model_files = [(model.name, model.stat().st_size, _file_sha256(model)) for model in models]
        for source in [*models, image]:
            file_name = name if source == path else source.name
            storage.link(source, f"{folder_of(upload.scene_id)}/{file_name}")
    key = f"{folder_of(upload.scene_id)}/{name}"
    with installation.database.transaction() as connection:
        if scenes.finish_upload(connection, upload.scene_id, key, size_bytes, sha256) is None:
            raise Conflict(f"upload {upload.id} took too long and has expired; start a new one")
        for model in model_files:
            record_side_file(connection, upload.scene_id, *model)
        uploads.finish(connection, upload.id)


def _file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _unpack(
    installation: Installation, upload: UploadRow, archive: Path, folder: Path
) -> tuple[Path, list[Path]]:
    """Unpack the image of an archive, and the files beside it, into a folder; returns their paths.

    An image in several tiles is the first tile, beside which the others are.

    What the archive declares to unpack to is reserved from the owner's quota first.

    Raises:
        FormatError: the archive is damaged or contains what is not allowed.
        InputError: it does not contain exactly one image, or two files would get the same name.
        TooLarge: the files exceed what is left of the owner's quota.
    """
    settings = installation.settings
    limits = ArchiveLimits(settings.upload_limit_bytes)
    members = check_archive(archive, limits)
    paths = sorted(member.path for member in members)
    images = [path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES]
    wholes = {(path.parent, without_tile(path.stem)) for path in images}
    if len(wholes) != 1:
        names = ", ".join(str(path) for path in images[:5]) or "none"
        raise InputError(
            f"the archive contains {len(images)} images ({names}), exactly one is expected, or the "
            "tiles of one product"
        )
    models = images[1:] + [
        member.path
        for member in members
        if member.path.parent == images[0].parent
        and member.path.suffix.lower() in MODEL_SUFFIXES
        and member.size_bytes <= SIDE_FILE_LIMIT_BYTES
    ]
    targets: dict[PurePosixPath, Path] = {
        path: folder / clean_name(path.name) for path in (images[0], *models)
    }
    if len(set(targets.values())) < len(targets):
        raise InputError(
            "two files of the archive get the same name once unusual letters are replaced; rename one"
        )
    unpacked_bytes = sum(member.size_bytes for member in members if member.path in targets)
    # The row of the upload counts as many bytes as the archive has, and ends with it.
    more_bytes = max(unpacked_bytes - upload.size_bytes, 0)
    if upload.owner is not None and upload.scene_id is not None and more_bytes > 0:
        with installation.database.transaction() as connection:
            what = f"{upload.file_name}, unpacked to {unpacked_bytes} bytes"
            quotas.require_room(connection, settings, upload.owner, what, more_bytes)
            scenes.reserve(connection, upload.scene_id, more_bytes)
    unpack_archive(archive, targets, ArchiveLimits(max(unpacked_bytes, 1)))
    if len(images) > 1 and whole_product(targets[images[0]]) == targets[images[0]]:
        raise InputError(
            f"the archive contains {len(images)} images, exactly one is expected, or all tiles of one "
            "product with the document that lists them (DIM_….XML, .TIL)"
        )
    return targets[images[0]], [targets[path] for path in models]
