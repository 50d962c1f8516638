"""Quotas of one token: bytes in the storage, open uploads, and jobs.

Everything that a token makes counts: scenes with the files beside them, uploads under way, archives of
blocks, and results of jobs. Each function locks the token until the end of the transaction, in which the
caller records what it reserves: concurrent requests of one token wait for each other here.
"""

from uuid import UUID

from amers.app.config import Settings
from amers.app.db import tokens, usage
from amers.app.db.engine import Connection
from amers.app.db.jobs import attempts
from amers.app.db.jobs.jobs import Job
from amers.app.db.tokens import Token
from amers.app.errors import TooLarge, TooMany

FREE_ROOM = (
    "delete scenes, uploads or jobs that are no longer needed, or ask the administrator for a larger "
    "quota"
)


def storage_quota(settings: Settings, token: Token) -> int:
    """The storage quota of a token, bytes."""
    quota = token.storage_quota_bytes
    return settings.quota_storage_bytes if quota is None else quota


def require_room(
    connection: Connection,
    settings: Settings,
    owner: UUID,
    what: str,
    size_bytes: int | None = None,
) -> int:
    """The bytes that a token may still store, at least 1; locks the token.

    Args:
        what: is to be stored, for the message.
        size_bytes: of it; None when the size is not known.

    Raises:
        TooLarge: the quota is used up, or the size exceeds what is left of it.
    """
    token = tokens.lock_token(connection, owner)
    quota = storage_quota(settings, token)
    used = usage.read_usage(connection, owner).total_bytes
    left = quota - used
    if left <= 0 or (size_bytes is not None and size_bytes > left):
        size = "" if size_bytes is None else f" of {size_bytes} bytes"
        raise TooLarge(
            f"{what}{size} exceeds the storage quota of token {token.name}: {used} of {quota} bytes are "
            f"used; {FREE_ROOM}"
        )
    return left


def room_left(connection: Connection, settings: Settings, owner: UUID) -> int:
    """The bytes that are left of the storage quota of a token now; others may take them."""
    quota = storage_quota(settings, tokens.find_token(connection, owner))
    return max(quota - usage.read_usage(connection, owner).total_bytes, 0)


def require_free_upload(connection: Connection, settings: Settings, owner: UUID) -> None:
    """Refuse another resumable upload to a token that has as many open ones as allowed; locks the token.

    Raises:
        TooMany: as many uploads are open as are allowed.
    """
    token = tokens.lock_token(connection, owner)
    open_uploads = usage.read_usage(connection, owner).open_uploads
    if open_uploads >= settings.quota_open_uploads:
        raise TooMany(
            f"token {token.name} has {open_uploads} open uploads of {settings.quota_open_uploads} "
            "allowed; complete one, or delete one that is no longer needed"
        )


def require_free_job(connection: Connection, settings: Settings, caller: Token) -> None:
    """Refuse a new job to a token whose open jobs or kept jobs reach their quota; locks the token.

    Raises:
        TooMany: the token has as many open jobs, or as many jobs in all, as its quota allows, or its
            jobs have taken the CPU of a day.
    """
    quota = caller.job_quota
    allowed = settings.quota_jobs if quota is None else quota
    tokens.lock_token(connection, caller.id)
    open_jobs = tokens.open_jobs(connection, caller.id)
    if open_jobs >= allowed:
        raise TooMany(
            f"token {caller.name} has {open_jobs} open jobs of {allowed} allowed; "
            "wait until one has ended, or dismiss one"
        )
    daily_s = settings.quota_cpu_seconds
    taken_s = attempts.cpu_taken(connection, caller.id, daily_s)
    if taken_s >= daily_s:
        wait_s = attempts.DAY_S * (taken_s / daily_s - 1.0)
        raise TooMany(
            f"jobs of token {caller.name} have taken {taken_s:.0f} s of CPU of the {daily_s:.0f} s that "
            f"it has in a day (AMERS_QUOTA_CPU_SECONDS); try again in {wait_s / 60.0 + 1.0:.0f} minutes"
        )
    kept_jobs = usage.read_usage(connection, caller.id).jobs
    if kept_jobs >= settings.quota_kept_jobs:
        raise TooMany(
            f"token {caller.name} has {kept_jobs} jobs of {settings.quota_kept_jobs} that are kept; "
            "delete ended jobs that are no longer needed (DELETE /jobs/ID)"
        )


def reserve_results(connection: Connection, settings: Settings, job: Job, size_bytes: int) -> None:
    """Record the size of the files that an attempt is about to store; locks the token of its owner.

    Raises:
        TooLarge: the files exceed what is left of the owner's quota.
        LostJob: the attempt is over.
    """
    if job.owner is not None:
        require_room(connection, settings, job.owner, "the result of the job", size_bytes)
    attempts.reserve_results(connection, job.id, job.attempt, size_bytes)
