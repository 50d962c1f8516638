"""Statements of files about their data, and how each one is treated: used, assumed or not used.

A reader returns its data with a record of statements. A statement that cannot be used and that changes
the result refuses the file; any other that is not used stands in the record, which goes to the terminal,
to `--json` and into the report.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum


class Subject(StrEnum):
    """What a statement is about."""

    MODEL = "sensor model"
    PLACE = "place in the full image"
    PIXEL_ORIGIN = "pixel origin"
    HORIZONTAL_DATUM = "horizontal datum"
    VERTICAL_DATUM = "vertical datum"
    UNIT = "unit"
    EPOCH = "epoch"
    ORDER = "order of values"
    VALIDITY = "valid pixels"
    BANDS = "bands"
    IDENTITY = "identity"
    ACCURACY = "accuracy"


class Use(StrEnum):
    """What became of a statement.

    USED: it decided the result. ASSUMED: the file does not state it, and the reader took the value that
    the documents of the format, or its custom, give. NOT_USED: the file states it, and it had no effect.
    """

    USED = "used"
    ASSUMED = "assumed"
    NOT_USED = "not used"


@dataclass(frozen=True)
class Statement:
    """One statement of a file.

    Attributes:
        file: name of the file.
        subject: what it is about.
        use: what became of it.
        value: as the file has it, with its unit; what was assumed where it has none.
        where: the place in the file, such as "column height" or "band 1"; "" for the whole file.
        note: what follows from it, or which option changes it; "" where nothing has to be said.
        more_files: number of other files with the same statement; see `gathered`.
        is_usual: whether files of this kind are commonly like that, so that only the report and `--json`
            say it: a terminal that says the usual hides what is not.
    """

    file: str
    subject: Subject
    use: Use
    value: str
    where: str = ""
    note: str = ""
    more_files: int = 0
    is_usual: bool = False

    def __str__(self) -> str:
        """One sentence for people."""
        file = f"{self.file} and {self.more_files} more" if self.more_files else self.file
        place = f"{file}, {self.where}" if self.where else file
        note = f" ({self.note})" if self.note else ""
        return f"{place}: {self.subject}: {self.value}: {self.use}{note}"


Statements = tuple[Statement, ...]


def gathered(statements: Iterable[Statement]) -> Statements:
    """The statements without repetition: what many files state alike is one statement with their number.

    Their order is that of their first appearance.
    """
    first: dict[Statement, Statement] = {}
    files: dict[Statement, set[str]] = {}
    for statement in statements:
        key = replace(statement, file="", more_files=0)
        first.setdefault(key, statement)
        files.setdefault(key, set()).add(statement.file)
    return tuple(replace(first[key], more_files=len(files[key]) - 1) for key in first)


def worth_saying(statements: Iterable[Statement]) -> Statements:
    """The statements that a terminal shows: what was assumed or not used, unless it is usual."""
    return tuple(one for one in statements if one.use != Use.USED and not one.is_usual)
