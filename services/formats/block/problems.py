"""What is wrong in a block: the first of its problems by name, all of them in the count."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from services.errors import FormatError
from services.types import BoolArray

LISTED = 20
ROWS_OF_ONE_KIND = 3


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong in a block.

    Attributes:
        file: path in the block.
        field: column or field, "" for the file itself.
        row: None when it is not about one row.
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
    """A block that cannot be used.

    Attributes:
        problems: the first of them.
        count: how many there are.
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
    """Gathers the problems of a block; the first of them keep their words."""

    problems: list[Problem] = field(default_factory=list)
    count: int = 0

    def add(self, file: str, field: str, found: str, expected: str, row: int | None = None) -> None:
        """Add one problem; see `Problem`."""
        self.count += 1
        if len(self.problems) < LISTED:
            self.problems.append(Problem(file, field, row, found, expected))

    def rows(
        self, where: tuple[str, str], bad: BoolArray, values: npt.NDArray[Any], expected: str
    ) -> None:
        """Add the rows of a column that are bad: the first few by name, all of them in the count.

        Args:
            where: file and column.
            bad: (n,) mask of the rows.
            values: (n, ...) of the column.
            expected: instead of what is there.
        """
        rows = np.flatnonzero(bad)
        for row in rows[:ROWS_OF_ONE_KIND]:
            self.add(*where, str(values[row]), expected, int(row))
        self.count += max(0, len(rows) - ROWS_OF_ONE_KIND)

    def raise_if_any(self) -> None:
        """End here when something was wrong.

        Raises:
            BlockProblems: with what was gathered.
        """
        if self.count:
            raise BlockProblems(tuple(self.problems), self.count)
