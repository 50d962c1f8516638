"""Uploading, showing and removing scenes."""

import re
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

from app.auth import is_administrator, may_access
from app.config import Settings
from app.db import scenes
from app.db.engine import Connection, Database
from app.db.scenes import SceneRow
from app.db.tokens import Token
from app.errors import Conflict, InputError, NotFound, StorageOutage, TooLarge
from app.storage import Storage, StoredFile
from app.usecases import quotas
from app.usecases.server_files import file_below
from services.errors import FormatError
from services.formats.images.raster import DRIVER_OF_SIGNATURE

LONGEST_NAME = 120
LONGEST_SIGNATURE = max(len(signature) for signature in DRIVER_OF_SIGNATURE)
MODEL_SUFFIXES = (".txt", ".xml", ".rpb", ".rpc")
MARK_SUFFIXES = (".geojson", ".json", ".gcp", ".points", ".pts")
RASTER_SUFFIXES = (".tif", ".tiff", ".jp2", ".gtx")
"""Terrains, masks and geoids, which are as large as images."""
BESIDE_SUFFIXES = MODEL_SUFFIXES + MARK_SUFFIXES + RASTER_SUFFIXES
MODEL_LIMIT_BYTES = 16 << 20
"""Also of marks."""


@dataclass(frozen=True)
class Upload:
    """A file on its way, as its sender announces it.

    Attributes:
        name: as the sender calls it; folders in it mean nothing.
        chunks: the bytes.
        size_bytes, sha256: None when not announced; checked when they are.
    """

    name: str
    chunks: Iterable[bytes]
    size_bytes: int | None = None
    sha256: str | None = None


def upload_scene(
    database: Database,
    storage: Storage,
    settings: Settings,
    owner: Token,
    upload: Upload,
    sigma_m: float | None = None,
) -> SceneRow:
    """Take in the image of a new scene; it is looked into by the job that uses it, not here.

    No transaction is open while the bytes arrive. Whatever goes wrong, nothing is left behind.

    Args:
        sigma_m: accuracy of the scene's model as the sender states it, metres.

    Raises:
        TooLarge: more bytes than the limit or the quota of the owner, announced or sent.
        FormatError: neither a TIFF, a JPEG 2000 nor a NITF by its first bytes.
        InputError: the name is none, or size or checksum are not as announced.
    """
    file_name = clean_name(upload.name)
    _refuse_too_large(upload, settings.upload_limit_bytes)
    with database.transaction() as connection:
        left = quotas.upload_allowance(connection, settings, owner, upload.size_bytes)
        scene_id = scenes.begin_upload(
            connection, owner.id, upload.name[-200:], file_name, sigma_m, upload.size_bytes
        )
    limit_bytes = min(left, settings.upload_limit_bytes)
    key = f"{folder_of(scene_id)}/{file_name}"
    try:
        image = _receive(storage, key, upload, _images_only(upload.chunks), limit_bytes)
        with database.transaction() as connection:
            row = scenes.finish_upload(connection, scene_id, key, image.size_bytes, image.sha256)
        if row is None:
            raise Conflict("the upload took so long that it was given up")
        return row
    except BaseException:
        with database.transaction() as connection:
            scenes.give_up_upload(connection, scene_id)
        # What an outage leaves is swept.
        with suppress(StorageOutage):
            storage.delete(key)
        raise


def upload_beside(
    database: Database,
    storage: Storage,
    settings: Settings,
    caller: Token,
    scene_id: UUID,
    upload: Upload,
) -> StoredFile:
    """Lay a file beside the image of a scene, in place of one of the same name.

    Raises:
        NotFound: no such scene, or not the caller's.
        Conflict: the scene has no files any more, or not yet.
        InputError: not a kind of file that belongs there.
        TooLarge: more bytes than such files, or the caller, may have.
    """
    with database.transaction() as connection:
        file_name = name_beside(visible_scene(connection, caller, scene_id), upload.name)
        limit_bytes = limit_beside(settings, file_name)
        _refuse_too_large(upload, limit_bytes)
        left = quotas.upload_allowance(connection, settings, caller, upload.size_bytes)
    key = f"{folder_of(scene_id)}/{file_name}"
    stored = _receive(storage, key, upload, upload.chunks, min(limit_bytes, left))
    with database.transaction() as connection:
        note_model(connection, scene_id, file_name, stored.size_bytes, stored.sha256)
    return stored


