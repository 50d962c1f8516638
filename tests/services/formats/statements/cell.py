"""One cell of the matrix: a file that makes a statement, and what becomes of it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from amers.services.errors import InputError
from amers.services.formats.reader_rows import Outcome, Reader
from amers.services.statements import Statements, Subject, Use

CELLS: list["Cell"] = []
_USES = {"used": Use.USED, "assumed": Use.ASSUMED, "named": Use.NOT_USED}

Read = Callable[[Path], Any]
"""Writes a file into a folder and reads it; returns what the reader returns, with its `statements`."""


@dataclass(frozen=True)
class Cell:
    """A file that makes a statement, or omits it, and what becomes of that.

    Attributes:
        reader: name of the row.
        subject, outcome: of the treatment that it shows.
        read: writes the file and reads it.
        shows: part of the statement's sentence, or of the message of a refused file.
    """

    reader: str
    subject: Subject
    outcome: Outcome
    read: Read
    shows: str

    def __str__(self) -> str:
        return f"{self.reader}-{self.subject}-{self.outcome}-{self.read.__name__}"

    def check(self, folder: Path) -> Any:
        """Write and read the file; what becomes of the statement is what the cell says.

        Returns:
            What is read; None of a file that is refused.
        """
        if self.outcome == "refused":
            with pytest.raises(InputError) as refused:
                self.read(folder)
            assert self.shows in str(refused.value)
            return None
        read = self.read(folder)
        stated: Statements = read.statements
        of_subject = [s for s in stated if s.subject is self.subject and s.use is _USES[self.outcome]]
        assert any(self.shows in str(s) for s in of_subject), [str(s) for s in stated]
        return read


def cell(reader: str, subject: Subject, outcome: Outcome, shows: str) -> Callable[[Read], Read]:
    """Decorator: the function writes and reads a file that shows one treatment.

    A function that also asserts the effect (a height, a position) does so before it returns.
    """

    def add(read: Read) -> Read:
        CELLS.append(Cell(reader, subject, outcome, read, shows))
        return read

    return add


def add(reader: Reader, subject: Subject, outcome: Outcome, shows: str, name: str, read: Read) -> None:
    """Add a cell with a name for the test."""

    def named(folder: Path) -> Any:
        return read(folder)

    named.__name__ = name
    cell(reader.name, subject, outcome, shows)(named)
