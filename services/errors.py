"""Error classes: input that a user can correct, and data without a trustworthy result.

AmersError
├── InputError              the input cannot be used; the user can correct it
│   ├── FormatError         the content of a file or a document is missing or wrong
│   ├── CoverageError       two data sets that must overlap do not
│   ├── MissingStatements   several facts that neither files nor options state
│   └── VerticalDatumError  heights whose datum is unknown or not supported
│       └── MissingGeoid    the grid of their geoid is not installed, and no file of it is given
└── ComputationError        the input is valid, but gives no trustworthy result
    ├── NotEnoughPoints
    ├── NoConsensus
    │   ├── TurnedImage     they agree on an image whose axes are others than those of its model
    │   ├── RescaledImage   they agree on an image with finer or coarser pixels than those of its model
    │   └── BrokenImage     lines of the image were lost or repeated
    ├── UndeterminedCorrection
    ├── DisconnectedBlock
    ├── DoesNotFit
    └── NoConvergence

Every message states the values found and expected.
"""

from collections.abc import Callable, Iterator, Sequence


class AmersError(Exception):
    """Base of all errors whose message is shown to the user."""


class InputError(AmersError):
    """The input cannot be used; the message states what was expected."""


class FormatError(InputError):
    """The content of a file or a document is missing or wrong."""


class MissingStatements(InputError):
    """What neither the files nor the caller state, with the options that state it.

    Attributes:
        missing: a sentence for each.
    """

    def __init__(self, missing: Sequence[str]) -> None:
        sentences = "; ".join(f"({count}) {text}" for count, text in enumerate(missing, start=1))
        several = f"{len(missing)} statements are missing: {sentences}"
        super().__init__(several if len(missing) > 1 else missing[0])
        self.missing = tuple(missing)


def reword(error: InputError, change: Callable[[str], str]) -> None:
    """Change the message of an error, such as the names of options in it."""
    error.args = (change(str(error)),)
    if isinstance(error, MissingStatements):
        error.missing = tuple(change(text) for text in error.missing)


def refuse_unstated(missing: Sequence[InputError]) -> None:
    """Raise the errors of missing statements as one, which names them all; nothing where there is none.

    Args:
        missing: in the order of the options that mend them.

    Raises:
        InputError: the only one.
        MissingStatements: several.
    """
    if len(missing) == 1:
        raise missing[0]
    if missing:
        parts = [
            error.missing if isinstance(error, MissingStatements) else (str(error),) for error in missing
        ]
        raise MissingStatements([text for part in parts for text in part])


class CoverageError(InputError):
    """Two data sets that must overlap do not."""


class OtherGround(CoverageError):
    """Control lies so far from a scene that it is that of other ground."""


class VerticalDatumError(InputError):
    """Heights whose vertical datum is unknown or not supported."""


class MissingGeoid(VerticalDatumError):
    """The grid of the geoid is not installed; entry points add how to give its file."""


class ComputationError(AmersError):
    """The input is valid, but gives no trustworthy result."""


class NotEnoughPoints(ComputationError):
    """Too few usable points.

    Attributes:
        found: number of usable points.
        needed: number of points that the computation needs.
    """

    def __init__(self, found: int, needed: int, explanation: str = "") -> None:
        detail = f": {explanation}" if explanation else ""
        super().__init__(f"{found} usable points found, {needed} needed{detail}")
        self.found = found
        self.needed = needed


class NoConsensus(ComputationError):
    """The measures do not agree on one correction."""


class TurnedImage(NoConsensus):
    """The measures agree on an image that is mirrored, upside down or whose axes are swapped."""


class RescaledImage(NoConsensus):
    """The measures agree on an image whose pixels are finer or coarser than those of its model."""


class BrokenImage(NoConsensus):
    """The image has parts that lie apart: between them, lines were lost or repeated."""


class UndeterminedCorrection(ComputationError):
    """The points leave a part of the correction open that the user asks for."""


class DisconnectedBlock(ComputationError):
    """Images of one block that nothing ties together."""


class DoesNotFit(ComputationError):
    """A scene that does not fit the others of its block."""


class NoConvergence(ComputationError):
    """An iteration did not converge."""


def causes(error: BaseException) -> Iterator[BaseException]:
    """Iterate over an error and what it was raised from, each once, with the members of groups.

    They can form a ring: a library that raises a caught error from itself makes it its own cause.
    Nothing else than this module walks from error to error.
    """
    return _walk(error, ("__cause__",))


def causes_and_contexts(error: BaseException) -> Iterator[BaseException]:
    """Iterate over an error, its causes, and what was being handled when they were raised, each once."""
    return _walk(error, ("__context__", "__cause__"))


def _walk(error: BaseException, links: tuple[str, ...]) -> Iterator[BaseException]:
    waiting, met = [error], {id(error)}
    while waiting:
        one = waiting.pop()
        yield one
        members = one.exceptions if isinstance(one, BaseExceptionGroup) else ()
        for behind in (*members, *(getattr(one, link) for link in links)):
            if behind is not None and id(behind) not in met:
                met.add(id(behind))
                waiting.append(behind)
