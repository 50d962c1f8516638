"""Models of what administrators see: tokens, references, the audit trail."""

from datetime import datetime
from typing import Literal
from uuid import UUID

from amers.app.api.models.base import JsonObject, Link, Reply
from amers.app.api.models.features import AnyGeometry
from amers.app.auth import Scope


class TokenRecord(Reply):
    """A token without its secret; null quotas are those of the settings."""

    id: UUID
    name: str
    scopes: list[Scope]
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None
    subject: str | None
    storage_quota_bytes: int | None
    job_quota: int | None


class NewTokenRecord(TokenRecord):
    """A new token; this reply alone has its secret."""

    secret: str


class TokenRecords(Reply):
    """Tokens, newest first."""

    tokens: list[TokenRecord]


class OwnerUsage(Reply):
    """What one owner keeps; bytes include what is reserved for files that arrive.

    `owner` and `quota_bytes` are null for the command line, `share` without a quota.
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


class OwnersUsage(Reply):
    """What every owner keeps who keeps something, the largest first."""

    owners: list[OwnerUsage]


class Reference(Reply):
    """A reference image; paths are below AMERS_REFERENCE_FOLDER."""

    id: int
    name: str
    image: str
    dem: str | None
    vertical: str | None
    geoid: str | None
    sigma_m: float | None
    sigma_up_m: float | None
    gsd_m: float
    created_at: datetime
    footprint: AnyGeometry


class References(Reply):
    """Reference images, by name."""

    references: list[Reference]


class InstallationStatus(Reply):
    """The queue and the storage of an installation at this moment.

    `oldest_waiting_s` is 0 when no job waits. The disk is that of the data folder of the API.
    """

    workers: int
    jobs_waiting: int
    jobs_running: int
    oldest_waiting_s: float
    points_served: int
    chip_bytes: int
    database_bytes: int
    disk_free_bytes: int
    disk_total_bytes: int
    damaged_files: int


class ChangeRecord(Reply):
    """A change in the audit trail; `before` or `after` is null where the row did not exist."""

    id: int
    at: datetime
    actor: UUID | None
    actor_name: str
    request_id: str | None
    job_id: UUID | None
    kind: str
    subject: str
    action: Literal["created", "changed", "deleted"]
    before: JsonObject | None
    after: JsonObject | None


class ChangeRecords(Reply):
    """A page of the audit trail, newest first."""

    changes: list[ChangeRecord]
    links: list[Link]
