"""How much one token may have at once: bytes of uploads in the storage, jobs that have not ended."""

from app.config import Settings
from app.db import tokens
from app.db.engine import Connection
from app.db.tokens import Token
from app.errors import TooLarge, TooMany


def upload_allowance(
    connection: Connection, settings: Settings, caller: Token, announced_bytes: int | None = None
) -> int:
    """The bytes a token may still upload; uploads that begin at the same time wait for each other here.

    To be asked in the transaction that writes the announced size down.

    Args:
        announced_bytes: size of the upload about to begin, None when its sender does not say.

    Raises:
        TooLarge: the upload, or any upload, would go beyond the quota.
    """
    quota = caller.upload_quota_bytes
    allowed = settings.quota_upload_bytes if quota is None else quota
    tokens.lock_token(connection, caller.id)
    used = tokens.uploaded_bytes(connection, caller.id)
    left = allowed - used
    if left <= 0 or (announced_bytes is not None and announced_bytes > left):
        asked = "an upload" if announced_bytes is None else f"an upload of {announced_bytes} bytes"
        raise TooLarge(
            f"{asked} goes beyond the quota of token {caller.name}: {used} of {allowed} bytes are used; "
            "remove scenes that are done with, or ask the administrator for more"
        )
    return left


def require_free_job(connection: Connection, settings: Settings, caller: Token) -> None:
    """Refuse one more job to a token that has as many as it may; jobs asked for at once wait here.

    To be asked in the transaction that creates the job.

    Raises:
        TooMany: the token has so many jobs that have not ended.
    """
    quota = caller.job_quota
    allowed = settings.quota_jobs if quota is None else quota
    tokens.lock_token(connection, caller.id)
    open_jobs = tokens.open_jobs(connection, caller.id)
    if open_jobs >= allowed:
        raise TooMany(
            f"token {caller.name} has {open_jobs} jobs that have not ended, {allowed} are allowed "
            "at once; wait for one to end, or dismiss one"
        )
