"""The error tree: what a user can mend, and what the data would not allow.

AmersError
├── InputError              the input cannot be used; the user can mend it
│   ├── FormatError         a file or a document does not say what it should
│   ├── CoverageError       two things that must overlap do not
│   └── VerticalDatumError  heights whose datum is unknown or not supported
└── ComputationError        the input was understood, but no trustworthy result came out of it
    ├── NotEnoughPoints
    ├── NoConsensus
    └── NoConvergence

Every message gives the numbers that explain it.
"""


class AmersError(Exception):
    """Base of all errors that are shown to the user as they are."""


class InputError(AmersError):
    """The input cannot be used; the message says what was expected."""


class FormatError(InputError):
    """A file or document does not say what it should."""


class CoverageError(InputError):
    """Two things that must overlap do not."""


class VerticalDatumError(InputError):
    """Heights whose vertical datum is unknown or not supported."""


class ComputationError(AmersError):
    """The input was understood, but no trustworthy result came out of it."""


class NotEnoughPoints(ComputationError):
    """Too few usable points.

    Attributes:
        found: how many were usable.
        needed: how many the computation needs.
    """

    def __init__(self, found: int, needed: int, explanation: str = "") -> None:
        detail = f": {explanation}" if explanation else ""
        super().__init__(f"{found} usable points found, {needed} needed{detail}")
        self.found = found
        self.needed = needed


class NoConsensus(ComputationError):
    """The measures do not agree on one correction."""


class NoConvergence(ComputationError):
    """An iteration did not settle."""
