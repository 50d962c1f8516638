"""Used storage by owner, and the files without an owner."""

from dataclasses import dataclass
from uuid import UUID

from amers.app.config import Settings
from amers.app.db import tokens, usage
from amers.app.db.engine import Connection
from amers.app.db.tokens import Token
from amers.app.db.usage import Usage
from amers.app.storage import Storage
from amers.app.storage.trash import TRASH
from amers.app.usecases import garbage_collection
from amers.app.usecases.quotas import storage_quota

COMMAND_LINE = "the command line"


@dataclass(frozen=True)
class OwnerUsage:
    """What one owner keeps, and his quota.

    Attributes:
        owner: id of the token; None for the command line.
        name: of the token.
        scenes, open_uploads, jobs: numbers of rows.
        scene_bytes, upload_bytes, result_bytes: with what is reserved for files that arrive.
        total_bytes: the sum of the three.
        quota_bytes: storage quota; None for the command line.
        share: of the quota that is used; None without a quota or for a quota of 0.
    """

    owner: UUID | None
    name: str
    scenes: int
    open_uploads: int
    jobs: int
    scene_bytes: int
    upload_bytes: int
    result_bytes: int
    total_bytes: int
    quota_bytes: int | None
    share: float | None


@dataclass(frozen=True)
class UnownedFiles:
    """Files of the storage that count for no owner.

    Attributes:
        what: kind of the files.
    """

    what: str
    files: int
    total_bytes: int


def read_usage(connection: Connection, settings: Settings, token: Token) -> OwnerUsage:
    """What a token keeps."""
    return _owner_usage(settings, usage.read_usage(connection, token.id), token)


def read_all_usage(connection: Connection, settings: Settings) -> list[OwnerUsage]:
    """What every owner keeps who keeps something, the largest first."""
    token_of = {token.id: token for token in tokens.list_tokens(connection)}
    rows = [
        _owner_usage(settings, row, None if row.owner is None else token_of[row.owner])
        for row in usage.read_all_usage(connection)
    ]
    return sorted(rows, key=lambda row: row.total_bytes, reverse=True)


def read_unowned(connection: Connection, storage: Storage) -> list[UnownedFiles]:
    """The files that count for nobody: chips, trash, unfinished files, and files without a row.

    Lists the whole storage.
    """
    families = garbage_collection.compare_files(connection, storage)
    without_row = [key for family in families for key in (*family.given_up, *family.unknown)]
    stored = {name: storage.sizes(name) for name in ("chips", "scenes", "results", "uploads", TRASH)}
    size_of = {key: size for sizes in stored.values() for key, size in sizes.items()}
    chips = stored["chips"].keys() - set(without_row)
    unfinished = [
        path.stat().st_size
        for top in storage.unfinished("")
        for path in (top, *top.rglob("*"))
        if path.is_file()
    ]
    return [
        UnownedFiles("chips of blocks", len(chips), sum(size_of[key] for key in chips)),
        UnownedFiles("trash", len(stored[TRASH]), sum(stored[TRASH].values())),
        UnownedFiles("unfinished", len(unfinished), sum(unfinished)),
        UnownedFiles("no row", len(without_row), sum(size_of.get(key, 0) for key in without_row)),
    ]


def _owner_usage(settings: Settings, row: Usage, token: Token | None) -> OwnerUsage:
    quota = None if token is None else storage_quota(settings, token)
    return OwnerUsage(
        name=COMMAND_LINE if token is None else token.name,
        total_bytes=row.total_bytes,
        quota_bytes=quota,
        share=row.total_bytes / quota if quota else None,
        **vars(row),
    )
