"""Write docs/inputs.md: what Amers reads, and what it assumes; `--check` compares."""

import sys
from pathlib import Path

from amers.services.formats.reader_rows import Reader
from amers.services.formats.readers import READERS

PAGE = Path(__file__).parents[1] / "docs" / "inputs.md"
HEAD = """# What Amers reads, and what it assumes

This page states, for every kind of input file, what Amers does with the information in the file.
Use it when a report or a message names a statement that was used, assumed or not used.

A *statement* is anything that a file says about its own content, such as a reference system, a unit or
an accuracy. Each statement has one of four treatments:

* **used**: the statement decides the result.
* **assumed**: the file lacks the statement, and Amers uses the value of this table instead. The terminal,
  `--json` and the report name the assumption.
* **named**: the statement has no effect. The terminal, `--json` and the report name it as not used.
* **refused**: the file cannot be used. The error message says what to do.

Amers assumes nothing that this page does not list. The column *subject* says what a statement is about.
The last line of a section lists subjects about which files of this kind cannot state anything.

`scripts/make_inputs_page.py` writes this page from the code of the readers. Every row of a table has a
test (`tests/services/formats/test_statement_matrix.py`).
"""


def section(reader: Reader) -> str:
    """Markdown of one reader."""
    rows = "".join(f"| {t.subject} | {t.outcome} | {t.how} |\n" for t in reader.treatments)
    never = f"\nFiles of this kind cannot state: {', '.join(reader.never)}.\n" if reader.never else ""
    return f"\n## {reader.name}\n\n| subject | treatment | statement |\n|---|---|---|\n{rows}{never}"


def inputs_page() -> str:
    """Markdown of the page."""
    return HEAD + "".join(map(section, READERS))


def main(arguments: list[str]) -> int:
    """Write or compare the page; 1 if they differ."""
    text = inputs_page()
    if arguments != ["--check"]:
        PAGE.write_text(text, encoding="utf-8")
    elif PAGE.read_text(encoding="utf-8") != text:
        print(f"{PAGE.name} is not that of the readers: run scripts/make_inputs_page.py")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
