"""A finding: an error that the correction of a scene does not contain, and its harm."""

from dataclasses import dataclass

from amers.services.types import Array


@dataclass(frozen=True)
class Finding:
    """Something that the correction of a scene does not follow.

    Attributes:
        name: identifier of what was seen.
        harm_px: (2,) what it leaves in the image beyond what the points themselves show, line and
            sample, one standard deviation; every accuracy that is stated includes it.
        words: what was seen, and what may be its cause, for people.
    """

    name: str
    harm_px: Array
    words: str