def limit_beside(settings: Settings, file_name: str) -> int:
    """How large a file beside an image may be, bytes."""
    is_raster = file_name.lower().endswith(RASTER_SUFFIXES)
    return settings.upload_limit_bytes if is_raster else MODEL_LIMIT_BYTES


def name_beside(scene: SceneRow, name: str) -> str:
    """The name under which a file lies beside the image of a scene: model, terrain, mask, check points.

    Raises:
        Conflict: the scene has no files of its own any more, or the name is that of its image.
        InputError: not a kind of file that belongs there.
    """
    file_name = clean_name(name)
    if scene.state == "removed" or scene.reference is not None:
        state = "removed" if scene.reference is None else "where they were before"
        raise Conflict(f"the files of scene {scene.id} are {state}")
    if not file_name.lower().endswith(BESIDE_SUFFIXES):
        raise InputError(
            f"a file beside an image ends in {', '.join(BESIDE_SUFFIXES)}; {file_name} does not"
        )
    if file_name == scene.file_name:
        raise Conflict(f"{file_name} is the image of the scene")
    return file_name


def note_model(
    connection: Connection, scene_id: UUID, file_name: str, size_bytes: int, sha256: str
) -> None:
    """Remember a file that was laid beside an image.

    Raises:
        Conflict: the scene was removed meanwhile; the file is swept.
    """
    if not scenes.add_model(connection, scene_id, file_name, size_bytes, sha256):
        raise Conflict(f"scene {scene_id} was removed meanwhile")


def refer_to_scene(
    connection: Connection, settings: Settings, owner: Token, path: str, sigma_m: float | None = None
) -> SceneRow:
    """Take in a scene that stays where it lies, below the folder the administrator has opened.

    Raises:
        InputError: no folder is open, or the path is not one of a file below it.
    """
    found = referred_image(settings, path)
    assert settings.scene_folder is not None
    relative = found.relative_to(settings.scene_folder.resolve()).as_posix()
    return scenes.insert_reference(connection, owner.id, found.name, relative, sigma_m)


def referred_image(settings: Settings, path: str) -> Path:
    """The file of a scene below AMERS_SCENE_FOLDER.

    Raises:
        InputError: there is no such file there.
    """
    if settings.scene_folder is None:
        raise InputError("scenes on the server cannot be used: AMERS_SCENE_FOLDER is not set")
    found = file_below(settings.scene_folder, path, "path", "AMERS_SCENE_FOLDER")
    with found.open("rb") as file:
        refuse_strange(file.read(LONGEST_SIGNATURE))
    return found


def local_image(storage: Storage, settings: Settings, scene: SceneRow, scratch: Path) -> Path:
    """The image of a scene on this machine, with its models beside it.

    Args:
        scratch: a folder of the caller's, for copies when the storage is elsewhere.

    Raises:
        Conflict: the scene has no files any more.
        InputError: a scene on the server is not where it was.
    """
    if scene.reference is not None and scene.state != "removed":
        return referred_image(settings, scene.reference)
    if scene.file_key is None:
        raise Conflict(f"scene {scene.id} has been removed, or has not arrived yet")
    for key in storage.keys(folder_of(scene.id)):
        if key != scene.file_key:
            storage.fetch(key, scratch)
    return storage.fetch(scene.file_key, scratch)


def visible_scene(connection: Connection, caller: Token, scene_id: UUID) -> SceneRow:
    """The scene, for its owner or an administrator.

    Raises:
        NotFound: there is none, or it is somebody else's: strangers cannot tell which.
    """
    scene = scenes.find_scene(connection, scene_id)
    if scene is None or not may_access(caller, scene.owner):
        raise NotFound(f"no scene {scene_id}")
    return scene


