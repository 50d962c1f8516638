"""Errors of the entry points and the store; those of the science are in `amers.services.errors`."""

import errno
import re

from amers.services.errors import AmersError, ComputationError, InputError, causes_and_contexts

__all__ = [
    "AmersError",
    "ComputationError",
    "Conflict",
    "DamagedFile",
    "InputError",
    "InvalidParameter",
    "NoSuchJob",
    "NoSuchProcess",
    "NotAllowed",
    "NotFound",
    "PortInUse",
    "StorageOutage",
    "TooLarge",
    "TooMany",
    "is_no_memory",
    "is_no_room",
]
DISK_FULL = "53100"
"""SQLSTATE of PostgreSQL's error `disk_full`."""
CV_NO_MEMORY = -4
"""Code of OpenCV's error `StsNoMem`."""
GDAL_NO_MEMORY = "CPLE_OutOfMemoryError"
NO_MEMORY = re.compile(
    r"out of memory|cannot allocate|can't allocate|unable to allocate|failed to allocate|bad_alloc"
    r"|not enough memory|can't start new thread",
    re.IGNORECASE,
)
"""How libraries say that they got no memory, where their errors have no class or code of their own."""


class InvalidParameter(InputError):
    """A request parameter has an unusable value; OGC API requires status 400 for it."""


class PortInUse(InputError):
    """Another program listens on the port that the service shall listen on."""


class NotFound(AmersError):
    """The requested thing does not exist, or this caller may not see it."""


class NoSuchProcess(NotFound):
    """No process has this name."""


class NoSuchJob(NotFound):
    """No job has this id, or this caller may not see it."""


class StorageOutage(Exception):
    """The file storage does not answer, or is not that of this installation.

    Not the user's fault: a job that meets it is tried again, as often as it takes.

    Attributes:
        reason: for callers, without any place of this machine; half a sentence.
    """

    def __init__(self, message: str, reason: str = "the storage of files does not answer") -> None:
        super().__init__(message)
        self.reason = reason


class Conflict(AmersError):
    """The present state of the thing does not allow the request."""


class DamagedFile(AmersError):
    """A file that a row of the store names is missing, or does not have the content it had.

    The installation is at fault, not the caller: the reply is a 500, and the operator is alarmed.

    Attributes:
        key: of the file in the storage.
        reason: what is wrong with it.
    """

    def __init__(self, key: str, reason: str) -> None:
        super().__init__(
            f"{key} is damaged: {reason}. The operator repairs it with `amers store verify`"
        )
        self.key = key
        self.reason = reason


class TooLarge(AmersError):
    """More bytes than the installation or the caller's quota accepts."""


class TooMany(AmersError):
    """More at once than the caller's quota allows; the same request may succeed later."""


def is_no_room(error: BaseException) -> bool:
    """Whether an error means that a disk is full: that of the files or that of the database."""
    return (
        isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    ) or getattr(error, "sqlstate", None) == DISK_FULL


def is_no_memory(error: BaseException) -> bool:
    """Whether an error, or one that caused it, means that this process got no memory.

    Libraries report it in their own ways, by class, code or text: GDAL, OpenCV, libpq, C++. What the
    server of the database reports is the state of another process.
    """
    return any(map(_says_no_memory, causes_and_contexts(error)))


def _says_no_memory(error: BaseException) -> bool:
    if isinstance(error, MemoryError) or type(error).__name__ == GDAL_NO_MEMORY:
        return True
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    if type(error).__module__ == "cv2" and getattr(error, "code", None) == CV_NO_MEMORY:
        return True
    is_ours = isinstance(error, AmersError) or getattr(error, "sqlstate", None) is not None
    return not is_ours and NO_MEMORY.search(str(error)) is not None


class NotAllowed(AmersError):
    """The caller may not do this.

    Attributes:
        authenticated: whether the caller sent a valid token (403) or not (401).
    """

    def __init__(self, message: str, *, authenticated: bool) -> None:
        super().__init__(message)
        self.authenticated = authenticated
