"""Lines of CSV files in the dialects of spreadsheets: comments, column names and rows."""

import csv
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

from amers.services.errors import FormatError

_SEPARATOR = re.compile(r"sep=(.)\s*", re.IGNORECASE)
"""First line of files of Excel."""
_DELIMITERS = ",;\t|"
_MAX_LINES_BEFORE_NAMES = 200


@dataclass(frozen=True)
class CsvHead:
    """The lines of a CSV before its rows.

    Attributes:
        comments: number and content of each line before the names.
        delimiter: of fields.
        names: of the columns.
        lines: number of lines up to the names.
    """

    comments: tuple[tuple[int, str], ...]
    delimiter: str
    names: list[str]
    lines: int


@dataclass(frozen=True)
class CsvRow:
    """A row of a CSV.

    Attributes:
        where: file and line, for messages.
        fields: as many as columns.
    """

    where: str
    fields: list[str]


def csv_head(text: str, is_names: Callable[[list[str]], bool]) -> CsvHead:
    """The lines of a text before its rows: comments with "#", then the names of the columns.

    Args:
        text: contents of the file.
        is_names: whether fields are names of columns; a comment may have these, too.
    """
    comments: list[tuple[int, str]] = []
    delimiter: str | None = None
    commented: CsvHead | None = None
    for count, line in enumerate(islice(text.split("\n"), _MAX_LINES_BEFORE_NAMES), start=1):
        separator = _SEPARATOR.fullmatch(line)
        if separator is not None:
            delimiter = separator[1]
        elif line.lstrip().startswith("#"):
            content = line.lstrip().lstrip("#").strip()
            head = _split(content, delimiter, comments, count)
            commented = head if is_names(head.names) else commented
            comments.append((count, content))
        elif line.strip(" ,;\t"):
            head = _split(line, delimiter, comments, count)
            return head if commented is None or is_names(head.names) else commented
    return commented or CsvHead(tuple(comments), delimiter or ",", [], 0)


def _split(line: str, delimiter: str | None, comments: list[tuple[int, str]], count: int) -> CsvHead:
    mark = delimiter or max(_DELIMITERS, key=line.count)
    try:
        names = [name.strip() for name in next(csv.reader([line], delimiter=mark), [])]
    except csv.Error:
        names = []
    return CsvHead(tuple(comments), mark, names, count)


def csv_rows(text: str, head: CsvHead, source: str) -> list[CsvRow]:
    """The rows after the names of the columns, without empty ones and comments.

    Args:
        text: contents of the file.
        head: of the text.
        source: name of the file, for messages.

    Raises:
        FormatError: a row has more or fewer fields than columns.
    """
    of_rows = io.StringIO(text)
    for _ in range(head.lines):
        of_rows.readline()
    lines = csv.reader(of_rows, delimiter=head.delimiter, strict=True)
    rows = []
    try:
        for fields in lines:
            is_empty = not any(field.strip() for field in fields)
            if is_empty:
                continue
            where = f"{source}, line {head.lines + lines.line_num}"
            if len(fields) != len(head.names):
                if fields[0].startswith("#"):
                    continue
                raise FormatError(
                    f"{where}: expected {len(head.names)} fields, as many as columns, "
                    f"found {len(fields)}"
                )
            rows.append(CsvRow(where, [field.strip() for field in fields]))
    except csv.Error as error:
        raise FormatError(
            f"{source}, line {head.lines + lines.line_num}: expected CSV: {error}"
        ) from None
    return rows
