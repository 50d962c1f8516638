"""The errors of the doors and the store; those of the science are in `services.errors`."""

from services.errors import AmersError, ComputationError, InputError

__all__ = [
    "AmersError",
    "ComputationError",
    "Conflict",
    "InputError",
    "InvalidParameter",
    "NotAllowed",
    "NotFound",
    "TooLarge",
    "TooMany",
]


class InvalidParameter(InputError):
    """A parameter of a request does not hold what it should; OGC API calls for 400."""


class NotFound(AmersError):
    """There is no such thing, or not for this caller."""


class Conflict(AmersError):
    """The thing is not in a state that allows this."""


class TooLarge(AmersError):
    """More bytes than the installation accepts."""


class TooMany(AmersError):
    """More at once than the caller may have; later it may be possible."""


class NotAllowed(AmersError):
    """The caller may not do this.

    Attributes:
        known: whether the caller showed a valid token (403) or not (401).
    """

    def __init__(self, message: str, *, known: bool) -> None:
        super().__init__(message)
        self.known = known
