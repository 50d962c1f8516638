"""Quotas of one token: bytes of uploads in the storage, and open jobs."""

from app.config import Settings
from app.db import tokens
from app.db.engine import Connection
from app.db.tokens import Token
from app.errors import TooLarge, TooMany


def upload_allowance(
    connection: Connection, settings: Settings, caller: Token, announced_bytes: int | None = None
) -> int:
    """The bytes that a token may still upload; locks the token until the end of the transaction.

    Call it in the transaction that records the announced size: concurrent uploads of one token then
    wait for each other here.

    Args:
        announced_bytes: size of the upload; None when the sender does not announce it.

    Raises:
        TooLarge: the quota is used up, or the announced upload exceeds what is left of it.
    """
    quota = caller.upload_quota_bytes
    allowed = settings.quota_upload_bytes if quota is None else quota
    tokens.lock_token(connection, caller.id)
    used = tokens.uploaded_bytes(connection, caller.id)
    left = allowed - used
    if left <= 0 or (announced_bytes is not None and announced_bytes > left):
        upload = "an upload" if announced_bytes is None else f"an upload of {announced_bytes} bytes"
        raise TooLarge(
            f"{upload} exceeds the quota of token {caller.name}: {used} of {allowed} bytes are used; "
            "remove scenes that are no longer needed, or ask the administrator for a larger quota"
        )
    return left


def require_free_job(connection: Connection, settings: Settings, caller: Token) -> None:
    """Refuse a new job to a token whose open jobs reach its quota; locks the token.

    Call it in the transaction that creates the job: concurrent requests of one token then wait for each
    other here.

    Raises:
        TooMany: the token has as many open jobs as its quota allows.
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
