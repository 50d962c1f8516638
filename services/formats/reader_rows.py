"""Treatment of each kind of statement that a file may make: one row for each reader.

`docs/inputs.md` is made of these rows, and a matrix of tests has a file for each of their treatments.
"""

from dataclasses import dataclass
from typing import Literal

from amers.services.statements import Subject

Outcome = Literal["used", "assumed", "named", "refused"]
"""What becomes of a statement: it decides the result; it is missing, and a stated value is taken in its
place; it is listed as not used; the file is refused."""


@dataclass(frozen=True)
class Treatment:
    """What becomes of one kind of statement.

    Attributes:
        subject: what the statement is about.
        outcome: what becomes of it.
        how: of which form the statement is, and what follows: one sentence.
    """

    subject: Subject
    outcome: Outcome
    how: str


@dataclass(frozen=True)
class Reader:
    """A kind of file that Amers reads.

    Attributes:
        name: of the kind of file, for people.
        functions: names of the public functions that read it.
        treatments: of all statements that such a file may make; one subject may have several.
        never: subjects that such a file cannot state, and that have no effect on its data.
    """

    name: str
    functions: tuple[str, ...]
    treatments: tuple[Treatment, ...]
    never: tuple[Subject, ...] = ()
