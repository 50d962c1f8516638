"""Record of the statements of one file, filled while the file is read."""

from dataclasses import dataclass, field, replace

from amers.services.statements import Statement, Subject, Use


@dataclass
class Record:
    """The statements of one file so far.

    Attributes:
        file: its name.
        statements: in the order of the file.
    """

    file: str
    statements: list[Statement] = field(default_factory=list)

    def used(self, subject: Subject, value: str, where: str = "", note: str = "") -> None:
        """Note a statement that decided the result."""
        self.statements.append(Statement(self.file, subject, Use.USED, value, where, note))

    def assumed(self, subject: Subject, value: str, where: str = "", note: str = "") -> None:
        """Note what the file does not state; without a note it is as the documents of the format say."""
        assumed = Statement(self.file, subject, Use.ASSUMED, value, where, note)
        self.statements.append(replace(assumed, is_usual=not note))

    def not_used(self, subject: Subject, value: str, where: str = "", note: str = "") -> None:
        """Note a statement without effect."""
        self.statements.append(Statement(self.file, subject, Use.NOT_USED, value, where, note))
