"""The errors of the doors and the store; those of the science are in `services.errors`."""

import errno

from services.errors import AmersError, ComputationError, InputError

__all__ = [
    "AmersError",
    "ComputationError",
    "Conflict",
    "InputError",
    "InvalidParameter",
    "NoSuchJob",
    "NoSuchProcess",
    "NotAllowed",
    "NotFound",
    "StorageOutage",
    "TooLarge",
    "TooMany",
    "is_no_room",
]
DISK_FULL = "53100"
"""What PostgreSQL calls it."""


class InvalidParameter(InputError):
    """A parameter of a request does not hold what it should; OGC API calls for 400."""


class NotFound(AmersError):
    """There is no such thing, or not for this caller."""


class NoSuchProcess(NotFound):
    """There is no process of that name."""


class NoSuchJob(NotFound):
    """There is no job of that number, or not for this caller."""


class StorageOutage(Exception):
    """The storage does not answer: nobody's fault, so that work which meets this is tried again."""


class Conflict(AmersError):
    """The thing is not in a state that allows this."""


class TooLarge(AmersError):
    """More bytes than the installation accepts."""


class TooMany(AmersError):
    """More at once than the caller may have; later it may be possible."""


def is_no_room(error: BaseException) -> bool:
    """Whether an error says that a disk is full, that of the files or that of the database."""
    return (
        isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    ) or getattr(error, "sqlstate", None) == DISK_FULL


class NotAllowed(AmersError):
    """The caller may not do this.

    Attributes:
        known: whether the caller showed a valid token (403) or not (401).
    """

    def __init__(self, message: str, *, known: bool) -> None:
        super().__init__(message)
        self.known = known
