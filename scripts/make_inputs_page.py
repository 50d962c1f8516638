"""Write docs/inputs.md: what Amers reads, and what it assumes; `--check` compares."""

import sys
from pathlib import Path
from textwrap import fill

from amers.services.formats.reader_rows import Reader
from amers.services.formats.readers import READERS

PAGE = Path(__file__).parents[1] / "docs" / "inputs.md"
HEAD = """# What Amers reads, and what it assumes

This page states, for every kind of input file, what Amers does with the information in the file.
Use the page if a report or a message names a statement that was used, assumed or not used.

A *statement* is anything that a file says about its own content, such as a reference system, a unit or
an accuracy. The column *treatment* of each table contains one of these words:

* **used**: the statement decides the result.
* **assumed**: the file lacks the statement, and Amers uses the value of this table instead. The
  terminal, `--json` and the report name the assumption.
* **not used, but named**: the statement has no effect. The terminal, `--json` and the report name it.
* **refused**: Amers does not read the file. The error message says what to do.

Amers assumes nothing that this page does not list. The column *subject* says what a statement is about:

| subject | meaning |
|---|---|
| horizontal datum | the reference system of longitude and latitude, or of x and y |
| vertical datum | the surface from which heights are measured: the ellipsoid or a geoid |
| unit | the unit of coordinates, heights or pixel values |
| epoch | the time for which coordinates are valid |
| order of values | which coordinate is x and which is y |
| pixel origin | whether the first number belongs to the centre or to the corner of the first pixel |
| place in the full image | the position of a crop in the image of the sensor model, or the map grid |
| sensor model | the RPC, or orbit and attitude |
| valid pixels | which pixels, heights or points may be used |
| bands | which bands of an image are used |
| accuracy | standard deviations and other measures of accuracy |
| identity | to which image, sensor, product or layer the data belong |

`scripts/make_inputs_page.py` writes this page from the code of the readers. Every row of a table has a
test (`tests/services/formats/test_statement_matrix.py`).
"""
SHOWN = {"used": "used", "assumed": "assumed", "named": "not used, but named", "refused": "refused"}
"""The word of the page for each outcome."""
LINE = 105


def section(reader: Reader) -> str:
    """Markdown of one reader."""
    rows = "".join(f"| {t.subject} | {t.how} | {SHOWN[t.outcome]} |\n" for t in reader.treatments)
    subjects = ", ".join(reader.never)
    words = f"Files of this kind cannot contain a statement about these subjects: {subjects}."
    never = f"\n{fill(words, LINE)}\n" if subjects else ""
    head = "| subject | statement in the file, or its absence | treatment |\n|---|---|---|\n"
    return f"\n## {reader.name}\n\n{head}{rows}{never}"


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
