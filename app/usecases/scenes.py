"""Upload, list and remove scenes and their files."""

import logging
import re
import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from uuid import UUID

from amers.app.auth import may_access, owner_filter
from amers.app.config import Settings
from amers.app.db import scenes, uploads
from amers.app.db.engine import Connection
from amers.app.db.scene_registrations import SceneRegistration, last_registrations
from amers.app.db.scenes import SceneRow
from amers.app.db.tokens import Token
from amers.app.db.uploads import AnnouncedFile
from amers.app.errors import Conflict, InputError, NotFound, StorageOutage, TooLarge, TooMany
from amers.app.storage import Storage, StoredFile, Writing
from amers.app.usecases import quotas
from amers.app.usecases.damage import named_by_row
from amers.app.usecases.installation import Installation
from amers.app.usecases.server_files import file_below
from amers.services.errors import FormatError
from amers.services.formats.images.signatures import DRIVER_OF_SIGNATURE
from amers.services.formats.sensor_models.product_documents import is_document, read_product
from amers.services.formats.sensor_models.product_files import tile_file, whole_product

LONGEST_NAME = 120
LONGEST_SIGNATURE = max(len(signature) for signature in DRIVER_OF_SIGNATURE)
MODEL_SUFFIXES = (
    *(".txt", ".xml", ".rpb", ".rpc", ".geom"),
    *(".dim", ".til", ".imd", ".tfw", ".j2w", ".prj"),
)
"""Models, and what places an image in a product or on a map."""
MARK_SUFFIXES = (".geojson", ".json", ".gcp", ".points", ".pts", ".csv")
RASTER_SUFFIXES = (".tif", ".tiff", ".jp2", ".ntf", ".nitf", ".msk", ".gtx")
"""Terrains, masks, geoid grids and other tiles of the image: they may be as large as images."""
VECTOR_SUFFIXES = (".fgb",)
"""Vectors in a format of their own; they may be GeoJSON too."""
SIDE_FILE_SUFFIXES = MODEL_SUFFIXES + MARK_SUFFIXES + RASTER_SUFFIXES + VECTOR_SUFFIXES
SIDE_FILE_LIMIT_BYTES = 16 << 20
"""Largest file with a model, with check points or with vectors."""
MOST_SIDE_FILES = 100
"""Largest number of files beside one image."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SentFile:
    """A file in the body of a request.

    Attributes:
        name: as the sender calls it; folders in it are ignored.
        chunks: the bytes.
        size_bytes, sha256: as announced, and checked; None when not announced.
    """

    name: str
    chunks: Iterable[bytes]
    size_bytes: int | None = None
    sha256: str | None = None


def upload_scene(
    installation: Installation, owner: Token, sent: SentFile, sigma_m: float | None = None
) -> SceneRow:
    """Store the image of a new scene; the job that uses the image checks its content.

    No transaction is open while the bytes arrive. A failed upload leaves nothing behind.

    Args:
        installation: receives the scene.
        owner: of the scene.
        sent: the image.
        sigma_m: accuracy of the scene's model as the sender states it, metres.

    Raises:
        StorageOutage: the storage is away, or is not that of the installation.
        TooLarge: the image exceeds the limit or the owner's quota.
        FormatError: the first bytes are not those of a TIFF, JPEG 2000 or NITF file.
        InputError: the name cannot be used, or size or checksum are not as announced.
    """
    database, storage = installation.database, installation.storage
    limit = installation.settings.upload_limit_bytes
    file_name = clean_name(sent.name)
    storage.prove()
    _refuse_too_large(sent, limit)
    with database.transaction() as connection:
        left = quotas.require_room(
            connection, installation.settings, owner.id, "the image", sent.size_bytes
        )
        # An image of unknown size reserves the most that it may have until it has arrived.
        limit = min(left, limit)
        scene_id = scenes.begin_upload(
            connection,
            owner.id,
            sent.name[-200:],
            file_name,
            sigma_m=sigma_m,
            announced_bytes=limit if sent.size_bytes is None else sent.size_bytes,
        )
    key = f"{folder_of(scene_id)}/{file_name}"
    try:
        with _receiving(storage, key, sent, _images_only(sent.chunks), limit) as image:
            pass
        with database.transaction() as connection:
            row = scenes.finish_upload(connection, scene_id, key, image.size_bytes, image.sha256)
        if row is None:
            raise Conflict(
                f"the upload of scene {scene_id} took too long and has expired; send it again"
            )
        return row
    except BaseException:
        with database.transaction() as connection:
            scenes.give_up_upload(connection, scene_id)
            is_stored = scenes.find_scene(connection, scene_id) is not None
        # A commit whose confirmation was lost has stored the scene: its image must stay. After an
        # outage of the storage, garbage collection deletes what is left.
        if not is_stored:
            with suppress(StorageOutage):
                storage.delete(key)
        raise


def upload_side_file(
    installation: Installation, caller: Token, scene_id: UUID, sent: SentFile
) -> StoredFile:
    """Store a file beside the image of a scene; it replaces a file of the same name.

    A row never describes other bytes than the storage has: the record of the former file is deleted
    first. After a failure there is no such file, or the former one, until the request is repeated.

    Raises:
        NotFound: there is no such scene, or the caller may not see it.
        Conflict: the scene's files were removed, or lie on the server.
        InputError: files of this kind do not belong beside an image.
        TooLarge: the file exceeds the limit or the quota of the scene's owner.
        TooMany: the scene has as many files as are allowed.
    """
    database, settings = installation.database, installation.settings
    installation.storage.prove()
    with database.transaction() as connection:
        scene = visible_scene(connection, caller, scene_id)
        file_name = side_file_name(scene, sent.name)
        limit = side_file_limit(settings, file_name)
        _refuse_too_large(sent, limit)
        owner = scene.owner or caller.id
        left = quotas.require_room(connection, settings, owner, file_name, sent.size_bytes)
        # A file of unknown size reserves the most that it may have until it has arrived.
        limit = min(left, limit)
        reserved = AnnouncedFile(
            owner=owner,
            purpose="model",
            scene_id=scene_id,
            name=sent.name[-200:],
            file_name=file_name,
            size_bytes=sent.size_bytes or limit,
            sha256=None,
            metadata="",
        )
        upload = uploads.insert_upload(connection, reserved)
    key = f"{folder_of(scene_id)}/{file_name}"
    try:
        with (
            _receiving(installation.storage, key, sent, sent.chunks, limit) as writing,
            database.transaction() as connection,
        ):
            scenes.drop_model(connection, scene_id, file_name)
        try:
            with database.transaction() as connection:
                record_side_file(connection, scene_id, file_name, writing.size_bytes, writing.sha256)
        except BaseException:
            with database.transaction() as connection:
                present = scenes.find_scene(connection, scene_id)
            if present is None or file_name not in present.models:
                with suppress(StorageOutage):
                    installation.storage.delete(key)
            raise
    finally:
        with database.transaction() as connection:
            uploads.delete_upload(connection, upload.id)
    return StoredFile(key, writing.size_bytes, writing.sha256)


def side_file_limit(settings: Settings, file_name: str) -> int:
    """The size limit of a file beside an image, bytes."""
    is_raster = file_name.lower().endswith(RASTER_SUFFIXES)
    return settings.upload_limit_bytes if is_raster else SIDE_FILE_LIMIT_BYTES


def side_file_name(scene: SceneRow, name: str) -> str:
    """The stored name of a file beside an image: a model, terrain, mask, check points or vectors.

    Raises:
        Conflict: the scene's files were removed or lie on the server, or the name is that of the image.
        InputError: files of this kind do not belong beside an image.
        TooMany: the scene has as many files as are allowed.
    """
    file_name = clean_name(name)
    if scene.state == "removed":
        raise Conflict(f"{file_name}: the files of scene {scene.id} were removed")
    if scene.reference is not None:
        raise Conflict(
            f"{file_name}: the files of scene {scene.id} are in a folder of the server; put this file "
            "there"
        )
    if not file_name.lower().endswith(SIDE_FILE_SUFFIXES):
        raise InputError(
            f"{file_name}: unexpected suffix; a file that accompanies an image has one of "
            f"{', '.join(SIDE_FILE_SUFFIXES)}"
        )
    if file_name == scene.file_name:
        raise Conflict(f"{file_name} is the image of the scene; choose another name")
    if len(scene.models) >= MOST_SIDE_FILES and file_name not in scene.models:
        raise TooMany(
            f"{file_name}: scene {scene.id} has {len(scene.models)} files in addition to its image, the "
            "largest number allowed; send it under the name of a file that it replaces"
        )
    return file_name


def record_side_file(
    connection: Connection, scene_id: UUID, file_name: str, size_bytes: int, sha256: str
) -> None:
    """Add a stored file to the row of its scene.

    Raises:
        Conflict: the scene was removed meanwhile; garbage collection deletes the file.
    """
    if not scenes.add_model(connection, scene_id, file_name, size_bytes, sha256):
        raise Conflict(f"scene {scene_id} was removed while {file_name} was uploaded")


def add_server_scene(
    connection: Connection, settings: Settings, owner: Token, path: str, sigma_m: float | None = None
) -> SceneRow:
    """Create a scene whose image stays on the server, below AMERS_SCENE_FOLDER.

    Raises:
        InputError: AMERS_SCENE_FOLDER is not set, or has no such image.
    """
    image = server_image(settings, path)
    assert settings.scene_folder is not None
    relative = image.relative_to(settings.scene_folder.resolve()).as_posix()
    return scenes.insert_reference(connection, owner.id, image.name, relative, sigma_m)


def server_image(settings: Settings, path: str) -> Path:
    """The image of a scene below AMERS_SCENE_FOLDER, or the document of a product in tiles.

    Raises:
        InputError: AMERS_SCENE_FOLDER is not set, or has no such image.
    """
    if settings.scene_folder is None:
        raise InputError(
            "path: scenes on the server cannot be used, because AMERS_SCENE_FOLDER is not set; "
            "upload the image instead"
        )
    image = file_below(settings.scene_folder, path, "path", "AMERS_SCENE_FOLDER")
    first = tile_file(read_product(image)[0]) if is_document(image) else image
    if not isinstance(first, Path) or not first.is_file():
        raise InputError(f"path: {image.name} lists {first.name}, which is not beside it")
    with first.open("rb") as file:
        require_image_signature(file.read(LONGEST_SIGNATURE))
    return image


def local_image(storage: Storage, settings: Settings, scene: SceneRow, scratch: Path) -> Path:
    """The path of a scene's image on this machine, with its other files in the same folder.

    Of a scene whose files are all tiles of a product, it is the path of the product's document.

    Args:
        storage, settings: of the installation.
        scene: the scene.
        scratch: a folder of the caller's, for copies of files that lie in a bucket.

    Raises:
        Conflict: the scene has no files.
        InputError: the image of a scene on the server is no longer in its place.
        DamagedFile: a file of the scene is missing from the storage.
    """
    if scene.reference is not None and scene.state != "removed":
        return whole_product(server_image(settings, scene.reference))
    if scene.file_key is None:
        raise Conflict(f"scene {scene.id} was removed, or its image has not arrived yet")
    image, *beside = stored_keys(scene)
    for key in beside:
        with named_by_row(key):
            storage.fetch(key, scratch)
    with named_by_row(image):
        return whole_product(storage.fetch(image, scratch))


def stored_keys(scene: SceneRow) -> list[str]:
    """The storage keys of the files of a scene, the image first; none if they lie on the server."""
    if scene.file_key is None:
        return []
    return [scene.file_key, *(f"{folder_of(scene.id)}/{name}" for name in scene.models)]


def visible_scene(connection: Connection, caller: Token, scene_id: UUID) -> SceneRow:
    """The scene, for its owner or an administrator.

    Raises:
        NotFound: there is none, or the caller may not see it; the message does not say which.
    """
    scene = scenes.find_scene(connection, scene_id)
    if scene is None or not may_access(caller, scene.owner):
        raise NotFound(f"no scene {scene_id}")
    return scene


def file_key(connection: Connection, caller: Token, scene_id: UUID, name: str) -> str:
    """The storage key of a file of a scene.

    Raises:
        NotFound: there is no such scene or file, or the caller may not see it.
    """
    scene = visible_scene(connection, caller, scene_id)
    names = {*scene.models, *([scene.file_name] if scene.file_key else [])}
    if scene.state == "removed" or scene.reference is not None or name not in names:
        raise NotFound(f"scene {scene_id} has no file {name:.100} in the storage")
    return f"{folder_of(scene_id)}/{name}"


def list_scenes(
    connection: Connection, caller: Token, limit: int, after: UUID | None = None
) -> list[SceneRow]:
    """The caller's newest scenes, or those that follow scene `after`; administrators see all scenes.

    Raises:
        NotFound: the caller may not see the scene `after`.
    """
    if after is not None:
        visible_scene(connection, caller, after)
    return scenes.newest_scenes(connection, owner_filter(caller), limit, after)


def registrations_of(
    connection: Connection, caller: Token, rows: list[SceneRow], most: int
) -> dict[UUID, list[SceneRegistration]]:
    """The last registrations of scenes that the caller may see, the newest first."""
    return last_registrations(connection, [row.id for row in rows], caller.id, most)


def remove_scene(connection: Connection, caller: Token, scene_id: UUID) -> None:
    """Mark a scene as removed; its row and the results of its jobs stay.

    `delete_files` deletes its files once the transaction is committed: rows go before files.

    Raises:
        NotFound: there is no such scene, or the caller may not see it.
        Conflict: its image is still being uploaded.
    """
    scene = visible_scene(connection, caller, scene_id)
    if scene.state == "uploading":
        raise Conflict(
            f"the image of scene {scene_id} is still being uploaded; delete the upload instead"
        )
    scenes.remove_scene(connection, scene_id)


def delete_files(storage: Storage, scene_id: UUID) -> None:
    """Delete the files of a removed scene; what an outage leaves is removed by the sweep."""
    try:
        for key in storage.keys(folder_of(scene_id)):
            storage.delete(key)
    except (StorageOutage, OSError) as outage:
        log.warning("scene %s: the sweep has to delete its files: %s", scene_id, outage)


def folder_of(scene_id: UUID) -> str:
    """The key prefix of the files of a scene in the storage."""
    return f"scenes/{scene_id}"


def clean_name(name: str) -> str:
    """A file name without folders, in characters that every file system and the storage accept.

    Raises:
        InputError: no usable character is left.
    """
    last = re.split(r"[/\\]", name)[-1]
    plain = unicodedata.normalize("NFKD", last).encode("ascii", "ignore").decode()
    clean = re.sub(r"[^A-Za-z0-9_.-]+", "_", plain)[-LONGEST_NAME:].lstrip(".-")
    if not clean.strip("_."):
        raise InputError(
            f"{name[:LONGEST_NAME]!r} is not the name of a file; expected letters, digits, . _ or -"
        )
    return clean


def require_image_signature(head: bytes) -> None:
    """Refuse a file whose first bytes are not those of an image.

    Raises:
        FormatError: they are not those of a TIFF, JPEG 2000 or NITF file.
    """
    if not head.startswith(tuple(DRIVER_OF_SIGNATURE)):
        raise FormatError(f"the file begins with {head[:8]!r}: it is neither TIFF, JPEG 2000 nor NITF")


def _refuse_too_large(sent: SentFile, limit_bytes: int) -> None:
    if sent.size_bytes is not None and sent.size_bytes > limit_bytes:
        raise TooLarge(f"{sent.size_bytes} bytes announced, at most {limit_bytes} accepted")


@contextmanager
def _receiving(
    storage: Storage, key: str, sent: SentFile, chunks: Iterable[bytes], limit_bytes: int
) -> Iterator[Writing]:
    """Receive a file and check size and checksum; it gets its key at the end of the context."""
    with storage.writing(key, limit_bytes) as writing:
        for chunk in chunks:
            writing.write(chunk)
        if sent.size_bytes not in (None, writing.size_bytes):
            raise InputError(f"{sent.size_bytes} bytes announced, {writing.size_bytes} received")
        if sent.sha256 not in (None, writing.sha256):
            raise InputError(f"sha256 {sent.sha256} announced, {writing.sha256} received")
        yield writing


def _images_only(chunks: Iterable[bytes]) -> Iterator[bytes]:
    """The same bytes, after a check that they begin like an image."""
    head = b""
    rest = iter(chunks)
    for chunk in rest:
        head += chunk
        if len(head) >= LONGEST_SIGNATURE:
            break
    require_image_signature(head)
    yield head
    yield from rest
