"""Problems found in a block: the first ones in full, and the number of all."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from amers.services.errors import FormatError
from amers.services.types import BoolArray

MAX_LISTED_PROBLEMS = 20
MAX_LISTED_ROWS = 3
"""Rows with the same problem that are listed; the others are only counted."""


@dataclass(frozen=True)
class Problem:
    """One value of a block that differs from what the format requires.

    Attributes:
        file: path in the block.
        field: column or field, "" for the file itself.
        row: row of the table, None when the problem concerns no single row.
        found: the value found.
        expected: the value required.
    """

    file: str
    field: str
    row: int | None
    found: str
    expected: str

    def __str__(self) -> str:
        where = f"{self.file}: {self.field}" if self.field else self.file
        row = "" if self.row is None else f": row {self.row}"
        return f"{where}{row}: {self.found} found, {self.expected} expected"


class BlockProblems(FormatError):
    """The block does not satisfy its format.

    Attributes:
        problems: the first problems.
        count: number of all problems.
    """

    def __init__(self, problems: tuple[Problem, ...], count: int) -> None:
        lines = [str(problem) for problem in problems]
        if count > len(lines):
            lines.append(f"and {count - len(lines)} more")
        noun = "problem" if count == 1 else "problems"
        super().__init__(f"the block has {count} {noun}: " + "; ".join(lines))
        self.problems = problems
        self.count = count


@dataclass
class ProblemReport:
    """Collects the problems of a block; only the first ones are stored in full."""

    problems: list[Problem] = field(default_factory=list)
    count: int = 0

    def add(self, file: str, field: str, found: str, expected: str, row: int | None = None) -> None:
        """Add one problem; see `Problem`."""
        self.count += 1
        if len(self.problems) < MAX_LISTED_PROBLEMS:
            self.problems.append(Problem(file, field, row, found, expected))

    def rows(
        self, where: tuple[str, str], bad: BoolArray, values: npt.NDArray[Any], expected: str
    ) -> None:
        """Add the bad rows of a column: list the first ones, count all of them.

        Args:
            where: file and column.
            bad: (n,) mask of the bad rows.
            values: (n, ...) values of the column.
            expected: the value required.
        """
        rows = np.flatnonzero(bad)
        for row in rows[:MAX_LISTED_ROWS]:
            self.add(*where, str(values[row]), expected, int(row))
        self.count += max(0, len(rows) - MAX_LISTED_ROWS)

    def raise_if_any(self) -> None:
        """Raise when a problem was added.

        Raises:
            BlockProblems: with the problems collected.
        """
        if self.count:
            raise BlockProblems(tuple(self.problems), self.count)