def file_key(connection: Connection, caller: Token, scene_id: UUID, name: str) -> str:
    """Where the storage has a file of a scene.

    Raises:
        NotFound: no such scene or not the caller's, or no such file of it in the storage.
    """
    scene = visible_scene(connection, caller, scene_id)
    names = {*scene.models, *([scene.file_name] if scene.file_key else [])}
    if scene.state == "removed" or scene.reference is not None or name not in names:
        raise NotFound(f"no file {name:.100} of scene {scene_id} in the storage")
    return f"{folder_of(scene_id)}/{name}"


def list_scenes(connection: Connection, caller: Token, limit: int) -> list[SceneRow]:
    """The caller's newest scenes; everybody's for an administrator."""
    return scenes.newest_scenes(connection, None if is_administrator(caller) else caller.id, limit)


def remove_scene(connection: Connection, caller: Token, scene_id: UUID) -> None:
    """Let go of the pixels of a scene; its record and what was made of it stay.

    The files are deleted once this is committed: rows go before files.

    Raises:
        NotFound: no such scene, or not the caller's.
        Conflict: its image is still arriving.
    """
    scene = visible_scene(connection, caller, scene_id)
    if scene.state == "uploading":
        raise Conflict(f"the image of scene {scene_id} is still arriving; its upload can be ended")
    scenes.remove_scene(connection, scene_id)


def delete_files(storage: Storage, scene_id: UUID) -> None:
    """Delete the files of a scene that was removed."""
    for key in storage.keys(folder_of(scene_id)):
        storage.delete(key)


def folder_of(scene_id: UUID) -> str:
    """Where the storage has the files of a scene."""
    return f"scenes/{scene_id}"


def clean_name(name: str) -> str:
    """A file name without folders, in letters that every file system and the storage accept.

    Raises:
        InputError: nothing of the name is left.
    """
    last = re.split(r"[/\\]", name)[-1]
    plain = unicodedata.normalize("NFKD", last).encode("ascii", "ignore").decode()
    clean = re.sub(r"[^A-Za-z0-9_.-]+", "_", plain)[-LONGEST_NAME:].lstrip(".-")
    if not clean.strip("_."):
        raise InputError(f"{name[:LONGEST_NAME]!r} is not the name of a file")
    return clean


def _refuse_too_large(upload: Upload, limit_bytes: int) -> None:
    if upload.size_bytes is not None and upload.size_bytes > limit_bytes:
        raise TooLarge(f"{upload.size_bytes} bytes announced, at most {limit_bytes} are accepted")


def _receive(
    storage: Storage, key: str, upload: Upload, chunks: Iterable[bytes], limit_bytes: int
) -> StoredFile:
    """Store a file that is as announced, or nothing."""
    with storage.writing(key, limit_bytes) as writing:
        for chunk in chunks:
            writing.write(chunk)
        if upload.size_bytes not in (None, writing.size_bytes):
            raise InputError(f"{upload.size_bytes} bytes announced, {writing.size_bytes} received")
        if upload.sha256 not in (None, writing.sha256):
            raise InputError(f"sha256 {upload.sha256} announced, {writing.sha256} received")
    return StoredFile(key, writing.size_bytes, writing.sha256)


def _images_only(chunks: Iterable[bytes]) -> Iterator[bytes]:
    """The same bytes, once the first of them are those of an image."""
    head = b""
    rest = iter(chunks)
    for chunk in rest:
        head += chunk
        if len(head) >= LONGEST_SIGNATURE:
            break
    refuse_strange(head)
    yield head
    yield from rest


def refuse_strange(head: bytes) -> None:
    """Refuse a file that is no image by its first bytes.

    Raises:
        FormatError: it is not.
    """
    if not head.startswith(tuple(DRIVER_OF_SIGNATURE)):
        raise FormatError(f"the file begins with {head[:8]!r}: neither TIFF, JPEG 2000 nor NITF")
